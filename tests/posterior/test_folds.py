"""Tests of error bars that folds of the views test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evaluation.test_traced_posterior import paint, sky
from oracle.levels import levels as levels_of
from support.helpers import render_ball

import svu_mi as svu
from svu_mi.bench.captures import chosen_views
from svu_mi.geometry.bitset import Bits
from svu_mi.posterior.folds import cluster_directions, compared, folds_of, spread_factors
from svu_mi.posterior.prediction import HeldOutPrediction, predict
from svu_mi.statistics.gather_statistics import Weighting
from svu_mi.statistics.statistics import Statistics

NAMES = ("roughness", "metallic", "base_color")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("folds")
    return render_ball(folder, sky(), paint(), views=24, resolution=(32, 32), spp=16)


@pytest.fixture(scope="module")
def layout(capture):
    return svu.texels(capture.mesh, 24)


@pytest.fixture(scope="module")
def estimates(capture, layout):
    """Return estimates without and with the test of error bars, from contradictory photographs."""
    untested = svu.estimate(one_side(capture, 3), layout, preset=preset(folds=0))
    return untested, svu.estimate(untested, preset=preset())


def preset(**switches):
    """The preset ``default`` without its assumptions about metals."""
    return svu.preset("default", method="angular", bare_metals=0.0, metal_share=0.5, **switches)


def one_side(capture, gain):
    """Return the capture with photographs from +X brighter by ``gain``."""
    sides = [np.array(s.world_transform().matrix).reshape(4, 4)[0, 3] for s in capture.sensors]
    images = [
        image * (gain if x > 0 else 1) for image, x in zip(capture.images, sides, strict=True)
    ]
    return replace(capture, images=tuple(images))


def test_directions_of_corners_form_their_clusters():
    """Eight corners of a cube, three cameras around each, are eight clusters."""
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    around = np.repeat(corners, 3, axis=0)
    around += np.random.default_rng(0).normal(0, 0.05, around.shape)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    labels = cluster_directions(around, 8).reshape(8, 3)
    assert (labels == labels[:, :1]).all()
    assert sorted(labels[:, 0]) == list(range(8))


@pytest.mark.parametrize(("views", "expected"), [(1, 0), (3, 0), (4, 2), (9, 4), (40, 6)])
def test_folds_contain_every_view_once(views, expected):
    cameras = np.random.default_rng(1).normal(size=(views, 3)) + 7
    folds = folds_of(cameras, np.full(3, 7.0), 6)
    assert len(folds) == expected
    if folds:
        assert sorted(np.concatenate(folds)) == list(range(views))


def test_equal_cameras_are_not_cut_into_folds():
    assert folds_of(np.ones((20, 3)), np.zeros(3), 6) == []


@pytest.mark.parametrize(
    ("views", "factor"),
    [(12, np.sqrt(1.3 * 4)), (60, np.sqrt(1.3 * 4)), (3, 1.0), (6, np.sqrt(1 + 4.2 / 3))],
)
def test_factor_of_means_that_change_twice_as_much_as_expected(views, factor):
    """The variance grows by .01 and means change by .2: r^2 = 4."""
    there = compared(np.array([[20, 20, 20, 5], [15, 20, 0, 4]]))
    assert there.tolist() == [[True, False, False, False]]
    mean = np.array([[0.5, 0.5, 0.5, 0.5], [0.7, 0.1, 0.1, 0.1]])[..., None]
    sd = np.array([[0.1, 0.1, 0.1, 0.1], [np.sqrt(0.02), 0.9, 0.9, 0.9]])[..., None]
    found = spread_factors(views, there, {"roughness": (mean, sd)})
    assert found["roughness"] == pytest.approx(factor)


def test_factor_is_not_below_1():
    there, same = np.ones((1, 1), bool), np.full((2, 1, 1), 0.5)
    sd = np.array([0.1, 0.2]).reshape(2, 1, 1)
    assert spread_factors(60, there, {"metallic": (same, sd)}) == {"metallic": 1.0}


def test_bits_without_groups():
    words = np.random.default_rng(2).integers(0, 2**32, (2, 5), np.uint32)
    bits = replace(Bits.clear(40, 5), words=as_uint32(words.ravel()))
    found = bits.without([np.array([], int), np.array([0, 31, 32])]).words.numpy().reshape(2, 2, 5)
    np.testing.assert_array_equal(found[:, 0], words)
    np.testing.assert_array_equal(found[0, 1], words[0] & 0x7FFFFFFE)
    np.testing.assert_array_equal(found[1, 1], words[1] & 0xFFFFFFFE)


def as_uint32(values):
    import mitsuba as mi

    return mi.UInt32(np.ascontiguousarray(values))


def test_statistics_without_a_fold_are_those_of_the_other_photographs(capture, layout, estimates):
    observed, fold = estimates[0].observed, np.array([1, 4, 9, 20])
    others = np.setdiff1d(np.arange(capture.count), fold)
    texels = observed.seen[::7]
    weighting, levels = Weighting(kappa=observed.unit / 2), np.linspace(0, 1, 8)
    parts = observed.without(texels, [np.array([], int), fold])
    table = parts.statistics(levels, preset(), 3, weighting=weighting).table()
    fewer = svu.estimate(chosen_views(one_side(capture, 3), others), layout).observed
    for number, expected in enumerate((observed, fewer)):
        whole = expected.statistics(levels, preset(), 3, weighting=weighting, texels=texels)
        part = table[..., number * len(texels) : (number + 1) * len(texels)]
        np.testing.assert_allclose(part, whole.table(), rtol=1e-5, atol=1e-9)


def test_means_stay_and_error_bars_are_multiplied(estimates):
    """Factors end where a texel's standard deviation reaches the prior's."""
    untested, tested = (e.posterior for e in estimates)
    texels = np.flatnonzero(tested.observed)
    prior_sd = {"roughness": 12**-0.5, "base_color": 12**-0.5, "metallic": np.sqrt(0.2 + 0.2 / 12)}
    for name in NAMES:
        before, after = (np.array(p.sd(name))[texels] for p in (untested, tested))
        mean = np.array(tested.mean(name))
        np.testing.assert_array_equal(mean, np.array(untested.mean(name)))
        mean, most = mean[texels], prior_sd[name]
        factor = np.clip(most / np.maximum(before, 1e-9), 1, tested.kernel.spread[name])
        np.testing.assert_allclose(after, factor * before, rtol=1e-3)
        low, high = (np.array(x)[texels] for x in tested.interval(name))
        old = [np.array(x)[texels] for x in untested.interval(name)]
        expected = [np.clip(mean + factor * (x - mean), 0, 1) for x in old]
        np.testing.assert_allclose([low, high], expected, atol=2e-3)
        half = np.array(tested.half_width(name))[texels]
        assert (half <= (high - low).reshape(len(texels), -1).max(axis=1) / 2 + 1e-5).all()
        drawn, old = (np.array(p.draw(2, seed=3)[name])[:, texels] for p in (tested, untested))
        np.testing.assert_allclose(drawn, np.clip(mean + factor * (old - mean), 0, 1), atol=2e-3)
    assert (np.array(tested.entropy())[texels] >= np.array(untested.entropy())[texels]).all()


def test_brighter_side_widens_error_bars(capture, layout, estimates):
    sound = svu.estimate(capture, layout, preset=preset()).posterior.kernel.spread
    assert sound == dict.fromkeys(NAMES, 1.0)
    spread = estimates[1].posterior.kernel.spread
    assert spread["roughness"] > 1.2 and spread["metallic"] > 1.5  # 1.39 and 1.74


def test_few_views_are_not_folded(capture, layout):
    one = svu.estimate(chosen_views(capture, [0]), layout)
    assert one.posterior.kernel.spread == {}
    assert np.isfinite(np.array(one.posterior.sd("roughness"))).all()


def test_presets_without_folds_are_not_widened(capture, layout):
    assert svu.estimate(capture, layout, preset="fast").posterior.kernel.spread == {}


# --- prediction -----------------------------------------------------------------------------


def test_photographs_that_were_left_out_are_predicted(capture, layout, estimates):
    sound = svu.estimate(capture, layout).prediction
    assert sound.reliable and sound.r2 > 0.7 and sound.r2_of_means < 0  # .75 and -.11
    assert not estimates[1].prediction.reliable
    assert estimates[0].prediction is None


@pytest.mark.parametrize(
    ("values", "reliable"),
    [((0.76, 0.9), True), ((0.7, 0.75), True), ((0.7, 0.8), False), ((0.4, -2.0), False)],
)
def test_reliable_models_predict_as_well_as_means(values, reliable):
    prediction = HeldOutPrediction(*values)
    assert prediction.reliable == reliable
    assert prediction.sentence().startswith("Predicts" if reliable else "Unreliable")


def test_prediction_is_that_of_the_samples_themselves():
    """Two folds of two samples of one texel, at two levels; oracle: the samples one by one."""
    random = np.random.default_rng(4)
    levels = levels_of(4)
    e, p, q, d, b, w = (random.random((6, 8, 3)) for _ in range(6))  # texel, sample, channel
    e, p, q, d = (np.repeat(x[None], 4, axis=0) * (1 + levels[:, None, None, None])
                  for x in (e, p, q, d))  # fmt: skip
    w = np.repeat(w[..., :1], 3, axis=2)
    fold = np.arange(8) % 2

    def table(kept):
        """Return sums (R, C, P, texels) of the samples ``kept``."""
        columns = [e, p, q - d, d - b]
        return np.stack([
            np.einsum("rtsc,rtsc,tsc->rct", columns[i], columns[j], w * kept[:, None])
            for i in range(4) for j in range(i, 4)
        ], axis=2)  # fmt: skip

    def moments(kept):
        first, second = ((w * b**k * kept[:, None]).sum(axis=1).T for k in (1, 2))
        return np.concatenate([[(w[..., 0] * kept).sum(axis=1)], first, second])

    groups = [np.ones(8), fold != 0, fold != 1]
    sums = np.concatenate([table(kept) for kept in groups], axis=-1)
    statistics = Statistics.of(sums, np.ones(18), np.full(18, 8), levels)
    means = {"roughness": np.repeat(levels[1], 18)[:, None], "metallic": random.random((18, 1)),
             "base_color": random.random((18, 3))}  # fmt: skip
    found = predict(statistics, np.concatenate([moments(k) for k in groups], axis=1), means,
                    np.ones((2, 6), bool))  # fmt: skip
    error = total = by_means = 0.0
    everything = np.ones(b.shape, bool)
    overall = [np.average(b[..., c], weights=w[..., c]) for c in range(3)]
    for texel, sample, c in np.argwhere(everything):
        k = fold[sample]
        row = 6 * (1 + k) + texel
        m, color = means["metallic"][row, 0], means["base_color"][row, c]
        at = (1, texel, sample, c)  # roughness 1/3 is the second level
        r = (1 - m) * (color * e[at] + d[at]) + m * (color * p[at] + q[at])
        others = fold != k
        mean = np.average(b[texel, others, c], weights=w[texel, others, c])
        weight, shown = w[texel, sample, c], b[texel, sample, c]
        error += weight * (r - shown) ** 2
        by_means += weight * (mean - shown) ** 2
        total += weight * (shown - overall[c]) ** 2
    assert found.r2 == pytest.approx(1 - error / total, rel=1e-6)
    assert found.r2_of_means == pytest.approx(1 - by_means / total, rel=1e-6)
