"""The posterior from power spectra (Eq. 3, 5, 7 and 11)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracle.rounding import spectrum_entropy

from numerics.samples import DEGREE, TEXELS, assert_entropy, spectra
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.spectrum import spectrum_posterior
from svu_mi.presets import preset
from svu_mi.reflection.lobes import mean_albedo
from svu_mi.reflection.principled import MIN_ALPHA

KS, PRINCIPLED = ParameterGrid(8, 8), PrincipledGrid(8, 8, 8)
PLAIN = preset("default", method="spectrum")
RULES = {
    "paper": (preset("paper", method="spectrum"), KS),
    "paper, light as it was": (preset("paper", method="spectrum", undo_prefilter=True), KS),
    "fast": (preset("fast", method="spectrum"), PRINCIPLED),
    **{
        f"{channels}, {noise}, {kind}": (
            replace(PLAIN, channels=channels, noise=noise, sigma=0.02), grid)
        for channels, kind, grid in
        (("grey", "Ks", KS), ("sum", "Ks", KS), ("grey", "principled", PRINCIPLED))
        for noise in ("relative", "fixed")
    },
}  # fmt: skip
ALL = pytest.mark.parametrize("rule", RULES)


def irradiance(seed, channels, texels=TEXELS):
    values = np.random.default_rng(seed).random((texels, channels)) * 3
    return values.astype(np.float32)


def assert_posterior(S_L, S_B, switches, grid, E=None, prior=None):
    """Entropy of every texel against double precision."""
    E, albedo = (E if isinstance(grid, PrincipledGrid) else None), None
    if isinstance(grid, ParameterGrid):
        grid = grid.resolved(switches)
    elif switches.albedo:  # the kernels' own table: its truth is another test's
        albedo = mean_albedo(np.maximum(grid.roughness_nodes**2, MIN_ALPHA))
    unit = float(S_B.astype(np.float64).sum(axis=1).mean())
    unit = unit or 1e-4 * float(S_L.astype(np.float64).sum(axis=1).mean()) or 1.0
    posterior = spectrum_posterior(
        S_L, S_B, grid, preset=switches, prior=prior, prefilter=0.3, irradiance=E
    )
    truth = [
        spectrum_entropy(
            S_L[t], S_B[t], switches, grid, unit, prefilter=0.3,
            irradiance=None if E is None else E[t], prior=prior, albedo=albedo,
        )
        for t in range(len(S_L))
    ]  # fmt: skip
    assert_entropy(posterior.entropy(), [x.entropy for x in truth], [x.bound for x in truth])


@ALL
@pytest.mark.few(4)
@pytest.mark.parametrize("with_prior", [False, True])
def test_any_rule(rule, with_prior):
    switches, grid = RULES[rule]
    data, E = spectra(10007, switches.colors), irradiance(10009, switches.colors)
    prior = None
    if with_prior:
        prior = np.random.default_rng(10037).random(grid.shape)
        prior[2] = 0
    assert_posterior(*data, switches, grid, E, prior)


CONSTANT = (np.arange(DEGREE + 1) == 0)[:, None].astype(np.float32)
ONE = np.where(np.arange(TEXELS) == 1, np.float32(4096.0**2), np.float32(1))[:, None, None]
CONTRASTS = {
    "a sun of 1e5": lambda L, B: (L * np.float32(1e10), B),
    "a highlight of 1e5": lambda L, B: (L, B * np.float32(1e10)),
    "one texel at 4096 times the others": lambda L, B: (L, B * ONE),
    "no light": lambda L, B: (0 * L, B),
    "black photographs": lambda L, B: (L, 0 * B),
    "neither": lambda L, B: (0 * L, 0 * B),
    "constant light": lambda L, B: (L * CONSTANT, B * CONSTANT),
    "constant light, sharp photographs": lambda L, B: (L * CONSTANT, B),
    "2^-100": lambda L, B: (L * np.float32(2.0**-100), B * np.float32(2.0**-100)),
    "2^100": lambda L, B: (L * np.float32(2.0**100), B * np.float32(2.0**100)),
}


@pytest.mark.few(6)
@pytest.mark.parametrize("what", CONTRASTS)
@pytest.mark.parametrize("rule", ["paper", "grey, relative, Ks", "grey, relative, principled"])
def test_any_contrast(rule, what):
    switches, grid = RULES[rule]
    data = CONTRASTS[what](*spectra(10079, switches.colors))
    assert_posterior(*data, switches, grid, E=irradiance(10091, switches.colors))


@pytest.mark.few(3)
@pytest.mark.parametrize("grid", [PRINCIPLED, KS], ids=["principled", "Ks"])
@pytest.mark.parametrize("power", [-30, -12, -3, 0, 12, 30])
@pytest.mark.parametrize("noise", ["fixed", "relative"])
def test_any_sigma(noise, power, grid):
    switches = preset("default", method="spectrum", noise=noise, sigma=10.0**power)
    E = irradiance(10099, switches.colors)
    data = spectra(10093, switches.colors)
    assert_posterior(*data, switches, grid, E)


@pytest.mark.few(3)
@pytest.mark.parametrize("grid", [
    *(ParameterGrid(n, n) for n in (2, 5, 33, 64)),
    *(PrincipledGrid(*n) for n in ((2, 2, 2), (5, 3, 4), (64, 2, 2), (2, 64, 2), (2, 2, 64),
                                   (24, 24, 24))),
], ids=lambda grid: str(grid.shape))  # fmt: skip
def test_any_grid(grid):
    switches = preset("paper" if isinstance(grid, ParameterGrid) else "default", method="spectrum")
    channels = switches.colors
    assert_posterior(*spectra(10103, channels, 2), switches, grid, E=irradiance(10111, channels, 2))
