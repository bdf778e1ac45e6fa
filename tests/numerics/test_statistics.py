"""The posterior from angular statistics (Eq. 3 to 6), noise given or estimated."""

from __future__ import annotations

import numpy as np
import pytest
from oracle.rounding import U

from numerics.samples import (
    ESTIMATED,
    FIXED,
    GRID,
    SCALE,
    assert_entropy,
    entropy_of,
    exact_entropy,
    exposed,
    noise_of,
    pick,
    posterior_of,
    samples,
)
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.presets import preset

KS = ParameterGrid(8, 8, "dielectric")
RULES = {
    f"{channels}, {noise}, {kind}": (
        preset("fixed", method="angular", parameters=kind, channels=channels, noise=noise), grid)
    for kind, grid in (("principled", GRID), ("specular", KS))
    for channels in ("grey", "joint") for noise in ("relative", "fixed")
} | {
    f"{channels}, estimated": (
        preset("default", method="angular", channels=channels, bare_metals=0.0), GRID
    )
    for channels in ("grey", "joint")
}  # fmt: skip
ALL = pytest.mark.parametrize("rule", RULES)


def assert_posterior(data, switches=FIXED, grid=GRID, scale=SCALE, prior=None):
    """Entropy of every texel against double precision from its samples."""
    posterior = posterior_of(data, switches, grid, scale, prior)
    noise = noise_of(posterior) if switches.noise == "estimated" else None
    truth = exact_entropy(data, switches, grid, scale, prior, noise)
    assert_entropy(posterior.entropy(), [x.entropy for x in truth], [x.bound for x in truth])


@ALL
@pytest.mark.few(6)
@pytest.mark.parametrize("views", [1, 2, 512])
def test_any_number_of_views(rule, views):
    switches, grid = RULES[rule]
    assert_posterior(samples(20011 + views, switches.colors, views=views), switches, grid)


@ALL
@pytest.mark.few(3)
def test_identical_views(rule):
    switches, grid = RULES[rule]
    assert_posterior(pick(samples(20023, switches.colors), [0] * 12), switches, grid)


@pytest.mark.few(2)
@pytest.mark.parametrize("rule", [rule for rule in RULES if "estimated" not in rule])
def test_any_prior(rule):
    switches, grid = RULES[rule]
    prior = np.random.default_rng(20021).random(grid.shape)
    prior[2] = 0
    assert_posterior(samples(20023, switches.colors), switches, grid, prior=prior)


@pytest.mark.parametrize("channels", ["grey", "joint"])
def test_photographs_without_noise(channels):
    switches, _ = RULES[f"{channels}, estimated"]
    assert_posterior(samples(20089, switches.colors, noise=0), switches)


def bright(x):
    """x with the fifth view at 1e5."""
    return np.where(np.arange(x.shape[-1]) == 4, 1e5, x)


def sun(x):
    """x with the fifth view 1e5 times as bright."""
    return np.where(np.arange(x.shape[-1]) == 4, 1e5, 1.0) * x


ENDS = {
    "black photographs": lambda w, b, e, p, q, d: (w, 0 * b, e, p, q, d),
    "a highlight of 1e5": lambda w, b, e, p, q, d: (w, bright(b), e, p, q, d),
    "a sun of 1e5": lambda w, b, e, p, q, d: (w, b, e, sun(p), sun(q), sun(d)),
    "a sun in light and photographs":
        lambda w, b, e, p, q, d: (w, bright(b), e, sun(p), sun(q), sun(d)),
    "no light": lambda w, b, e, p, q, d: (w, b, 0 * e, 0 * p, 0 * q, 0 * d),
    "no diffuse light": lambda w, b, e, p, q, d: (w, b, 0 * e, p, q, d),
    "no specular light": lambda w, b, e, p, q, d: (w, b, e, 0 * p, 0 * q, 0 * d),
    "constant light": lambda w, b, e, p, q, d:
        (w, 0 * b + 0.5, 0 * e + 1, 0 * p + 1, 0 * q, 0 * d + 0.04),
}  # fmt: skip


@ALL
@pytest.mark.few(10)
@pytest.mark.parametrize("what", ENDS)
def test_light_at_its_ends(rule, what):
    switches, grid = RULES[rule]
    assert_posterior(ENDS[what](*samples(20029, switches.colors)), switches, grid)


@ALL
@pytest.mark.few(4)
@pytest.mark.parametrize("power", [-6, 6])
def test_radiance_at_its_ends(rule, power):
    switches, grid = RULES[rule]
    gain = 10.0**power
    data = exposed(samples(20029, switches.colors), gain)
    assert_posterior(data, switches, grid, SCALE * gain)


@pytest.mark.parametrize("rule", [name for name in RULES if RULES[name][0].noise != "fixed"])
@pytest.mark.parametrize("power", [-20, 20])
def test_exposure_does_not_matter(rule, power):
    """Powers of two round nothing: entropy may differ by what its own sums round."""
    switches, grid = RULES[rule]
    data, gain = samples(20047, switches.colors), 2.0**power
    after = entropy_of(exposed(data, gain), switches, grid, SCALE * gain)
    assert_entropy(after, entropy_of(data, switches, grid), 4 * U)


@pytest.mark.few(3)
@pytest.mark.parametrize("channels", ["grey", "joint"])
@pytest.mark.parametrize("power", [-12, -6, -3, 0, 3, 12])
def test_any_sigma(power, channels):
    switches = preset(FIXED, method="angular", sigma=10.0**power, channels=channels)
    assert_posterior(samples(20051, switches.colors), switches)


@pytest.mark.few(3)
@pytest.mark.parametrize("grid", [
    *(PrincipledGrid(*n) for n in ((2, 2, 2), (5, 3, 4), (64, 2, 2), (2, 64, 2), (2, 2, 64),
                                   (24, 24, 24))),
    *(ParameterGrid(*n, "dielectric") for n in ((2, 2), (3, 64), (64, 3), (64, 64))),
], ids=lambda grid: str(grid.shape))  # fmt: skip
def test_any_grid(grid):
    kind = "principled" if isinstance(grid, PrincipledGrid) else "specular"
    switches = preset("fixed", method="angular", parameters=kind)
    assert_posterior(samples(20063, 1, levels=grid.shape[0], texels=2), switches, grid)


def test_estimated_noise_is_a_number():
    posterior = posterior_of(samples(20101, 3), ESTIMATED)
    assert (noise_of(posterior) > 0).all() and np.isfinite(noise_of(posterior)).all()
