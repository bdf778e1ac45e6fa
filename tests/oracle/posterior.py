"""Eq. 3, 5 and 11 by brute force: every cell of the grid, one after the other."""

from __future__ import annotations

import itertools

import numpy as np


def nodes(roughness: int, specular: int, spacing: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of roughness and Ks."""
    t = np.linspace(0, 1, specular)
    return np.linspace(0, 1, roughness), t if spacing == "uniform" else 0.04 + 0.96 * t**2


def model(S_L: np.ndarray, Ks: float, alpha: float, prefilter: float = 0.0) -> np.ndarray:
    """Ks^2 exp(-2 (alpha l)^2) S_L(l) for l = 0 ... L on the last axis (Eq. 11)."""
    l = np.arange(S_L.shape[-1])
    return Ks**2 * np.exp(-2 * max(alpha**2 - prefilter**2, 0) * l**2) * S_L


def distances(
    S_L: np.ndarray, S_B: np.ndarray, alphas: np.ndarray, Ks: np.ndarray, prefilter: float = 0.0
) -> np.ndarray:
    """d of one texel and channel (L + 1,) on the grid, (R, S): l = 0 takes no part (Eq. 11)."""
    d = np.zeros((len(alphas), len(Ks)))
    for i, j in itertools.product(range(len(alphas)), range(len(Ks))):
        difference = S_B - model(S_L, Ks[j], alphas[i], prefilter)
        d[i, j] = (difference[1:] ** 2).sum()
    return d


def normalize(energy: np.ndarray, prior: np.ndarray | float = 1.0) -> np.ndarray:
    """exp(-energy) prior, summing to 1; relative to the best cell that the prior allows."""
    prior = np.broadcast_to(prior, energy.shape)
    allowed = np.where(prior > 0, energy, np.inf)
    p = np.exp(-(allowed - allowed.min())) * prior
    return p / p.sum()


def entropy(p: np.ndarray) -> float:
    """H = -1 / log n * sum p log p (Eq. 5)."""
    positive = p[p > 0]
    return float(-(positive * np.log(positive)).sum() / np.log(p.size))
