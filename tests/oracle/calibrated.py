"""The calibrated posterior in double precision, straight from its equations.

    log p(psi | b) = -Q(psi) / (2 s^2 tau) + log p(psi),   Q = sum of w (r - b)^2 over all samples

with r - b = c u + v linear in base colour, u = (1 - m) e + m p and v = m (q - d) + d - b.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats
from scipy.special import log_ndtr

from oracle.levels import place as place_of

PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]


@dataclass(frozen=True)
class Samples:
    """Columns e, p, q, d (S, R, V, C) at R levels of roughness, radiance b (S, V, C), weights w."""

    e: np.ndarray
    p: np.ndarray
    q: np.ndarray
    d: np.ndarray
    b: np.ndarray
    w: np.ndarray

    def error(self, level: int, metallic: np.ndarray, color: np.ndarray) -> np.ndarray:
        """Q at a level, (S,): metallic (S,), colour (S, C)."""
        m, c = metallic[:, None, None], color[:, None, :]
        e, p, q, d = (x[:, level] for x in (self.e, self.p, self.q, self.d))
        r = (1 - m) * (c * e + d) + m * (c * p + q)
        return (self.w[..., None] * (r - self.b) ** 2).sum(axis=(1, 2))

    def sums(self) -> np.ndarray:
        """Sums (R, C, 10, S) of products of the columns e, p, q - d, d - b."""
        x = [self.e, self.p, self.q - self.d, self.d - self.b[:, None]]
        w = self.w[:, None, :, None]
        return np.stack([(w * x[i] * x[j]).sum(axis=2) for i, j in PAIRS], axis=1).transpose(
            2, 3, 1, 0
        )


def factors(sums: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """U (R, C, S, 4, 4) of U^T U = sums / weight, upper triangular, U_44^2 replaced by what it has
    above the least of all levels; and that least (C, S)."""
    levels, channels, _, count = sums.shape
    M = np.zeros((levels, channels, count, 4, 4))
    for k, (i, j) in enumerate(PAIRS):
        M[..., i, j] = M[..., j, i] = sums[:, :, k] / weight
    U = np.swapaxes(np.linalg.cholesky(M), -1, -2).copy()
    square = U[..., 3, 3] ** 2
    least = square.min(axis=0)
    U[..., 3, 3] = square - least
    return U, least


def between_levels(U: np.ndarray, roughness: float) -> np.ndarray:
    """Interpolate by a Catmull-Rom spline; the first level is repeated, and a parabola through
    the last three continues."""
    last = len(U) - 1
    place = float(place_of(roughness, len(U)))
    k = min(int(place), last - 1)
    t = place - k
    a, b, c, d = (U[min(max(k + step, 0), last)] for step in (-1, 0, 1, 2))
    d = a - 3 * b + 3 * c if 0 < k == last - 1 else d
    forms = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    forms[..., 3, 3] = np.maximum(forms[..., 3, 3], 0)
    return forms


def channel(U: np.ndarray, metallic: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C of |U x|^2 = A c^2 + 2 B c + C, less what no level explains: arrays (C, S)."""
    e, p, g, t = (U[..., k].copy() for k in range(4))
    floor = t[..., 3].copy()
    t[..., 3] = 0
    u, v = (1 - metallic) * e + metallic * p, metallic * g + t
    return (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1) + floor


def normal_on(low: np.ndarray, high: np.ndarray, mu: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """log of the probability that a normal variable is in [low, high]."""
    a, b = (low - mu) / sd, (high - mu) / sd
    flip = a + b > 0
    a, b = np.where(flip, -b, a), np.where(flip, -a, b)
    small, large = log_ndtr(a), log_ndtr(b)
    return large + np.log1p(-np.exp(np.minimum(small - large, -1e-300)))


@dataclass(frozen=True)
class Nodes:
    """Parts of a parameter: ends (N,), prior (N,) of sum 1, cell of the grid (N,)."""

    low: np.ndarray
    high: np.ndarray
    prior: np.ndarray
    cell: np.ndarray

    @property
    def value(self) -> np.ndarray:
        """Middle of each part."""
        return (self.low + self.high) / 2


def even(parts: int, cells: int = 8) -> Nodes:
    """Equal parts of [0, 1]; a cell is what is nearest to one of its nodes."""
    edges = np.linspace(0, 1, parts + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    cell = np.floor(middle * (cells - 1) + 0.5).astype(int)
    return Nodes(edges[:-1], edges[1:], np.full(parts, 1 / parts), cell)


def mixed(parts: int, metals: float, cells: int = 8, share: float = 0.5) -> Nodes:
    """0 and 1 with ``metals`` together, of which 1 has ``share``; equal parts between."""
    x = even(parts, cells)
    return Nodes(
        np.concatenate([[0], x.low, [1]]), np.concatenate([[0], x.high, [1]]),
        np.concatenate([[metals * (1 - share)], (1 - metals) * x.prior, [metals * share]]),
        np.concatenate([[0], x.cell, [cells - 1]]),
    )  # fmt: skip


def metal_color(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Probability of a channel of a metal's base colour: half Beta, half uniform from 0.06.

    The thirty reflectances of ten metals have the mean .677867 and the standard deviation .178010.
    """
    bare = stats.beta(3.993425, 1.897741)
    dull = stats.uniform(0.06, 0.94)
    return (bare.cdf(high) - bare.cdf(low) + dull.cdf(high) - dull.cdf(low)) / 2


def bright_metals(r: Nodes, m: Nodes, cells: int = 8, channels: int = 3) -> np.ndarray:
    """Prior (R, M, K, C) of cells: base colour of metals, of dielectrics, and in between."""
    rows = np.outer(np.bincount(r.cell, r.prior), np.bincount(m.cell, m.prior))
    edges = np.concatenate([[0], (np.arange(cells - 1) + 0.5) / (cells - 1), [1]])
    metallic = np.arange(cells)[:, None] / (cells - 1)
    metal = metal_color(edges[:-1], edges[1:])
    color = (1 - metallic) * np.diff(edges) + metallic * metal
    return np.repeat((rows[..., None] * color)[..., None], channels, axis=-1)


@dataclass(frozen=True)
class Truth:
    """What is asked of S texels: probabilities (S, R, M, K, C) of cells, masses of parts (N, S),
    means and standard deviations (S,) or (S, C), s (S,)."""

    cells: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    mean: dict[str, np.ndarray]
    sd: dict[str, np.ndarray]
    noise: np.ndarray

    def entropy(self, prior: np.ndarray) -> np.ndarray:
        """Eq. 5, of cells, mean over channels, over that of the prior."""
        p = np.maximum(self.cells, 1e-300)
        nats = -(p * np.log(p)).sum(axis=(1, 2, 3)).mean(axis=-1)
        q = np.maximum(prior, 1e-300)
        return np.clip(nats / -(q * np.log(q)).sum(), 0, 1)


def common_prior(
    sums: np.ndarray, weight: np.ndarray, views: np.ndarray, alone: np.ndarray, *, rounds: int,
    sharpness: float, otherwise: float, likely: np.ndarray | float = 1.0, **options: Any,
) -> np.ndarray:  # fmt: skip
    """Expectation maximisation: the prior (R, M, K, C) is the mean of the posteriors it leads to,
    sharpened by a power, with some room for texels unlike all others. Weights ``likely`` of cells
    (T, R, M, K, C) stand for what a texel's neighbours show."""

    def mean_under(prior: np.ndarray | None) -> np.ndarray:
        cells = posterior(sums, weight, views, prior=prior, **options).cells * likely
        return (cells / cells.sum(axis=(1, 2, 3), keepdims=True)).mean(axis=0)

    prior = None
    for _ in range(rounds):
        mean = mean_under(prior) ** sharpness
        mixed = (1 - otherwise) * mean / mean.sum(axis=(0, 1, 2)) + otherwise * alone[..., None]
        of_rows = mixed.sum(axis=2, keepdims=True)
        given = (1 - otherwise) * mixed / of_rows
        given += otherwise * (alone / alone.sum(axis=2, keepdims=True))[..., None]
        prior = given * of_rows.mean(axis=-1, keepdims=True)
    return prior


def posterior(
    sums: np.ndarray, weight: np.ndarray, views: np.ndarray, *, tau: float, nu: float,
    r: Nodes, m: Nodes, cells: int = 8, prior: np.ndarray | None = None,
) -> Truth:  # fmt: skip
    """Integrate over roughness and metallic node by node, over colour in closed form.

    A prior (R, M, K, C) of cells by channel takes the place of the nodes' and of even colours.
    """
    U, least = factors(sums, weight)
    channels, count = least.shape
    A, B, C = (np.empty((len(r.value), len(m.value), channels, count)) for _ in range(3))
    for i, roughness in enumerate(r.value):
        at = between_levels(U, roughness)
        for j, metallic in enumerate(m.value):
            A[i, j], B[i, j], C[i, j] = channel(at, metallic)
    best = np.clip(-B / np.maximum(A, 1e-300), 0, 1)
    energy = (A * best**2 + 2 * B * best + C).sum(axis=2)
    q_min = weight * (energy.min(axis=(0, 1)) + least.sum(axis=0))
    if views.min() < 8:
        raise NotImplementedError("noise from fewer than 8 views, which tell it in part")
    own = views * channels - 5
    usual = max(np.median(q_min / own), 1e-6)
    s2 = np.maximum((nu * usual + q_min) / (nu + own), 1e-6)
    scale = weight / (s2 * tau)
    A, B, C = A * scale, B * scale, C * scale
    mu, sd = -B / A, 1 / np.sqrt(A)
    edges = np.concatenate([[0], (np.arange(cells - 1) + 0.5) / (cells - 1), [1]])
    inside = normal_on(np.zeros_like(mu), np.ones_like(mu), mu, sd)
    given = even_parts = np.stack([
        np.exp(normal_on(np.full_like(mu, a), np.full_like(mu, b), mu, sd) - inside)
        for a, b in zip(edges[:-1], edges[1:], strict=True)
    ])  # fmt: skip
    log_weight = (inside + np.log(sd) - 0.5 * (C - B * B / A)).sum(axis=2)
    log_weight += np.log(r.prior)[:, None, None] + np.log(m.prior)[:, None]
    density = np.ones((1, 1, cells, 1, 1))
    if prior is not None:
        rows = prior.sum(axis=2).mean(axis=-1)
        density = prior / prior.sum(axis=2, keepdims=True) / np.diff(edges)[:, None]
        density = density[r.cell][:, m.cell][..., None]
        masses = given * np.moveaxis(density, 2, 0)
        log_weight += np.log(masses.sum(axis=0)).sum(axis=2)
        usual = np.bincount(r.cell, r.prior)[r.cell][:, None] * np.bincount(m.cell, m.prior)[m.cell]
        log_weight += np.log(rows[r.cell][:, m.cell] / usual)[..., None]
        given = masses / masses.sum(axis=0)
    w = np.exp(log_weight - log_weight.max(axis=(0, 1)))
    w /= w.sum(axis=(0, 1))
    p = np.zeros((count, cells, cells, cells, channels))
    for i, j in np.ndindex(w.shape[:2]):
        p[:, r.cell[i], m.cell[j]] += w[i, j, :, None, None] * given[:, i, j].transpose(2, 0, 1)
    x = (edges[:, None, None, None, None] - mu) / sd  # of the normal that even colours have
    height = np.exp(-0.5 * x * x - 0.5 * np.log(2 * np.pi) - inside)
    density = np.moveaxis(density, 2, 0)
    total = (density * even_parts).sum(axis=0)
    off = -sd * (density * np.diff(height, axis=0)).sum(axis=0) / total
    square = sd**2 * (1 - (density * np.diff(x * height, axis=0)).sum(axis=0) / total)
    color, spread = mu + off, square - off**2
    mean, variance = {}, {}
    for name, nodes, marginal in (
        ("roughness", r, w.sum(axis=1)), ("metallic", m, w.sum(axis=0)),
    ):  # fmt: skip
        x, within = nodes.value[:, None], (nodes.high - nodes.low)[:, None] ** 2 / 12
        mean[name] = (marginal * x).sum(axis=0)
        variance[name] = (marginal * ((x - mean[name]) ** 2 + within)).sum(axis=0)
    mean["base_color"] = np.einsum("rms,rmcs->sc", w, color)
    off = color - mean["base_color"].T
    variance["base_color"] = np.einsum("rms,rmcs->sc", w, spread + off**2)
    return Truth(
        p, w.sum(axis=1), w.sum(axis=0), mean,
        {name: np.sqrt(np.maximum(v, 0)) for name, v in variance.items()}, np.sqrt(s2),
    )  # fmt: skip
