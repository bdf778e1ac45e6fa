"""Eq. 3 to 5, 7 and 11 by brute force: every cell of the grid, one after the other.

Sizes: C channels; R and S nodes of roughness, and of base colour or Ks.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

F0 = 0.04

# --- errors of every cell from spectra: Eq. 7 and 11 ----------------------------------------


def nodes(roughness: int, specular: int, spacing: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of roughness and Ks."""
    t = np.linspace(0, 1, specular)
    return np.linspace(0, 1, roughness), t if spacing == "uniform" else F0 + (1 - F0) * t**2


def model(S_L: np.ndarray, Ks: float, alpha: float, prefilter: float = 0.0) -> np.ndarray:
    """Ks^2 exp(-2 (alpha l)^2) S_L(l) for l = 0 ... L on the last axis (Eq. 11)."""
    l = np.arange(S_L.shape[-1])
    return Ks**2 * np.exp(-2 * max(alpha**2 - prefilter**2, 0) * l**2) * S_L


def distances(
    S_L: np.ndarray, S_B: np.ndarray, alphas: np.ndarray, Ks: np.ndarray, prefilter: float = 0.0
) -> np.ndarray:
    """d of one texel and channel (L + 1,) on the grid, (R, S): l = 0 takes no part (Eq. 11).

    Args:
        S_L: power of the light by degree.
        S_B: power of the photographs.
        alphas: (R,).
        Ks: (S,) of all roughnesses, or (R, S).
        prefilter: alpha' that is undone.
    """
    Ks = np.broadcast_to(Ks, (len(alphas), np.shape(Ks)[-1]))
    d = np.zeros(Ks.shape)
    for i, j in itertools.product(*map(range, d.shape)):
        difference = S_B - model(S_L, Ks[i, j], alphas[i], prefilter)
        d[i, j] = (difference[1:] ** 2).sum()
    return d


def constant_residual(
    S_L0: float, S_B0: float, irradiance: float, Kd: np.ndarray, Ks: np.ndarray
) -> np.ndarray:
    """sqrt(S_B(0)) - 2 Kd E / sqrt(pi) - Ks sqrt(S_L(0)) of every (Kd, Ks) (Eq. 7)."""
    return np.sqrt(S_B0) - 2 * Kd * irradiance / np.sqrt(np.pi) - Ks * np.sqrt(S_L0)


# --- from errors to probabilities and entropy: Eq. 3 to 5 -----------------------------------


def energies(d: np.ndarray, sigma: float) -> np.ndarray:
    """-log p up to a constant."""
    return d / (2 * sigma**2)


def normalize(energy: np.ndarray, prior: np.ndarray | float = 1.0) -> np.ndarray:
    """exp(-energy) prior, summing to 1; relative to the best cell that the prior allows."""
    prior = np.broadcast_to(prior, energy.shape)
    allowed = np.where(prior > 0, energy, np.inf)
    p = np.exp(-(allowed - allowed.min())) * prior
    return p / p.sum()


def joint(channels: list[np.ndarray], prior: np.ndarray | None = None) -> np.ndarray:
    """p of every combination: rows, then one cell for each channel.

    All channels share a row (roughness, or roughness and metallic); the last axis is each
    channel's own.

    Args:
        channels: energies (..., cells) of each channel.
        prior: (..., cells) weights of one channel: of a row, times those of its cells given it.
    """
    cells, count = channels[0].shape[-1], len(channels)
    prior = np.ones(channels[0].shape) if prior is None else prior
    prior = prior.reshape(-1, cells)
    of_row = prior.sum(axis=1)
    given = prior / np.where(of_row > 0, of_row, 1)[:, None]
    energy: np.ndarray = np.zeros(())
    weight = of_row.reshape(-1, *(1,) * count)
    for channel, x in enumerate(channels):
        own = (len(prior), *(cells if k == channel else 1 for k in range(count)))
        energy = energy + x.reshape(own)
        weight = weight * given.reshape(own)
    return normalize(energy, weight)


def of_channels(p: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The distribution of each channel with the others summed over: (*shape, channels)."""
    count = p.ndim - 1
    parts = []
    for channel in range(count):
        others = tuple(1 + k for k in range(count) if k != channel)
        parts.append(p.sum(axis=others).reshape(shape))
    return np.stack(parts, axis=-1)


def entropy(p: np.ndarray) -> float:
    """H = -1 / log n * sum p log p (Eq. 5)."""
    positive = p[p > 0]
    return float(-(positive * np.log(positive)).sum() / np.log(p.size))


def mean_entropy(p: np.ndarray) -> float:
    """Mean over the last axis (channels) of the normalised entropy."""
    return float(np.mean([entropy(p[..., c]) for c in range(p.shape[-1])]))


# --- texels that nobody saw -----------------------------------------------------------------


@dataclass(frozen=True)
class Prior:
    """What there is to say of a texel nobody saw: p(psi) and nothing else.

    Attributes:
        p: (*grid,) probabilities of cells.
        nodes: of every axis, in order.
    """

    p: np.ndarray
    nodes: list[np.ndarray]

    @staticmethod
    def of(weights: np.ndarray, nodes: list[np.ndarray]) -> Prior:
        """Take weights of cells (*grid,), or one per node of the first axis."""
        shape = [len(axis) for axis in nodes]
        whole = np.ones(shape)
        for cell in np.ndindex(*shape):
            whole[cell] = weights[cell] if np.ndim(weights) == len(shape) else weights[cell[0]]
        return Prior(whole / whole.sum(), nodes)

    def entropy(self) -> float:
        """H over log n (Eq. 5)."""
        return entropy(self.p)

    def marginal(self, axis: int) -> np.ndarray:
        """Probabilities of the nodes of an axis."""
        return np.moveaxis(self.p, axis, 0).reshape(len(self.nodes[axis]), -1).sum(axis=1)

    def mean(self, axis: int) -> float:
        """Of a parameter."""
        return float((self.marginal(axis) * self.nodes[axis]).sum())

    def sd(self, axis: int) -> float:
        """Standard deviation of a parameter."""
        away = (self.nodes[axis] - self.mean(axis)) ** 2
        return float(np.sqrt((self.marginal(axis) * away).sum()))
