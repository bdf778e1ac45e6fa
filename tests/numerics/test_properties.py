"""What must hold for any data: bounded examples, always the same ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracle.rounding import SPECTRUM, U

from numerics.samples import (
    ESTIMATED,
    FIXED,
    GRID,
    TEXELS,
    bounds_of,
    entropy_of,
    fit_samples,
    noise_of,
    pick,
    posterior_of,
    samples,
    spectra,
)
from numerics.test_statistics import RULES
from svu_mi.frequency.fit_sh import fit_sh
from svu_mi.frequency.harmonics import power_spectrum
from svu_mi.posterior.spectrum import spectrum_posterior
from svu_mi.presets import preset

SEEDS = st.integers(0, 2**32 - 1)
PLACES = st.sampled_from(["spread", "in a plane", "on a line", "grazing", "crowded"])


def few(examples: int):
    return settings(max_examples=examples, deadline=None, derandomize=True)


def powers(d, w, f, regularizer=1e-3):
    S = np.array(power_spectrum(fit_sh(d, w, f, 6, regularizer)), np.float64)
    return S / S.max(axis=1, keepdims=True)


def spectral(S_L, S_B, switches):
    return np.array(spectrum_posterior(S_L, S_B, preset=switches).entropy())


# --- entropy is a number in [0, 1] ----------------------------------------------------------


def radiances(most):
    return st.one_of(
        st.sampled_from([0.0, 1e-30, 1e-6, 1.0, 1e5, 1e9]), st.floats(0, 100), st.floats(0, most)
    )


GIVEN = [rule for name, rule in RULES.items() if "estimated" not in name]
BRIGHTEST = 1e9  # in units of the photographs' mean; light beyond leaves nothing but its rounding


@few(60)
@given(st.sampled_from(GIVEN), arrays(np.float64, (5, 2, 3), elements=radiances(1e12)),
       st.sampled_from([1e-6, 0.7, 1e6]))  # fmt: skip
@example(GIVEN[0], np.full((5, 2, 3), 3e-159), 1e-6)  # squares are subnormal
def test_entropy_is_in_0_1_for_any_samples(rule, values, scale):
    """Light and photographs need not fit each other."""
    switches, grid = rule
    colors = switches.colors
    b, *light = (np.repeat(x[:, None], colors, axis=1) for x in values)
    light = [np.repeat(x[:, None], 8, axis=1) for x in light]
    posterior = posterior_of((np.ones((2, 3)), b, *light), switches, grid, scale)
    H, probability = np.array(posterior.entropy()), np.array(posterior.probabilities)
    assert ((H >= 0) & (H <= 1)).all()  # NaN is neither
    assert np.isfinite(probability).all()


@pytest.mark.slow
@few(25)
@given(arrays(np.float64, (5, 2, 3), elements=radiances(BRIGHTEST)),
       st.sampled_from([1e-6, 0.7, 1e6]))  # fmt: skip
def test_all_that_is_estimated_is_finite_for_any_samples(values, scale):
    """Entropy, probabilities, moments, intervals and draws, of 2 texels and 3 views.

    Samples are weighted as they always are: what is far brighter than the scale counts little.
    """
    w = 1 / (1 + (values[0] / ESTIMATED.knee) ** 2)
    b, *light = (np.repeat(scale * x[:, None], 3, axis=1) for x in values)
    light = [np.repeat(x[:, None], 8, axis=1) for x in light]
    posterior = posterior_of((w, b, *light), ESTIMATED, GRID, scale)
    H, probability = np.array(posterior.entropy()), np.array(posterior.probabilities)
    assert ((H >= 0) & (H <= 1)).all()
    np.testing.assert_allclose(probability.sum(axis=(1, 2, 3)), 1, rtol=1e-5)
    assert (noise_of(posterior) > 0).all() and np.isfinite(noise_of(posterior)).all()
    drawn = posterior.draw(3)
    for name in posterior.axes:
        mean, sd, *ends = (
            np.array(x)
            for x in (posterior.mean(name), posterior.sd(name), *posterior.interval(name))
        )
        for x in (mean, *ends, np.array(drawn[name])):
            assert ((x >= 0) & (x <= 1)).all(), name
        assert ((sd >= 0) & (sd <= 0.5 + 1e-6)).all()
        assert (ends[0] <= ends[1]).all()


# --- what must not matter -------------------------------------------------------------------


@few(12)
@given(SEEDS, PLACES)
def test_a_rotation_leaves_the_spectra(seed, place):
    """R depends on the degree alone. Rounded directions are other directions, by 2 U: of
    degree 6 they move a sample by 6 times that, and the fit amplifies it by 1 / sqrt(lambda)."""
    d, w, f = fit_samples(seed, 24, place)
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turned = (d @ turn.T).astype(np.float32)
    moved = 6 * 2 * U / np.sqrt(1e-3)
    np.testing.assert_allclose(powers(turned, w, f), powers(d, w, f), atol=2 * SPECTRUM + moved)


@few(8)
@given(SEEDS)
def test_texels_do_not_see_each_other(seed):
    """A lane computes alone: bit for bit the same in any order."""
    order = np.random.default_rng(seed).permutation(TEXELS)
    data = samples(seed, 1)
    turned = tuple(x[order] for x in data)
    np.testing.assert_array_equal(entropy_of(turned), entropy_of(data)[order])
    colored = samples(seed, 3)
    turned = tuple(x[order] for x in colored)
    entropies, again = (entropy_of(x, ESTIMATED) for x in (colored, turned))
    np.testing.assert_array_equal(again, entropies[order])
    S_L, S_B = spectra(seed, 3)
    again = spectral(S_L[order], S_B[order], "paper")
    np.testing.assert_array_equal(again, spectral(S_L, S_B, "paper")[order])


@few(8)
@given(SEEDS, st.permutations([0, 1, 2]))
def test_the_order_of_channels_does_not_matter(seed, order):
    joint = preset(FIXED, method="angular", channels="joint")
    w, *fields = samples(seed, 3)
    turned = w, *(np.take(x, order, axis=-2) for x in fields)
    for switches, atol in ((joint, 32 * U), (ESTIMATED, 64 * U)):
        entropies, again = (entropy_of(x, switches) for x in ((w, *fields), turned))
        np.testing.assert_allclose(again, entropies, atol=atol)
    S_L, S_B = spectra(seed, 3)
    total = preset("default", method="spectrum", channels="sum", sigma=0.02, parameters="specular")
    again = spectral(S_L[..., order], S_B[..., order], total)
    np.testing.assert_allclose(again, spectral(S_L, S_B, total), atol=32 * U)


# --- more views -----------------------------------------------------------------------------


@few(10)
@given(SEEDS, st.integers(2, 40))
def test_copies_of_all_views_are_no_new_evidence(seed, copies):
    """The *mean* squared error does not change, so neither does the posterior."""
    data = samples(seed, 1, views=6)
    again = entropy_of(pick(data, list(range(6)) * copies))
    assert (np.abs(again - entropy_of(data)) <= 2 * bounds_of(data)).all()


@few(25)
@given(SEEDS, st.integers(0, 7), st.integers(0, 7), st.integers(0, 7), st.integers(1, 12))
def test_view_without_noise_dilutes_truth_by_at_most_its_share(seed, r, m, c, views):
    """Adding view n + 1 turns d into (n d + e) / (n + 1), where e >= 0, and 0 at the truth.

    So p(truth) = 1 / sum exp(-(d / 2 sigma^2)) does not fall below that of n views with sigma
    larger by sqrt((n + 1) / n): the mean forgives a cell what the new view does not see of its
    error, and no more. Entropy itself may rise (next test), under this rule or a sum of errors.
    """
    truth = (r, m / 7, c / 7)
    data = samples(seed, 1, views=views + 1, noise=0, truth=truth)
    wider = FIXED.sigma * np.sqrt((views + 1) / views)

    def of_truth(data, sigma):
        switches = preset(FIXED, method="angular", sigma=float(sigma))
        return np.array(posterior_of(data, switches).probabilities)[:, r, m, c]

    before = of_truth(pick(data, list(range(views))), wider)
    assert (of_truth(data, FIXED.sigma) >= before - 5e-6).all()  # of single probabilities


def test_uninformative_view_widens_the_posterior():
    """The counterexample: all cells explain a black view of an unlit texel alike."""
    truth = (3, 0.375, 0.32 / 0.625)  # Kd = 0.2, R0 = 0.4
    data = samples(40009, 1, views=6, noise=0, truth=truth)
    w, *radiance = (np.concatenate([x, 0 * x[..., :1]], axis=-1) for x in data)
    w[..., -1] = 1
    assert (entropy_of((w, *radiance)) > entropy_of(data)).all()
