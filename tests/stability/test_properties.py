"""What must hold for any data: bounded examples, always the same ones."""

from __future__ import annotations

import numpy as np
import pytest
from extremes import angular
from extremes import spectra as spectral
from extremes.fits import samples
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracle.rounding import SPECTRUM, U

from svu_mi.frequency import fit_sh, power_spectrum
from svu_mi.options import preset
from svu_mi.posterior import (
    PrincipledGrid,
    angular_posterior,
    calibrated_posterior,
    spectrum_posterior,
)

SEEDS = st.integers(0, 2**32 - 1)
PLACES = st.sampled_from(["spread", "in a plane", "on a line", "grazing", "crowded"])
GRID = PrincipledGrid(8, 8, 8)
ANGULAR = preset("fixed", method="angular")
ESTIMATED = preset("default", method="angular")


def few(examples: int):
    return settings(max_examples=examples, deadline=None, derandomize=True)


def powers(d, w, f, regularizer=1e-3):
    S = np.array(power_spectrum(fit_sh(d, w, f, 6, regularizer)), np.float64)
    return S / S.max(axis=1, keepdims=True)


def entropy(data, switches=ANGULAR, grid=GRID, scale=angular.SCALE, counts=None):
    found = angular_posterior(angular.statistics_of(data, counts), grid, scale, switches)
    return np.array(found.entropy(), np.float64)


def estimated(data, scale=angular.SCALE):
    """Entropy where noise is estimated."""
    found = calibrated_posterior(angular.statistics_of(data), GRID, scale, ESTIMATED)
    return np.array(found.entropy(), np.float64)


def bounds(data, switches=ANGULAR, scale=angular.SCALE):
    """How far the kernels may be from double precision, per texel."""
    w, b, *light = data
    return np.array([
        angular.angular_entropy(
            w[t], *(x[t] for x in light), b[t], switches, GRID, scale
        ).bound
        for t in range(len(w))
    ])  # fmt: skip


# --- entropy is a number in [0, 1] ----------------------------------------------------------

def radiances(most):
    return st.one_of(
        st.sampled_from([0.0, 1e-30, 1e-6, 1.0, 1e5, 1e9]), st.floats(0, 100), st.floats(0, most)
    )


RULES = angular.rules(quick=True)
BRIGHTEST = 1e9  # in units of the photographs' mean; light beyond leaves nothing but its rounding


@few(60)
@given(st.sampled_from(RULES), arrays(np.float64, (5, 2, 3), elements=radiances(1e12)),
       st.sampled_from([1e-6, 0.7, 1e6]))  # fmt: skip
def test_entropy_is_in_0_1_for_any_samples(rule, values, scale):
    """Light and photographs need not fit each other."""
    _, switches, grid = rule
    colors = switches.colors
    b, *light = (np.repeat(x[:, None], colors, axis=1) for x in values)
    light = [np.repeat(x[:, None], 8, axis=1) for x in light]
    found = angular_posterior(
        angular.statistics_of((np.ones((2, 3)), b, *light)), grid, scale, switches
    )
    H, probability = np.array(found.entropy()), np.array(found.probabilities)
    assert ((H >= 0) & (H <= 1)).all()  # NaN is neither
    assert np.isfinite(probability).all()


@few(40)
@given(arrays(np.float64, (5, 2, 3), elements=radiances(BRIGHTEST)),
       st.sampled_from([1e-6, 0.7, 1e6]))  # fmt: skip
def test_all_that_is_estimated_is_finite_for_any_samples(values, scale):
    """Entropy, probabilities, moments, intervals and draws, of 2 texels and 3 views.

    Samples are weighted as they always are: what is far brighter than the scale counts little.
    """
    w = 1 / (1 + (values[0] / ESTIMATED.knee) ** 2)
    b, *light = (np.repeat(scale * x[:, None], 3, axis=1) for x in values)
    light = [np.repeat(x[:, None], 8, axis=1) for x in light]
    statistics = angular.statistics_of((w, b, *light))
    found = calibrated_posterior(statistics, GRID, scale, ESTIMATED)
    H, probability = np.array(found.entropy()), np.array(found.probabilities)
    assert ((H >= 0) & (H <= 1)).all()
    np.testing.assert_allclose(probability.sum(axis=(1, 2, 3)), 1, rtol=1e-5)
    assert (found.noise > 0).all() and np.isfinite(found.noise).all()
    drawn = found.draw(3)
    for name in found.axes:
        mean, sd, *ends = (
            np.array(x) for x in (found.mean(name), found.sd(name), *found.interval(name))
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
    d, w, f = samples(seed, 24, place)
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turned = (d @ turn.T).astype(np.float32)
    moved = 6 * 2 * U / np.sqrt(1e-3)
    np.testing.assert_allclose(powers(turned, w, f), powers(d, w, f), atol=2 * SPECTRUM + moved)


@few(12)
@given(SEEDS, PLACES)
def test_the_order_of_views_leaves_the_spectra(seed, place):
    d, w, f = samples(seed, 24, place)
    order = np.random.default_rng(seed).permutation(24)
    again = powers(d[:, order], w[:, order], f[:, order])
    np.testing.assert_allclose(again, powers(d, w, f), atol=2 * SPECTRUM)


@few(8)
@given(SEEDS)
def test_texels_do_not_see_each_other(seed):
    """A lane computes alone: bit for bit the same in any order."""
    order = np.random.default_rng(seed).permutation(angular.TEXELS)
    data = angular.samples(seed, 1)
    turned = tuple(x[order] for x in data)
    np.testing.assert_array_equal(entropy(turned), entropy(data)[order])
    colored = angular.samples(seed, 3)
    turned = tuple(x[order] for x in colored)
    np.testing.assert_array_equal(estimated(turned), estimated(colored)[order])
    S_L, S_B = spectral.spectra(seed, 3)
    H, again = (
        np.array(spectrum_posterior(*x, preset="paper").entropy())
        for x in ((S_L, S_B), (S_L[order], S_B[order]))
    )
    np.testing.assert_array_equal(again, H[order])


@few(12)
@given(SEEDS, st.floats(-6, 6), st.sampled_from(["relative", "marginal"]))
def test_exposure_does_not_matter(seed, power, noise):
    """Any gain, not only one that rounds nothing."""
    switches, gain = preset(ANGULAR, method="angular", noise=noise), 10.0**power
    data = angular.samples(seed, 1)
    after = entropy(angular.exposed(data, gain), switches, scale=gain * angular.SCALE)
    assert (np.abs(after - entropy(data, switches)) <= 2 * bounds(data, switches)).all()


@few(12)
@given(SEEDS, st.floats(-6, 6))
def test_exposure_does_not_matter_where_noise_is_estimated(seed, power):
    data, gain = angular.samples(seed, 3), 10.0**power
    after = estimated(angular.exposed(data, gain), gain * angular.SCALE)
    np.testing.assert_allclose(after, estimated(data), atol=64 * U)  # measured: 21


@few(8)
@given(SEEDS, st.permutations([0, 1, 2]))
def test_the_order_of_channels_does_not_matter(seed, order):
    joint = preset(ANGULAR, method="angular", channels="joint")
    w, *fields = angular.samples(seed, 3)
    turned = (np.take(x, order, axis=-2) for x in fields)
    turned = w, *turned
    np.testing.assert_allclose(entropy(turned, joint), entropy((w, *fields), joint), atol=32 * U)
    np.testing.assert_allclose(estimated(turned), estimated((w, *fields)), atol=64 * U)
    S_L, S_B = spectral.spectra(seed, 3)
    for channels in ("sum", "joint", "minimum"):
        switches = preset("default", channels=channels, sigma=0.02)
        H, again = (
            np.array(spectrum_posterior(*x, preset=switches).entropy())
            for x in ((S_L, S_B), (S_L[..., order], S_B[..., order]))
        )
        np.testing.assert_allclose(again, H, atol=32 * U)


# --- more views -----------------------------------------------------------------------------


def pick(data, views):
    """The samples of some views."""
    return tuple(x[..., views] for x in data)


@few(10)
@given(SEEDS, st.integers(2, 40))
def test_copies_of_all_views_are_no_new_evidence(seed, copies):
    """The *mean* squared error does not change, so neither does the posterior."""
    data = angular.samples(seed, 1, views=6)
    again = entropy(pick(data, list(range(6)) * copies))
    assert (np.abs(again - entropy(data)) <= 2 * bounds(data)).all()


@few(10)
@given(SEEDS, st.integers(2, 40))
def test_copies_are_new_evidence_for_the_marginal_rule(seed, copies):
    """It takes every photograph for a measurement of its own: nu grows with their number.

    p becomes p^beta / Z with beta > 1, whose entropy is never larger; hence copies of
    photographs must not be handed to it.
    """
    marginal = preset(ANGULAR, method="angular", noise="marginal")
    data = angular.samples(seed, 1, views=6)
    again, before = entropy(pick(data, list(range(6)) * copies), marginal), entropy(data, marginal)
    assert (again <= before + 2 * bounds(data, marginal)).all()


@pytest.mark.slow
@few(8)
@given(SEEDS, st.integers(2, 8))
def test_copies_of_views_make_the_fit_less_regular(seed, copies):
    """k copies at lambda are one at lambda / k: Y^T W^2 Y grows, lambda R does not."""
    d, w, f = samples(seed, 12)
    many = [np.concatenate([x] * copies, axis=1) for x in (d, w, f)]
    before = powers(d, w, f, 1e-2 / copies)
    np.testing.assert_allclose(powers(*many, 1e-2), before, atol=2 * SPECTRUM)


@few(25)
@given(SEEDS, st.integers(0, 7), st.integers(0, 7), st.integers(0, 7), st.integers(1, 12))
def test_a_view_without_noise_dilutes_the_truth_by_no_more_than_its_share(seed, r, m, c, views):
    """Adding view n + 1 turns d into (n d + e) / (n + 1), where e >= 0, and 0 at the truth.

    So p(truth) = 1 / sum exp(-(d / 2 sigma^2)) does not fall below that of n views with sigma
    larger by sqrt((n + 1) / n): the mean forgives a cell what the new view does not see of its
    error, and no more. Entropy itself may rise (next test), under this rule or a sum of errors.
    """
    truth = (r, m / 7, c / 7)
    data = angular.samples(seed, 1, views=views + 1, noise=0, truth=truth)
    wider = ANGULAR.sigma * np.sqrt((views + 1) / views)

    def of_truth(data, sigma):
        switches = preset(ANGULAR, method="angular", sigma=float(sigma))
        found = angular_posterior(angular.statistics_of(data), GRID, angular.SCALE, switches)
        return np.array(found.probabilities)[:, r, m, c]

    before = of_truth(pick(data, list(range(views))), wider)
    assert (of_truth(data, ANGULAR.sigma) >= before - 5e-6).all()  # of single probabilities


def test_a_view_that_tells_nothing_makes_the_posterior_wider():
    """The counterexample: all cells explain a black view of an unlit texel alike."""
    truth = (3, 0.375, 0.32 / 0.625)  # Kd = 0.2, R0 = 0.4
    data = angular.samples(40009, 1, views=6, noise=0, truth=truth)
    w, *radiance = (np.concatenate([x, 0 * x[..., :1]], axis=-1) for x in data)
    w[..., -1] = 1
    assert (entropy((w, *radiance)) > entropy(data)).all()


def test_a_view_that_excludes_cells_can_make_the_rest_look_wider():
    """Not even a sum of errors has an entropy that only falls: a rival goes, a crowd stays."""
    before = np.concatenate([[0.45, 0.45], np.full(1000, 1e-4)])
    after = before * np.concatenate([[1, 0], np.ones(1000)])
    H = [-(x[x > 0] * np.log(x[x > 0])).sum() for x in (before, after / after.sum())]
    assert H[1] > H[0]


@pytest.mark.parametrize("counts", [[0, 1, 2, 3], [3, 4, 60, 512]])
def test_the_marginal_rule_pays_for_its_parameters(counts):
    """With as many views as parameters or fewer, nu is 1; the more views, the surer."""
    marginal = preset(ANGULAR, method="angular", noise="marginal")
    data = tuple(np.repeat(x[:1], 4, axis=0) for x in angular.samples(40013, 1))
    H = entropy(data, marginal, counts=np.array(counts))
    expected = [1.0, *[H[1]] * 3] if counts[0] == 0 else sorted(H, reverse=True)
    np.testing.assert_array_equal(H, expected)
