"""Tests of the angular posterior, against brute force over all bins."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from oracle import angular as oracle
from oracle import posterior as oracle_posterior
from support.unseen import assert_unseen_have_the_prior
from support.walled import Samples, angular, noise_capture, seen_in, walled_ball

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior.angular import angular_posterior
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.statistics.statistics import Statistics


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return walled_ball(tmp_path_factory.mktemp("wall"))


def random_samples(rng, texels, channels, levels=5, views=None):
    """Return samples of shiny and dull texels: w (T, V), e, p, q, d (T, R, C, V), b (T, C, V)."""
    views = int(rng.integers(4, 9)) if views is None else views
    e = rng.random((texels, 1, channels, 1)) * (0.8 + 0.4 * rng.random((texels, levels, 1, views)))
    s = rng.exponential(size=(texels, levels, channels, views))
    f = 0.3 * rng.random((texels, 1, 1, views))
    p, q, d = s * (1 - f), s * f, s * (0.04 + 0.5 * f * rng.random(s.shape))
    c, m = rng.random((2, texels, channels, 1))
    at = np.arange(texels), rng.integers(0, levels, texels)
    b = oracle.modelled([column[at] for column in (e * np.ones_like(s), p, q, d)], c, m)
    b = b * np.exp(0.1 * rng.normal(size=b.shape))
    return rng.random((texels, views)) + 0.5, e * np.ones_like(s), p, q, d, b


def some_views(samples, counts):
    """Return w, e, p, q, d and b of each texel, restricted to its first ``counts`` views."""
    return [[x[t, ..., :n] for x in samples] for t, n in enumerate(counts)]


def statistics_of(texels):
    """Return ``Statistics`` of stored samples."""
    table = np.stack(
        [np.moveaxis(oracle.products(w, (e, p, q, d), b), 0, -1) for w, e, p, q, d, b in texels]
    )  # (T, R, C, 10)
    weight, views = np.array([[w.sum(), len(w)] for w, *_ in texels]).T
    levels = np.linspace(0, 1, table.shape[1])
    return Statistics.of(np.moveaxis(table, 0, -1), weight, views, levels)


def of(samples):
    """Return ``Statistics`` of samples of all views."""
    return statistics_of(some_views(samples, [samples[0].shape[1]] * len(samples[0])))


PRINCIPLED = PrincipledGrid(roughness=5, metallic=3, base_color=4)
SPECULAR = ParameterGrid(roughness=5, specular=6, spacing="dielectric")
SCALE = 0.7
RULES = [
    angular(parameters=parameters, channels=channels, noise=noise, sigma=sigma)
    for parameters in ("principled", "specular")
    for channels in ("grey", "joint")
    for noise, sigma in (("relative", 0.15), ("fixed", 0.3), ("heteroscedastic", 0.04))
]


def rule(switches):
    return f"{switches.parameters}-{switches.channels}-{switches.noise}"


def grid_of(switches):
    return PRINCIPLED if switches.parameters == "principled" else SPECULAR


def brute_force(switches, samples, prior=None):
    """Return probabilities of one texel, (*grid, C), and the index of the best bin per channel."""
    w, *columns, b = samples
    grid, energies = grid_of(switches), []
    for c in range(len(b)):
        own = [x[:, c] for x in columns]
        if switches.parameters == "principled":
            d = oracle.principled_errors(w, *own, b[c], np.linspace(0, 1, 3), np.linspace(0, 1, 4))
        else:
            nodes = oracle_posterior.nodes(5, 6, "dielectric")[1]
            d = oracle.specular_errors(w, *own[:3], b[c], nodes)
        sigma = switches.sigma * (1 if switches.noise == "fixed" else SCALE)
        energies.append(oracle_posterior.energies(d, sigma))
    together = oracle_posterior.joint(energies, prior)
    row, *own = np.unravel_index(together.argmax(), together.shape)
    shared = np.unravel_index(row, grid.shape[:-1])
    return oracle_posterior.of_channels(together, grid.shape), [(*shared, k) for k in own]


def random_prior(rng, grid):
    """Return random weights with zeros, also for a whole roughness, in the grid's shape."""
    prior = rng.random(grid.shape) * (rng.random(grid.shape) > 0.3)
    prior[2] = 0
    return prior


@pytest.mark.few(6)
@pytest.mark.parametrize("with_prior", [False, True], ids=["uniform", "prior"])
@pytest.mark.parametrize("switches", RULES, ids=rule)
def test_every_rule_agrees_with_brute_force(switches, with_prior):
    """Check probabilities, entropy, marginals and the most probable bin."""
    rng = np.random.default_rng(141421)
    channels, grid = 3 if switches.channels == "joint" else 1, grid_of(switches)
    samples = some_views(random_samples(rng, 8, channels, views=40), rng.integers(1, 40, 8))
    prior = random_prior(rng, grid) if with_prior else None
    posterior = angular_posterior(statistics_of(samples), grid, SCALE, switches, prior=prior)
    p = np.array(posterior.probabilities, np.float64).reshape(8, *grid.shape, channels)
    H = np.array(posterior.entropy())
    best = posterior.map()
    for t in range(8):
        truth, cells = brute_force(switches, samples[t], prior)
        np.testing.assert_allclose(p[t], truth, atol=5e-6)
        assert abs(H[t] - oracle_posterior.mean_entropy(truth)) < 5e-6
        for axis, (name, nodes) in enumerate(grid.axes.items()):
            others = tuple(k for k in range(len(grid.shape)) if k != axis)
            marginal = truth.sum(axis=others)
            ours = np.array(posterior.marginal(name))[t].reshape(len(nodes), -1)
            np.testing.assert_allclose(ours, marginal[:, : ours.shape[1]], atol=1e-5)
            value = np.array(best[name])[t].ravel()
            expected = nodes[[cell[axis] for cell in cells]][: len(value)]
            np.testing.assert_allclose(value, expected, atol=1e-6)


@pytest.mark.few(4)
@pytest.mark.parametrize("rows", [True, False], ids=["one roughness", "cells"])
@pytest.mark.parametrize("switches", RULES, ids=rule)
def test_unseen_texels_have_the_prior_for_their_posterior(switches, rows):
    rng = np.random.default_rng(264575)
    samples = random_samples(rng, 9, 3 if switches.channels == "joint" else 1)
    statistics = statistics_of(some_views(samples, np.array([0, 4, 1] * 3)))
    grid = grid_of(switches)
    prior = np.eye(5)[3] if rows else random_prior(rng, grid)
    posterior = angular_posterior(statistics, grid, SCALE, switches, prior=prior)
    assert_unseen_have_the_prior(posterior, prior)
    if rows:  # log 12 / log 60 of a principled grid
        n = np.prod(grid.shape)
        assert posterior.prior_entropy == pytest.approx(np.log(n / 5) / np.log(n), abs=1e-7)


def test_wrong_input_is_named():
    statistics = of(random_samples(np.random.default_rng(3), 2, 1))
    with pytest.raises(ShapeError, match="statistics at the nodes of the grid") as caught:
        angular_posterior(statistics)
    assert "\n" not in str(caught.value)
    with pytest.raises(ShapeError, match="the grid's roughness is"):
        angular_posterior(replace(statistics, roughness=statistics.roughness**2), PRINCIPLED)
    with pytest.raises(OptionError, match="use preset=.fixed"):
        angular_posterior(statistics, PRINCIPLED, preset="default")
    with pytest.raises(OptionError, match="need a PrincipledGrid"):
        angular_posterior(statistics, SPECULAR)
    with pytest.raises(OptionError, match="scale must be positive"):
        angular_posterior(statistics, PRINCIPLED, 0.0)
    with pytest.raises(ShapeError, match=r"the prior must be \(5, 3, 4\)"):
        angular_posterior(statistics, PRINCIPLED, prior=np.ones((5, 3)))
    with pytest.raises(OptionError, match="non-negative"):
        angular_posterior(statistics, PRINCIPLED, prior=-np.ones(5))
    with pytest.raises(ShapeError, match=r"levels must be \(5,\) booleans"):
        angular_posterior(statistics, PRINCIPLED, levels=np.arange(5))
    for wrong in ({"copies": 0}, {"texels": 1}):
        with pytest.raises(
            OptionError, match="copies must be at least 1 and texels greater than 1"
        ):
            angular_posterior(statistics, PRINCIPLED, **wrong)
    with pytest.raises(OptionError, match="Unknown switch 'lobes'"):
        angular(lobes="ggx")


def test_factors_do_as_well_as_the_statistics_they_are_of():
    statistics = of(random_samples(np.random.default_rng(8), 6, 1))
    a, b = (angular_posterior(x, PRINCIPLED, SCALE) for x in (statistics, statistics.factor()))
    np.testing.assert_array_equal(np.array(a.entropy()), np.array(b.entropy()))


def test_results_of_some_texels_have_the_right_index():
    """Statistics contain seen texels only; all other texels have the prior."""
    statistics = of(random_samples(np.random.default_rng(44), 3, 1))
    texel = np.array([6, 1, 4], np.uint32)
    few = angular_posterior(statistics, PRINCIPLED, SCALE)
    moved = replace(statistics, texel=to_drjit(mi.UInt32, texel))
    many = angular_posterior(moved, PRINCIPLED, SCALE, texels=8)
    H = np.array(many.entropy())
    np.testing.assert_array_equal(H[texel], np.array(few.entropy()))
    assert (np.delete(H, texel) == 1).all()
    p = np.array(many.probabilities)
    np.testing.assert_array_equal(p[texel], np.array(few.probabilities))
    np.testing.assert_allclose(np.delete(p, texel, axis=0), 1 / 60, rtol=1e-6)


def test_levels_that_the_prior_excludes_need_no_statistics():
    samples = random_samples(np.random.default_rng(71), 5, 1)
    prior = random_prior(np.random.default_rng(6), PRINCIPLED)
    levels = np.arange(5) != 2  # the prior excludes level 2
    w, *columns, b = samples
    fewer = replace(of((w, *(x[:, levels] for x in columns), b)),
                    roughness=np.linspace(0, 1, 5)[levels])  # fmt: skip
    whole = angular_posterior(of(samples), PRINCIPLED, SCALE, prior=prior)
    short = angular_posterior(fewer, PRINCIPLED, SCALE, prior=prior, levels=levels)
    np.testing.assert_allclose(np.array(short.entropy()), np.array(whole.entropy()), atol=1e-6)
    np.testing.assert_allclose(
        np.array(short.probabilities), np.array(whole.probabilities), atol=1e-6
    )


# --- from photographs to entropy ------------------------------------------------------------


@pytest.mark.parametrize("channels", ["grey", "joint"])
def test_statistics_and_posterior_together_are_brute_force(scene, channels):
    """Run all steps from photographs to entropy, with samples stored in between."""
    switches = angular(channels=channels, sigma=0.4)
    grid = PrincipledGrid(roughness=4, metallic=3, base_color=3)
    observed = seen_in(noise_capture(scene), 16)
    nodes = grid.roughness_nodes
    statistics = observed.statistics(nodes, switches, switches.colors)
    total = observed.texels.count
    H = np.array(angular_posterior(statistics, grid, 1.0, switches, texels=total).entropy())
    assert (np.delete(H, observed.seen) == 1).all()
    H = H[observed.seen]
    samples = Samples(observed, switches, roughness=nodes)
    for t in range(0, statistics.count, 12):
        w, columns, b = samples.of(t)
        energies = [
            oracle_posterior.energies(oracle.principled_errors(
                w, *(x[:, c] for x in columns), b[c], np.linspace(0, 1, 3), np.linspace(0, 1, 3)
            ), 0.4)
            for c in range(switches.colors)
        ]  # fmt: skip
        truth = oracle_posterior.of_channels(oracle_posterior.joint(energies), grid.shape)
        assert abs(H[t] - oracle_posterior.mean_entropy(truth)) < 5e-6


def test_a_grid_keeps_the_values_that_were_known():
    known = {"metallic": 0.0}
    grid = PrincipledGrid(known=known)
    known["metallic"] = 0.5
    assert grid.known == {"metallic": 0.0}
