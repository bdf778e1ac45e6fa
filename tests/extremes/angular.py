"""Stability of the posterior from angular statistics (Eq. 3 to 6)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from oracle.rounded_integrals import calibrated_entropies
from oracle.rounding import U, angular_entropy

from extremes.cases import Axis, Case, Found, Grid, entropies, exposures
from svu_mi.options import AngularPreset, preset
from svu_mi.posterior import (
    ParameterGrid,
    PrincipledGrid,
    angular_posterior,
    calibrated_posterior,
)
from svu_mi.statistics import Statistics
from svu_mi.statistics.factors import PAIRS

TEXELS = 4
SCALE = 0.7
KS = ParameterGrid(8, 8, "dielectric")
PRINCIPLED = PrincipledGrid(8, 8, 8)

Samples = tuple[np.ndarray, ...]
"""w (T, V), b (T, C, V), and e, p, q, d (T, R, C, V)."""


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


def statistics_of(data: Samples, counts: np.ndarray | None = None) -> Statistics:
    """What ``gather`` keeps of samples.

    Args:
        data: the samples.
        counts: (T,) how many views each texel is to have that show the same as these on average.
    """
    w, b, e, p, q, d = data
    texels, levels, _, views = e.shape
    seen = np.full(texels, views) if counts is None else counts
    w = w * seen[:, None] / max(views, 1)
    columns = e, p, q - d, d - b[:, None]
    sums = [np.einsum("tv,trcv,trcv->rct", w, columns[i], columns[j]) for i, j in PAIRS]
    return Statistics.of(np.stack(sums, axis=2), w.sum(axis=1), seen, np.linspace(0, 1, levels))


def posterior_error(
    data: Samples, switches: AngularPreset, grid: Grid, scale: float = SCALE,
    prior: np.ndarray | None = None,
) -> Found:  # fmt: skip
    """Entropy of every texel against double precision from its samples."""
    w, b, e, p, q, d = data
    found = angular_posterior(statistics_of(data), grid, scale, switches, prior=prior)
    truth = [
        angular_entropy(w[t], e[t], p[t], q[t], d[t], b[t], switches, grid, scale, prior)
        for t in range(len(w))
    ]
    bounds = np.array([x.bound for x in truth])
    return entropies(found.entropy(), [x.entropy for x in truth], bounds)


def calibrated_error(data: Samples, switches: AngularPreset, scale: float = SCALE) -> Found:
    """``posterior_error`` where noise is estimated and cells are integrated."""
    w, b, *columns = data
    found = calibrated_posterior(statistics_of(data), PRINCIPLED, scale, switches)
    truth = calibrated_entropies(w, *columns, b, found.noise, switches)
    bounds = np.array([x.bound for x in truth])
    return entropies(found.entropy(), [x.entropy for x in truth], bounds)


def rules(quick: bool = False) -> list[tuple[str, AngularPreset, Grid]]:
    """Every channel and noise rule on both grids. Weights belong to the statistics."""
    found: list[tuple[str, AngularPreset, Grid]] = []
    grids: tuple[tuple[str, Grid], ...] = (("principled", PRINCIPLED), ("specular", KS))
    for parameters, grid in grids:
        for channels in ("grey", "joint"):
            for noise in ("relative", "marginal") if quick else ("relative", "fixed", "marginal"):
                switches: Any = preset(
                    "fixed", method="angular", parameters=parameters, channels=channels,
                    noise=noise,
                )  # fmt: skip
                found.append((f"{channels}, {noise}, {parameters}", switches, grid))
    return found


def _rules(_: Path, quick: bool) -> Iterator[Case]:
    for name, switches, grid in rules(quick):
        for views in (1, 9) if quick else (1, 2, 3, 9, 60, 512):
            data = samples(20011 + views, switches.colors, views=views)
            yield f"{name}, {views} views", partial(posterior_error, data, switches, grid)
        same: Any = tuple(np.repeat(x[..., :1], 12, axis=-1) for x in data)
        yield f"{name}, 12 identical views", partial(posterior_error, same, switches, grid)
        if not quick:
            prior = np.random.default_rng(20021).random(grid.shape)
            prior[2] = 0
            yield (
                f"{name}, prior",
                partial(
                    posterior_error, samples(20023, switches.colors), switches, grid, prior=prior
                ),
            )


def _radiance(_: Path, quick: bool) -> Iterator[Case]:
    for name, switches, grid in rules(quick):
        for what, data, scale in _at_its_ends(samples(20029, switches.colors), quick):
            yield f"{name}: {what}", partial(posterior_error, data, switches, grid, scale)


def _at_its_ends(data: Samples, quick: bool) -> Iterator[tuple[str, Samples, float]]:
    """Samples of bright, black and one-sided light, and the radiance that noise is a part of."""
    w, b, e, p, q, d = data
    bright, sun = b.copy(), one_bright_view(p)
    bright[..., 4] = 1e5
    changed = {
        "black photographs": (w, 0 * b, e, p, q, d),
        "a highlight of 1e5": (w, bright, e, p, q, d),
        "a sun of 1e5": (w, b, e, sun * p, sun * q, sun * d),
        "a sun in light and photographs": (w, bright, e, sun * p, sun * q, sun * d),
        "no light": (w, b, 0 * e, 0 * p, 0 * q, 0 * d),
        "no diffuse light": (w, b, 0 * e, p, q, d),
        "no specular light": (w, b, e, 0 * p, 0 * q, 0 * d),
        "constant light": (w, 0 * b + 0.5, 0 * e + 1, 0 * p + 1, 0 * q, 0 * d + 0.04),
    }
    for what, samples_of in changed.items():
        yield what, samples_of, SCALE
    for power in (-6, 6) if quick else (-6, -3, 3, 6):
        gain = 10.0**power
        yield f"radiance times 1e{power}", exposed(data, gain), SCALE * gain


def _calibrated(_: Path, quick: bool) -> Iterator[Case]:
    for channels in ("grey", "joint"):
        switches = preset("default", method="angular", channels=channels)
        for views in (1, 9) if quick else (1, 2, 3, 9, 60, 512):
            data = samples(20077 + views, switches.colors, views=views)
            yield f"{channels}, {views} views", partial(calibrated_error, data, switches)
        same: Any = tuple(np.repeat(x[..., :1], 12, axis=-1) for x in data)
        yield f"{channels}, 12 identical views", partial(calibrated_error, same, switches)
        exact = samples(20089, switches.colors, noise=0)
        yield f"{channels}, no noise", partial(calibrated_error, exact, switches)
        for what, data, scale in _at_its_ends(samples(20101, switches.colors), quick):
            yield f"{channels}: {what}", partial(calibrated_error, data, switches, scale)
        for power in (-20, 20) if quick else (-20, -10, -1, 1, 10, 20):
            name = f"{channels}, radiance times 2^{power}, as before"
            yield name, partial(_calibrated_exposed, switches, power)


def _calibrated_exposed(switches: AngularPreset, power: int) -> Found:
    H = []
    for gain in (1.0, 2.0**power):
        data = exposed(samples(20107, switches.colors), gain)
        found = calibrated_posterior(statistics_of(data), PRINCIPLED, SCALE * gain, switches)
        H.append(np.array(found.entropy(), np.float64))
    return entropies(H[1], H[0], 4 * U)


def one_bright_view(p: np.ndarray) -> np.ndarray:
    """Gains of the shape of p's last axis: 1e5 for one view, 1 for the others."""
    gains = np.ones(p.shape[-1])
    gains[4] = 1e5
    return gains


def exposed(data: Samples, gain: float) -> Samples:
    """Light and photographs times a gain."""
    w, *radiance = data
    return w, *(gain * x for x in radiance)


def _exposure(_: Path, quick: bool) -> Iterator[Case]:
    return exposures(rules(quick), _exposed, quick)


def _exposed(switches: AngularPreset, grid: Grid, power: int) -> Found:
    H = []
    for gain in (1.0, 2.0**power):
        data = exposed(samples(20047, switches.colors), gain)
        found = angular_posterior(statistics_of(data), grid, SCALE * gain, switches)
        H.append(np.array(found.entropy(), np.float64))
    return entropies(H[1], H[0], 4 * U)


def _sigma(_: Path, quick: bool) -> Iterator[Case]:
    for noise in ("relative", "marginal"):
        for power in (-12, 12) if quick else (-12, -6, -3, -2, -1, 0, 3, 12):
            for channels in ("grey", "joint"):
                switches = preset(
                    "fixed", method="angular", noise=noise, sigma=10.0**power, channels=channels
                )
                data = samples(20051, switches.colors)
                yield (
                    f"{noise}, sigma 1e{power}, {channels}",
                    partial(posterior_error, data, switches, PRINCIPLED),
                )


def _grids(_: Path, quick: bool) -> Iterator[Case]:
    shapes = [(2, 2, 2), (5, 3, 4)] if quick else [
        (2, 2, 2), (5, 3, 4), (16, 16, 16), (64, 2, 2), (2, 64, 2), (2, 2, 64), (24, 24, 24),
    ]  # fmt: skip
    for nodes in shapes:
        data = samples(20063, 1, levels=nodes[0], texels=2)
        switches = preset("fixed", method="angular")
        grid = PrincipledGrid(*nodes)
        yield f"principled {nodes}", partial(posterior_error, data, switches, grid)
    for shape in [(2, 2)] if quick else [(2, 2), (3, 64), (64, 3), (64, 64)]:
        data = samples(20071, 1, levels=shape[0], texels=2)
        switches = preset("fixed", method="angular", parameters="specular")
        grid_of_ks = ParameterGrid(*shape, "dielectric")
        yield f"Ks {shape}", partial(posterior_error, data, switches, grid_of_ks)


AGAINST = "entropy with that of every cell in double precision"
AXES = (
    Axis("rules of the statistics", "1 to 512 views, identical ones; channel and noise rules, "
         "both grids, priors", AGAINST, _rules),
    Axis("radiance of statistics", "1e-6 to 1e6, a sun of 1e5, black, constant", AGAINST,
         _radiance),
    Axis("exposure of statistics", "2^-20 to 2^20", "entropy with that before", _exposure),
    Axis("sigma of statistics", "1e-12 to 1e12", AGAINST, _sigma),
    Axis("grids of statistics", "2 to 64 nodes", AGAINST, _grids),
    Axis("noise that is estimated", "1 to 512 views, identical ones, without noise; radiance of "
         "1e-6 to 1e6, a sun of 1e5, black, constant", "entropy with that of integrals in double "
         "precision", _calibrated),
)  # fmt: skip
