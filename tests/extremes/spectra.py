"""Stability of the posterior from power spectra (Eq. 3, 5, 7 and 11)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from oracle.rounding import U, spectrum_entropy

from extremes.cases import Axis, Case, Found, Grid, entropies, exposures
from svu_mi.options import Preset, preset
from svu_mi.posterior import ParameterGrid, PrincipledGrid, spectrum_posterior
from svu_mi.reflection.lobes import mean_albedo
from svu_mi.reflection.principled import MIN_ALPHA

L = 6
TEXELS = 4
KS = ParameterGrid(8, 8)
PRINCIPLED = PrincipledGrid(8, 8, 8)


def metals(
    rng: np.random.Generator, texels: int, channels: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Light, and what random metals make of it with 5 % noise: (T, L + 1, C) float32."""
    l = np.arange(L + 1)[:, None]
    S_L = rng.exponential(size=(texels, L + 1, channels)) * 10 * np.exp(-0.5 * l)
    alpha, Ks = rng.random((texels, 1, 1)) ** 2, rng.random((texels, 1, channels))
    S_B = S_L * Ks**2 * np.exp(-2 * (alpha * l) ** 2)
    S_B *= np.exp(0.05 * rng.normal(size=S_B.shape))
    return S_L.astype(np.float32), S_B.astype(np.float32)


def spectra(seed: int, channels: int, texels: int = TEXELS) -> tuple[np.ndarray, np.ndarray]:
    """``metals`` by seed."""
    return metals(np.random.default_rng(seed), texels, channels)


def irradiance(seed: int, channels: int, texels: int = TEXELS) -> np.ndarray:
    """(T, C) float32."""
    values = np.random.default_rng(seed).random((texels, channels)) * 3
    return values.astype(np.float32)


def posterior_error(
    S_L: np.ndarray, S_B: np.ndarray, switches: Preset, grid: Grid, *, counts: Any = None,
    E: np.ndarray | None = None, prior: np.ndarray | None = None,
) -> Found:  # fmt: skip
    """Entropy of every texel against double precision."""
    views = np.full(len(S_L), 20) if counts is None else np.asarray(counts)
    E = E if isinstance(grid, PrincipledGrid) else None
    if isinstance(grid, ParameterGrid):
        grid = grid.resolved(switches)
    unit = float(S_B.astype(np.float64).sum(axis=1).mean())
    unit = unit or 1e-4 * float(S_L.astype(np.float64).sum(axis=1).mean()) or 1.0
    found = spectrum_posterior(
        S_L, S_B, grid, preset=switches, samples=views, prior=prior, prefilter=0.3, irradiance=E
    )
    truth = [
        spectrum_entropy(
            S_L[t], S_B[t], switches, grid, unit, samples=float(views[t]), prefilter=0.3,
            irradiance=None if E is None else E[t], prior=prior, albedo=albedo_of(switches, grid),
        )
        for t in range(len(S_L))
    ]  # fmt: skip
    bounds = np.array([x.bound for x in truth])
    return entropies(found.entropy(), [x.entropy for x in truth], bounds)


def albedo_of(switches: Preset, grid: Grid) -> np.ndarray | None:
    """Return what the lobes of R0 = 1 reflect, by the kernels' own table: its truth is another
    test's (tests/test_lobes.py)."""
    if not switches.albedo or isinstance(grid, ParameterGrid):
        return None
    return mean_albedo(np.maximum(grid.roughness_nodes**2, MIN_ALPHA))


def rules(quick: bool = False) -> list[tuple[str, Preset, Grid]]:
    """Every preset, channel rule and noise rule, on the grids that they take."""
    found: list[tuple[str, Preset, Grid]] = [("paper", preset("paper"), KS)]
    plain = preset("default")
    for grid in (KS, PRINCIPLED):
        kind = "Ks" if grid is KS else "principled"
        for channels in ("grey", "joint") if grid is PRINCIPLED else (
            "grey", "sum", "joint", "minimum"
        ):  # fmt: skip
            for noise in ("relative", "marginal") if quick else ("fixed", "relative", "marginal"):
                switches: Any = replace(plain, channels=channels, noise=noise, sigma=0.02)
                found.append((f"{channels}, {noise}, {kind}", switches, grid))
    if not quick:
        found.append(("fast, principled", preset("fast", channels="joint"), PRINCIPLED))
        undone = preset("paper", undo_prefilter=True, channels="joint")
        found.append(("paper, joint, light as it was", undone, KS))
    return found


def _presets(_: Path, quick: bool) -> Iterator[Case]:
    for name, switches, grid in rules(quick):
        S_L, S_B = spectra(10007, switches.colors)
        E = irradiance(10009, switches.colors)
        counts = [0, 1, 7, 300]
        yield name, partial(posterior_error, S_L, S_B, switches, grid, counts=counts, E=E)
        if not quick:
            prior = np.random.default_rng(10037).random(grid.shape)
            prior[2] = 0
            yield (
                f"{name}, prior",
                partial(posterior_error, S_L, S_B, switches, grid, counts=counts, E=E, prior=prior),
            )


def _exposure(_: Path, quick: bool) -> Iterator[Case]:
    return exposures(rules(quick), _exposed, quick)


def _exposed(switches: Preset, grid: Grid, power: int) -> Found:
    S_L, S_B = spectra(10061, switches.colors)
    E = irradiance(10067, switches.colors)
    H = []
    for gain in (np.float32(1), np.float32(2.0**power)):
        found = spectrum_posterior(
            S_L * gain**2, S_B * gain**2, grid, preset=switches, samples=np.full(TEXELS, 20),
            irradiance=E * gain if isinstance(grid, PrincipledGrid) else None,
        )  # fmt: skip
        H.append(np.array(found.entropy(), np.float64))
    return entropies(H[1], H[0], 4 * U)


def _contrast(_: Path, quick: bool) -> Iterator[Case]:
    """Light that is nothing but a sun, black, constant; photographs that are black or blown."""
    chosen = [r for r in rules(True) if r[1].noise == "relative" or r[0] == "paper"]
    for name, switches, grid in chosen[:3] if quick else chosen:
        S_L, S_B = spectra(10079, switches.colors)
        E = irradiance(10091, switches.colors)
        l0 = (np.arange(L + 1) == 0)[:, None].astype(np.float32)
        changed = {
            "a sun of 1e5": (S_L * np.float32(1e10), S_B),
            "a highlight of 1e5": (S_L, S_B * np.float32(1e10)),
            "one texel at 4096 times the others": (S_L, S_B * _one(4096.0**2)),
            "no light": (0 * S_L, S_B),
            "black photographs": (S_L, 0 * S_B),
            "neither": (0 * S_L, 0 * S_B),
            "constant light": (S_L * l0, S_B * l0),
            "constant light, sharp photographs": (S_L * l0, S_B),
            "2^-100": (S_L * np.float32(2.0**-100), S_B * np.float32(2.0**-100)),
            "2^100": (S_L * np.float32(2.0**100), S_B * np.float32(2.0**100)),
        }
        for what, (light, seen) in changed.items():
            yield f"{name}: {what}", partial(posterior_error, light, seen, switches, grid, E=E)


def _one(gain: float) -> np.ndarray:
    values = np.ones((TEXELS, 1, 1), np.float32)
    values[1] = gain
    return values


def _sigma(_: Path, quick: bool) -> Iterator[Case]:
    for noise in ("fixed", "relative", "marginal"):
        for power in (-30, -3, 30) if quick else (-30, -12, -6, -3, -1, 0, 3, 12, 30):
            for channels, grid in (("grey", PRINCIPLED), ("joint", KS)):
                switches = preset("default", noise=noise, sigma=10.0**power, channels=channels)
                S_L, S_B = spectra(10093, switches.colors)
                E = irradiance(10099, switches.colors)
                yield (
                    f"{noise}, sigma 1e{power}, {channels}",
                    partial(posterior_error, S_L, S_B, switches, grid, E=E, counts=[1, 3, 60, 512]),
                )


def _grids(_: Path, quick: bool) -> Iterator[Case]:
    S_L, S_B = spectra(10103, 3, 2)
    E = irradiance(10111, 3, 2)
    for n in (2, 33) if quick else (2, 3, 5, 8, 16, 33, 64):
        for switches in (preset("paper"), preset("default", channels="joint", sigma=0.02)):
            shape = ParameterGrid(n, n if switches.name == "paper" else min(n, 8))
            yield (
                f"{switches.name}, {shape.shape}",
                partial(posterior_error, S_L, S_B, switches, shape),
            )
    shapes = [(2, 2, 2), (5, 3, 4)] if quick else [
        (2, 2, 2), (3, 3, 3), (5, 3, 4), (16, 16, 16), (64, 2, 2), (2, 64, 2), (2, 2, 64),
        (24, 24, 24),
    ]  # fmt: skip
    for nodes in shapes:
        yield f"principled {nodes}", partial(
            posterior_error, S_L[..., :1], S_B[..., :1], preset("default"),
            PrincipledGrid(*nodes), E=E[:, :1],
        )  # fmt: skip


AGAINST = "entropy with that of every cell in double precision"
AXES = (
    Axis("rules of the spectrum", "all presets, channel and noise rules, both grids, priors",
         AGAINST, _presets),
    Axis("exposure of spectra", "2^-20 to 2^20", "entropy with that before", _exposure),
    Axis("contrast of spectra", "a sun of 1e5, 4096 : 1, black, constant, 2^-100 to 2^100",
         AGAINST, _contrast),
    Axis("sigma of the spectrum", "1e-30 to 1e30; 1 to 512 views", AGAINST, _sigma),
    Axis("grids of the spectrum", "2 to 64 nodes", AGAINST, _grids),
)  # fmt: skip
