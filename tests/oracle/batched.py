"""Entropies of thousands of texels in double precision, for the errors of kernels.

The same equations as in ``posterior``, which takes one texel after the other and every
combination of cells; here a row's channels are independent, so that fine grids are affordable.
"""

from __future__ import annotations

import math

import numpy as np


def entropy(p: np.ndarray) -> np.ndarray:
    """H = -1 / log n sum p log p over the last axis, n its length (Eq. 5)."""
    terms = np.where(p > 0, p * np.log(np.where(p > 0, p, 1)), 0)
    return -terms.sum(axis=-1) / math.log(p.shape[-1])


def normalized(energy: np.ndarray) -> np.ndarray:
    """p ~ exp(-energy), summing to 1 over the last axis."""
    p = np.exp(energy.min(axis=-1, keepdims=True) - energy)
    return p / p.sum(axis=-1, keepdims=True)


def shared_entropy(energy: np.ndarray) -> np.ndarray:
    """Entropy (T,) of energies (T, rows, cells)."""
    return entropy(normalized(energy.reshape(len(energy), -1)))


def joint_entropy(energy: np.ndarray) -> np.ndarray:
    """Entropy (T,) when every channel has a cell of its own: (T, rows, cells, C).

    For one channel the others are summed over, of a row they are independent; then the mean
    over channels.
    """
    texels, _, _, channels = energy.shape
    # -log of the sum over cells, per row and channel.
    low = energy.min(axis=2)
    row = low - np.log(np.exp(low[:, :, None] - energy).sum(axis=2))
    others = row.sum(axis=-1, keepdims=True) - row
    single = [
        entropy(normalized((energy[..., c] + others[:, :, None, c]).reshape(texels, -1)))
        for c in range(channels)
    ]
    return np.mean(single, axis=0)


def spectrum_energy(
    S_L: np.ndarray, S_B: np.ndarray, sigma: float, decay: np.ndarray, Ks: np.ndarray
) -> np.ndarray:
    """d / (2 sigma^2) of every cell and channel (Eq. 11).

    Args:
        S_L: (T, L + 1, C) power spectra of the light; l = 0 takes no part.
        S_B: those of the observations.
        sigma: standard deviation of a degree's power.
        decay: (R, L) what a roughness leaves of the power of l = 1 ... L.
        Ks: (R, S) or (S,) nodes; those of a row.

    Returns:
        (T, R, S, C).
    """
    rows = []
    for e, scale in zip(decay, np.broadcast_to(Ks, (len(decay), Ks.shape[-1])), strict=True):
        model = e[:, None] * S_L[:, 1:]
        difference = S_B[:, None, 1:] - (scale**2)[:, None, None] * model[:, None]
        rows.append((difference**2).sum(axis=2))
    return np.stack(rows, axis=1) / (2 * sigma**2)


def constant_energy(
    seen: np.ndarray, diffuse: np.ndarray, specular: np.ndarray, sigma: float
) -> np.ndarray:
    """(sqrt(S_B(0)) - 2 Kd E / sqrt(pi) - R0 a sqrt(S_L(0)))^2 / (2 sigma_0^2) (Eq. 7).

    Args:
        seen: sqrt(S_B(0)).
        diffuse: 2 Kd E / sqrt(pi).
        specular: R0 a sqrt(S_L(0)).
        sigma: standard deviation of ``seen``.
    """
    return (seen - diffuse - specular) ** 2 / (2 * sigma**2)
