"""Eq. 13 by brute force: every truth, every cell, every view, in double precision."""

from __future__ import annotations

from dataclasses import dataclass

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
    return sum(p * entropy(d, prior) for p, d in zip(posterior, distances, strict=True) if p > 0)


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


def printed(
    S_B: np.ndarray | None, S_L: np.ndarray, alphas: np.ndarray, Ks: np.ndarray, sigma: float,
    prior: np.ndarray | None = None,
) -> float:  # fmt: skip
    """E[H] = sum over psi of p(psi | B, L') H(B'_psi, L') of one texel, all with L' (Eq. 13).

    Args:
        S_B: (L + 1, C) power of the photographs that there are; None if none shows the texel.
        S_L: (L + 1, C) power of L', the light of the views so far and the candidate.
        alphas: (R,).
        Ks: (S,).
        sigma: of a degree's power.
        prior: (R S,), uniform by default.
    """
    p = np.ones(len(alphas) * len(Ks)) if prior is None else np.array(prior, np.float64)
    if S_B is not None:
        d = np.zeros(len(p))
        for cell, (a, k) in enumerate((a, k) for a in alphas for k in Ks):
            for l in range(1, len(S_L)):
                model = k**2 * np.exp(-2 * (a * l) ** 2) * S_L[l]
                d[cell] += ((S_B[l] - model) ** 2).sum()
        d /= 2 * sigma**2
        p[p > 0] *= np.exp(-(d[p > 0] - d[p > 0].min()))
    return expected(p / p.sum(), spectrum_distances(S_L, alphas, Ks, sigma), prior)


def refitted_power(
    directions: np.ndarray, weights: np.ndarray, values: np.ndarray, lmax: int,
    regularizer: float, penalize_constant: bool,
) -> np.ndarray:  # fmt: skip
    """S(l) (L + 1, C) of one texel's samples (V, ...), fitted from scratch (Eq. 12, 8)."""
    fitted = frequency.fit(
        directions[None], weights[None], values[None], lmax, regularizer, penalize_constant
    )
    return frequency.power(fitted)[0]


QUADRATURE = 5600  # colours that an integral over [0, 1] is summed over; 5 and 8 cells divide it


@dataclass(frozen=True)
class Angular:
    """What the angular forecast is about, for one texel: R levels, M metallic, C channels.

    Attributes:
        lobes: (V, R, L, 4) of e, p, q, d; L is C, or 1 of grey light.
        metallic: (M,) nodes.
        prior: (R * M, K) of cells, of sum 1.
        precision, kappa, averaged: of the energies.
        colors: (K,) nodes, or None: integrated, in K cells.
        copies: how many equal channels each stands for.
    """

    lobes: np.ndarray
    metallic: np.ndarray
    prior: np.ndarray
    precision: float = 1.0
    kappa: float = np.inf
    averaged: bool = False
    colors: np.ndarray | None = None
    copies: int = 1

    def lines(self, channels: int) -> tuple[np.ndarray, np.ndarray]:
        """Slope and value at 0 of radiance over base colour, (V, R * M, C) both."""
        e, p, q, d = np.moveaxis(self.lobes[:, :, None], -1, 0)
        m = self.metallic[:, None]
        shape = (len(self.lobes), -1, self.lobes.shape[2])
        both = [((1 - m) * e + m * p).reshape(shape), ((1 - m) * d + m * q).reshape(shape)]
        slope, base = (np.broadcast_to(x, (*x.shape[:2], channels)) for x in both)
        return slope, base

    def rows(self, truth: int, color: np.ndarray) -> tuple[np.ndarray, ...]:
        """Weight (R * M,) of every row, not normalised, and entropy, mean and variance
        (R * M, C) of its colours, if a row of a colour (C,) is the truth."""
        slope, base = self.lines(len(color))
        shown = slope[:, truth] * color + base[:, truth]
        w = self.precision / (1 + (shown.mean(axis=1) / self.kappa) ** 2)
        K = self.prior.shape[1]
        if self.colors is None:
            c = (np.arange(QUADRATURE) + 0.5) / QUADRATURE
            usual = np.concatenate([[0.5], np.ones(K - 2), [0.5]]) / (K - 1)
            cell = np.floor(c * (K - 1) + 0.5).astype(int)
        else:
            c, usual, cell = self.colors, np.ones(K), np.arange(K)
        rows = []
        for row, prior in enumerate(self.prior):
            off = shown[..., None] - slope[:, row, :, None] * c - base[:, row, :, None]
            E = (w[:, None, None] * off**2).sum(axis=0) / (len(w) if self.averaged else 1)
            given = (prior / max(prior.sum(), 1e-300) / usual)[cell] / len(c)
            z = given * np.exp(-E)
            mass = np.maximum(z.sum(axis=1), 1e-300)
            p = z / mass[:, None]
            nats = plogp(np.stack([p[:, cell == k].sum(axis=1) for k in range(K)], axis=1))
            mean = p @ c
            rows.append((prior.sum() * mass.prod() ** self.copies, nats, mean,
                          p @ c**2 - mean**2))  # fmt: skip
        return tuple(np.array(x) for x in zip(*rows, strict=True))

    def entropy(self, truth: int, color: np.ndarray) -> float:
        """H in nats of photographs of a truth, mean over channels."""
        weight, nats, *_ = self.rows(truth, color)
        p = weight / weight.sum()
        return float(plogp(p[None])[0] + p @ nats.mean(axis=1))

    def variance(self, truth: int, color: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Variance of roughness, metallic and base colour, the mean over channels: (3,).

        Args:
            truth: row.
            color: (C,).
            values: (R * M, 2) roughness and metallic of the rows.
        """
        weight, _, mean, variance = self.rows(truth, color)
        p = weight / weight.sum()
        x = np.concatenate([values, mean], axis=1)
        spread = np.concatenate([0 * values, variance], axis=1)
        total = p @ (x**2 + spread) - (p @ x) ** 2
        return np.array([total[0], total[1], total[2:].mean()])


def plogp(p: np.ndarray) -> np.ndarray:
    """Entropy of probabilities (..., N) in nats."""
    return -(p * np.log(np.where(p > 0, p, 1))).sum(axis=-1)
