"""Eq. 13 by brute force: every truth, every cell, every view, in double precision."""

from __future__ import annotations

import numpy as np

from oracle import frequency


def entropy(distances: np.ndarray, prior: np.ndarray | None = None) -> float:
    """H of p ~ exp(-d) prior over all cells, d (N,) over 2 sigma^2 (Eq. 3, 5)."""
    prior = np.ones(len(distances)) if prior is None else prior
    p = prior * np.exp(-(distances - distances.min()))
    p = p / p.sum()
    return float(-(p[p > 0] * np.log(p[p > 0])).sum() / np.log(len(p)))


def expected(
    posterior: np.ndarray, distances: np.ndarray, prior: np.ndarray | None = None
) -> float:
    """E[H] = sum over psi_0 of p(psi_0) H(B'_psi_0) (Eq. 13).

    Args:
        posterior: (N,) p(psi | B, L).
        distances: (N, N) between photographs of psi_0 and those of psi, over 2 sigma^2.
        prior: (N,), uniform by default.
    """
    return sum(
        p * entropy(d, prior) for p, d in zip(posterior, distances, strict=True) if p > 0
    )


def radiances(lobes: np.ndarray, metallic: np.ndarray, base_color: np.ndarray) -> np.ndarray:
    """r of every cell in every view, (V, R * M * C): (1 - m) (c e + d) + m (c p + q).

    Args:
        lobes: (V, R, 4) of e, p, q, d.
        metallic: (M,) nodes.
        base_color: (C,) nodes.
    """
    views, levels, _ = lobes.shape
    cells = []
    for k in range(levels):
        for m in metallic:
            for c in base_color:
                e, p, q, d = lobes[:, k].T
                cells.append((1 - m) * (c * e + d) + m * (c * p + q))
    return np.stack(cells, axis=1).reshape(views, -1)


def angular_distances(
    r: np.ndarray, growth: float = 0.0, cosines: np.ndarray | None = None
) -> np.ndarray:
    """Mean weighted squared difference between cells, (N, N), of radiances (V, N)."""
    total = np.zeros((r.shape[1],) * 2)
    for row, cosine in zip(r, np.ones(len(r)) if cosines is None else cosines, strict=True):
        weight = cosine**2 / (1 + (growth * row) ** 2)
        total += weight[:, None] * (row[:, None] - row[None, :]) ** 2
    return total / len(r)


def spectrum_distances(
    S_L: np.ndarray, alphas: np.ndarray, Ks: np.ndarray, sigma: float
) -> np.ndarray:
    """Eq. 11 between all cells for light of power S_L (L + 1, C), over 2 sigma^2."""
    l = np.arange(len(S_L))
    shapes = np.stack([
        k**2 * np.exp(-2 * (a * l) ** 2) for a in alphas for k in Ks
    ])  # fmt: skip
    difference = shapes[:, None, 1:] - shapes[None, :, 1:]
    return np.einsum("abl,lc->ab", difference**2, S_L[1:] ** 2) / (2 * sigma**2)


def refitted_power(
    directions: np.ndarray, weights: np.ndarray, values: np.ndarray, lmax: int,
    regularizer: float, penalize_constant: bool,
) -> np.ndarray:  # fmt: skip
    """S(l) (L + 1, C) of one texel's samples (V, ...), fitted from scratch (Eq. 12, 8)."""
    fitted = frequency.fit(
        directions[None], weights[None], values[None], lmax, regularizer, penalize_constant
    )
    return frequency.power(fitted)[0]


def expected_error(
    posterior: np.ndarray, distances: np.ndarray, values: np.ndarray, present: np.ndarray
) -> float:
    """Mean over truths of the squared error of the posterior's mean, over ``present``.

    Args:
        posterior: (N,) p(psi | B, L).
        distances: (N, N), as for ``expected``.
        values: (N, A) parameters of the cells.
        present: (A,) what each squared error is relative to.
    """
    total = 0.0
    for p, d, truth in zip(posterior, distances, values, strict=True):
        likely = np.exp(-(d - d.min()))
        mean = likely @ values / likely.sum()
        total += p * float((((mean - truth) ** 2) / present).sum())
    return total
