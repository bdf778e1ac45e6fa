"""Entropy of a texel in double precision, and how far single precision may be from it.

A bound is not a number that fits: it is what the rounding of a texel's own energies does to
its entropy. For p = exp(-x) / Z, to first order,

    |dH| <= 1 / log n sum_k p_k |log p_k + H log n| |dx_k|,

so a texel whose cells are close to one another, or far apart, may be as wrong as its data
are, and no more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from oracle import angular, posterior

U = 2.0**-24  # unit roundoff of single precision
SPECTRUM = 1e-6  # of a texel's largest degree: what ``fit_sh`` promises
ROOT = 5e-6  # of a texel's radiance: the square root of the pivot that statistics drop
MIN_ALPHA = 1e-3


@dataclass(frozen=True)
class Exact:
    """Entropy of one texel in double precision, and a bound of the kernels' error."""

    entropy: float
    bound: float


def exact_entropy(
    energies: list[np.ndarray], errors: list[np.ndarray], prior: np.ndarray | None = None
) -> Exact:
    """Entropy of a joint posterior from the energies of each channel.

    Args:
        energies: per channel (rows..., cells), -log p up to a constant.
        errors: the same shapes: how wrong the kernel's energies may be before they are
            rounded to single precision.
        prior: weights of one channel's cells.
    """
    p = posterior.joint(energies, prior)
    cells, count = energies[0].shape[-1], len(energies)
    rows = energies[0].size // cells
    rounded: Any = 0.0
    for channel, (x, dx) in enumerate(zip(energies, errors, strict=True)):
        own = (rows, *(cells if k == channel else 1 for k in range(count)))
        # Offsets, exponentials, and sums over a row and over rows, one after the other.
        single = 4 * (x - x.min()) + rows + cells + 16
        rounded = rounded + (dx + U * single).reshape(own)
    weighted = posterior.of_channels(p * rounded, energies[0].shape)
    marginals = posterior.of_channels(p, energies[0].shape)
    log_n = np.log(rows * cells)
    nats = [posterior.entropy(marginals[..., k]) * log_n for k in range(count)]
    bounds = [moved(marginals[..., k], weighted[..., k], nats[k], log_n) for k in range(count)]
    # log Z and sum p x are rounded apart from each other: what they share does not cancel.
    apart = U * (rows + cells + 16 * count) / log_n
    return Exact(posterior.mean_entropy(marginals), min(float(np.mean(bounds)) + apart, 1.0))


def moved(p: np.ndarray, weighted: np.ndarray, nats: float, most: float) -> float:
    """Bound of |dH| from p and p |dx|, both of the grid's shape.

    On the way from x to x + dx, p grows by exp(2 |dx|) at most, and log p and H move by |dx|.

    Args:
        p: probabilities of cells.
        weighted: times how far their energies may move.
        nats: entropy of p.
        most: that entropy is a part of.
    """
    dx = weighted / np.where(p > 0, p, 1)
    mean = float(weighted.sum())
    distance = np.abs(np.log(np.where(p > 0, p, 1)) + nats)
    first = (weighted * (distance + 2 * (dx + mean))).sum() / most
    return float(first * np.exp(2 * min(mean, 50.0)))


def spectrum_entropy(
    S_L: np.ndarray,
    S_B: np.ndarray,
    switches: Any,
    grid: Any,
    unit: float,
    *,
    irradiance: np.ndarray | None = None,
    albedo: np.ndarray | None = None,
    prefilter: float = 0.0,
    prior: np.ndarray | None = None,
    error: float = 0.0,
) -> Exact:
    """Entropy of one texel from its spectra (Eq. 3 to 5, 7 and 11).

    Args:
        S_L: (l* + 1, C) power of the light.
        S_B: (l* + 1, C) power of the photographs.
        switches: the preset.
        grid: (roughness, Ks), or principled parameters.
        unit: power that a relative sigma is a part of.
        irradiance: (C,), for a principled grid.
        albedo: (R,) what lobes of R0 = 1 reflect of constant light; 1 by default. It is given
            like the light: tables of it are held against ``angular.albedo`` on their own.
        prefilter: alpha' of the light.
        prior: weights of the cells.
        error: of a degree's power, as a part of the largest.
    """
    S_L, S_B = S_L.astype(np.float64), S_B.astype(np.float64)
    unit = 1.0 if switches.noise == "fixed" else unit
    alphas = np.maximum(grid.roughness_nodes**2, MIN_ALPHA if switches.bounded_alpha else 0)
    prefilter = prefilter if switches.undo_prefilter else 0.0
    Kd, Ks = _reflectance(grid, np.ones(len(alphas)) if albedo is None else albedo)
    x, dx = [], []
    for c in range(S_L.shape[1]):
        E = None if irradiance is None else float(irradiance[c])
        d, wrong = _degrees(S_L[:, c], S_B[:, c], alphas, Ks, prefilter, error)
        first, first_wrong = _degree_0(S_L[0, c], S_B[0, c], E, Kd, Ks, error)
        sigma = switches.sigma * unit
        # In units of sigma: degree 0 is a radiance, with a sigma of its own.
        more = first * (sigma / (switches.constant_sigma * unit**0.5)) ** 2
        more_wrong = first_wrong * (sigma / (switches.constant_sigma * unit**0.5)) ** 2
        x.append(d + more)
        dx.append(wrong + more_wrong)
    if switches.channels == "sum":
        x, dx = [np.sum(x, axis=0)], [np.sum(dx, axis=0)]
    dx = [wrong / (2 * sigma**2) for wrong in dx]
    x = [posterior.energies(d, sigma) for d in x]
    return exact_entropy(x, dx, prior)


def angular_entropy(
    w: np.ndarray, e: np.ndarray, p: np.ndarray, q: np.ndarray, d: np.ndarray, b: np.ndarray,
    switches: Any, grid: Any, scale: float, prior: np.ndarray | None = None,
) -> Exact:  # fmt: skip
    """Entropy of one texel from its samples (Eq. 3 to 6).

    Args:
        w: (V,) weights of the views that see it.
        e: (R, C, V) diffuse shading; p, q and d alike.
        p: part of a metal's lobe that its colour, or Ks, scales.
        q: part that Fresnel adds.
        d: lobe of a dielectric.
        b: (C, V) radiance.
        switches: the preset.
        grid: (roughness, Ks), or principled parameters.
        scale: radiance that a relative sigma is a part of.
        prior: weights of the cells.
    """
    sigma = switches.sigma * (1.0 if switches.noise == "fixed" else scale)
    x, dx = [], []
    for c in range(b.shape[0]):
        samples = (w, e[:, c], p[:, c], q[:, c])
        if _is_principled(grid):
            nodes = grid.axes["metallic"], grid.axes["base_color"]
            errors = angular.principled_errors(*samples, d[:, c], b[c], *nodes)
        else:
            errors = angular.specular_errors(*samples, b[c], grid.specular_nodes)
        columns = e[:, c] + p[:, c] + np.abs(q[:, c] - d[:, c])
        root = ROOT * np.sqrt((w * (b[c] ** 2 + columns**2)).mean(axis=1).max())
        dx.append((2 * np.sqrt(errors) * root + root**2) / (2 * sigma**2))
        x.append(posterior.energies(errors, sigma))
    return exact_entropy(x, dx, prior)


def _is_principled(grid: Any) -> bool:
    return "metallic" in grid.axes


def _reflectance(grid: Any, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kd and Ks of every cell, of the grid's shape (Kd = 0 on a grid of Ks)."""
    if not _is_principled(grid):
        return np.zeros(grid.shape), np.broadcast_to(grid.specular_nodes, grid.shape)
    m, c = grid.axes["metallic"][:, None], grid.axes["base_color"][None, :]
    R0 = posterior.F0 + (c - posterior.F0) * m
    return np.broadcast_to((1 - m) * c, grid.shape), albedo[:, None, None] * R0


def _degrees(
    S_L: np.ndarray, S_B: np.ndarray, alphas: np.ndarray, Ks: np.ndarray, prefilter: float,
    error: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """d of every cell (Eq. 11), and its error if the power of a degree has one."""
    flat = Ks.reshape(len(alphas), -1)
    d = posterior.distances(S_L, S_B, alphas, flat, prefilter).reshape(Ks.shape)
    step = error * (S_B.max() + Ks**2 * S_L.max())
    # sum (r + step)^2 - r^2 over l* degrees, with |sum r| <= sqrt(l* sum r^2).
    count = len(S_L) - 1
    return d, 2 * np.sqrt(count * d) * step + count * step**2


def _degree_0(
    S_L0: float, S_B0: float, E: float | None, Kd: np.ndarray, Ks: np.ndarray, error: float
) -> tuple[np.ndarray, np.ndarray]:
    """Squared residual of degree 0 and its error, or zeros without irradiance (Eq. 7)."""
    if E is None:
        return np.zeros(Ks.shape), np.zeros(Ks.shape)
    r = np.abs(posterior.constant_residual(S_L0, S_B0, E, Kd, Ks))
    # The root of a power that is known to a part of itself, plus the rounding of E.
    step = error * (S_B0**0.5 + Ks * S_L0**0.5) + U * 2 * Kd * E
    return r**2, 2 * r * step + step**2
