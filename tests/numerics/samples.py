"""Random samples of fits, spectra and statistics, and what may differ from double precision."""

from __future__ import annotations

from typing import Any

import numpy as np
from oracle.levels import levels as levels_of
from oracle.rounded_integrals import calibrated_entropies
from oracle.rounding import angular_entropy

from svu_mi.posterior.angular import angular_posterior
from svu_mi.posterior.calibrated import calibrated_posterior
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.presets import preset
from svu_mi.statistics.cholesky_factors import PAIRS
from svu_mi.statistics.statistics import Statistics

TEXELS = 4
SCALE = 0.7
GRID = PrincipledGrid(8, 8, 8)
FIXED = preset("fixed", method="angular")
ESTIMATED = preset("default", method="angular", bare_metals=0.0)

Samples = tuple[np.ndarray, ...]
"""w (T, V), b (T, C, V), and e, p, q, d (T, R, C, V)."""


def assert_within(ours: Any, truth: Any, bounds: Any) -> None:
    """Fail for a NaN, and for an error above its bound."""
    errors = np.abs(np.asarray(ours, np.float64) - np.asarray(truth, np.float64))
    bounds = np.broadcast_to(np.asarray(bounds, np.float64), errors.shape)
    wrong = ~(errors <= bounds)
    assert not wrong.any(), (errors[wrong].max(), bounds[wrong].min())


def assert_entropy(ours: Any, truth: Any, bounds: Any) -> None:
    """Fail for an entropy outside [0, 1], too."""
    H = np.array(ours, np.float64)
    assert ((H >= 0) & (H <= 1)).all()  # NaN is neither
    assert_within(H, truth, bounds)


# --- statistics -----------------------------------------------------------------------------


def samples(
    seed: int, channels: int, levels: int = 8, views: int = 9, texels: int = TEXELS,
    noise: float = 0.1, truth: tuple[int, float, float] | None = None,
) -> Samples:  # fmt: skip
    """Samples of texels with a roughness among the levels.

    Args:
        seed: of everything.
        channels: C.
        levels: R.
        views: V.
        texels: T.
        noise: of the photographs, a part of their radiance.
        truth: (level, metallic, base colour) of all texels; random ones by default.
    """
    rng = np.random.default_rng(seed)
    e = rng.random((texels, 1, channels, 1)) * (0.8 + 0.4 * rng.random((texels, levels, 1, views)))
    s = rng.exponential(size=(texels, levels, channels, views))
    f = 0.3 * rng.random((texels, 1, 1, views))
    p, q, d = s * (1 - f), s * f, s * (0.04 + f * rng.random((texels, 1, 1, views)))
    level, m, c = rng.integers(0, levels, texels), *rng.random((2, texels, channels, 1))
    m = m[:, :1]
    if truth is not None:
        level[:], m[:], c[:] = truth
    own = np.arange(texels), level
    b = (1 - m) * (c * e[own] + d[own]) + m * (c * p[own] + q[own])
    b *= np.exp(noise * rng.normal(size=(texels, 1, views)))
    return np.ones((texels, views)), b, e, p, q, d


def pick(data: Samples, views: Any) -> Samples:
    """The samples of some views."""
    return tuple(x[..., views] for x in data)


def exposed(data: Samples, gain: float) -> Samples:
    """Light and photographs times a gain."""
    w, *radiance = data
    return w, *(gain * x for x in radiance)


def statistics_of(data: Samples, between: bool = False) -> Statistics:
    """What ``gather`` keeps of samples, at nodes of the grid or levels to look ``between``."""
    w, b, e, p, q, d = data
    _, levels, _, views = e.shape
    columns = e, p, q - d, d - b[:, None]
    sums = [np.einsum("tv,trcv,trcv->rct", w, columns[i], columns[j]) for i, j in PAIRS]
    seen = np.full(len(w), views)
    roughness = levels_of(levels) if between else np.linspace(0, 1, levels)
    return Statistics.of(np.stack(sums, axis=2), w.sum(axis=1), seen, roughness)


def posterior_of(
    data: Samples, switches: Any = FIXED, grid: Any = GRID, scale: float = SCALE,
    prior: np.ndarray | None = None,
) -> Any:  # fmt: skip
    """The posterior of samples: with a noise that is given, or estimated."""
    statistics = statistics_of(data, switches.noise == "estimated")
    if switches.noise == "estimated":
        return calibrated_posterior(statistics, grid, scale, switches)
    return angular_posterior(statistics, grid, scale, switches, prior=prior)


def entropy_of(data: Samples, *how: Any, **options: Any) -> np.ndarray:
    """Entropy (T,) of ``posterior_of``."""
    return np.array(posterior_of(data, *how, **options).entropy(), np.float64)


def exact_entropy(
    data: Samples, switches: Any = FIXED, grid: Any = GRID, scale: float = SCALE,
    prior: np.ndarray | None = None, noise: np.ndarray | None = None,
) -> list[Any]:  # fmt: skip
    """Entropy in double precision and its bound, per texel."""
    w, b, *columns = data
    if noise is not None:
        return calibrated_entropies(w, *columns, b, noise, switches)
    return [
        angular_entropy(w[t], *(x[t] for x in columns), b[t], switches, grid, scale, prior)
        for t in range(len(w))
    ]


def bounds_of(data: Samples, switches: Any = FIXED, scale: float = SCALE) -> np.ndarray:
    """How far the kernels may be from double precision, per texel."""
    return np.array([x.bound for x in exact_entropy(data, switches, scale=scale)])


def noise_of(posterior: Any) -> np.ndarray:
    """The noise that was estimated, per lane."""
    return posterior.kernel.noise


# --- spectra and fits -----------------------------------------------------------------------

DEGREE = 6


def metals(
    rng: np.random.Generator, texels: int, channels: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Light, and what random metals make of it with 5 % noise: (T, DEGREE + 1, C) float32."""
    l = np.arange(DEGREE + 1)[:, None]
    S_L = rng.exponential(size=(texels, DEGREE + 1, channels)) * 10 * np.exp(-0.5 * l)
    alpha, Ks = rng.random((texels, 1, 1)) ** 2, rng.random((texels, 1, channels))
    S_B = S_L * Ks**2 * np.exp(-2 * (alpha * l) ** 2)
    S_B *= np.exp(0.05 * rng.normal(size=S_B.shape))
    return S_L.astype(np.float32), S_B.astype(np.float32)


def spectra(seed: int, channels: int, texels: int = TEXELS) -> tuple[np.ndarray, np.ndarray]:
    """``metals`` by seed."""
    return metals(np.random.default_rng(seed), texels, channels)


def placed(rng: np.random.Generator, kind: str, texels: int, views: int) -> np.ndarray:
    """Directions to cameras (T, V, 3) above +z, float32."""
    d = rng.normal(size=(texels, views, 3))
    d[..., 2] = np.abs(d[..., 2])
    if kind == "identical":
        d[:] = d[:, :1]
    elif kind == "in a plane":  # through the texel: one great circle
        d[..., 1] = 0
    elif kind == "on a line":  # cameras along a straight track
        d[..., :] = [0.2, 0.1, 1] + 4 * rng.normal(size=(texels, views, 1)) * [1.0, 0.3, 0.05]
        d[..., 2] = np.abs(d[..., 2])
    elif kind == "grazing":  # cos theta = 1e-4
        d[..., 2] = 1e-4 * np.linalg.norm(d[..., :2], axis=-1)
    elif kind == "crowded":  # within a thousandth of a radian
        d = [0.3, 0.2, 1] + 1e-3 * rng.normal(size=d.shape)
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


def fit_samples(
    seed: int, views: int, kind: str = "spread", channels: int = 3, texels: int = 6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions, weights (cosines) and positive values with a spread of e."""
    rng = np.random.default_rng(seed)
    d = placed(rng, kind, texels, views)
    f = np.exp(rng.normal(size=(texels, views, channels)))
    return d, d[..., 2].copy(), f.astype(np.float32)
