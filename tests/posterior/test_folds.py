"""Tests of error bars that folds of the views test."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from evaluation.test_traced_posterior import paint, sky
from oracle.levels import levels as levels_of
from support.helpers import render_ball

import svu_mi as svu
from svu_mi.bench.captures import chosen_views
from svu_mi.bench.spoiled_captures import with_gains
from svu_mi.calibration.poses.pose_equations import moved_sensor
from svu_mi.capture.up_direction import up_direction
from svu_mi.geometry.bitset import Bits
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.environment import read_environment
from svu_mi.light.light_tree import build_light_tree
from svu_mi.light.light_visibility import trace_light_visibility
from svu_mi.posterior.folds import (
    cluster_directions,
    compared,
    farthest_seeds,
    folds_of,
    spread_factors,
)
from svu_mi.posterior.held_out_samples import HeldOutSamples, predict_samples
from svu_mi.posterior.kept_results import pack_test, restore_test
from svu_mi.posterior.neighbor_error import distance_from_neighbors
from svu_mi.posterior.prediction import FoldTest, HeldOutPrediction, PartPrediction
from svu_mi.posterior.support_error import support_error
from svu_mi.posterior.tiled import TiledKernel
from svu_mi.statistics.gather_statistics import Weighting

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
    labels = cluster_directions(around, farthest_seeds(around, 8)).reshape(8, 3)
    assert (labels == labels[:, :1]).all()
    assert sorted(labels[:, 0]) == list(range(8))


@pytest.mark.parametrize(("views", "expected"), [(1, 0), (3, 0), (4, 2), (9, 4), (40, 6)])
def test_folds_contain_every_view_once(views, expected):
    cameras = np.random.default_rng(1).normal(size=(views, 3)) + 7
    folds = folds_of(cameras, np.full(3, 7.0), 6)
    assert len(folds) == expected
    if folds:
        assert sorted(np.concatenate(folds)) == list(range(views))


def test_folds_do_not_depend_on_the_order_of_photographs():
    random = np.random.default_rng(2)
    cameras, order = random.normal(size=(24, 3)), random.permutation(24)
    folds = folds_of(cameras, np.zeros(3), 6)
    shuffled = folds_of(cameras[order], np.zeros(3), 6)
    assert [sorted(order[fold]) for fold in shuffled] == [sorted(fold) for fold in folds]


def test_equal_cameras_are_not_cut_into_folds():
    assert folds_of(np.ones((20, 3)), np.zeros(3), 6) == []


@pytest.mark.parametrize(
    ("views", "factor"),
    [(12, 2.0), (60, 2.0), (3, 1.0), (6, np.sqrt(1 + 3 / 3))],
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


def test_one_texel_that_changes_a_lot_does_not_decide_the_factor():
    """199 of 200 texels change by half of what their variance grows, one by ten deviations."""
    there, sd = np.ones((1, 200), bool), np.array([0.1, 0.2]) * np.ones((200, 1))
    mean = np.where(np.arange(200) == 7, 2.0, np.sqrt(0.015)) * np.array([[0.0], [1.0]])
    found = spread_factors(60, there, {"metallic": (mean[..., None], sd.T[..., None])})
    assert found["metallic"] == 1.0


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
    alone = observed.without(texels, [others, fold])
    sums = alone.statistics(levels, preset(), 3, weighting=weighting).left_out(2)
    np.testing.assert_allclose(sums.table()[..., : table.shape[-1]], table, rtol=1e-9, atol=1e-12)


def from_neighbors(values, texels):
    """Return distances of (t, g) values from the median of up to eight neighbours in the map."""
    width = texels.resolution[0]
    place = np.stack([texels.index.numpy() % width, texels.index.numpy() // width], axis=1)
    place = place.astype(int)[: len(values)]
    apart = np.abs(place[:, None] - place).max(axis=2)
    return np.array([np.abs(own - np.median(values[near == 1], axis=0)) if (near == 1).any()
                     else 0 * own for own, near in zip(values, apart, strict=True)])  # fmt: skip


def test_edges_and_slopes_of_a_map_are_not_errors():
    """A step, a slope and a spot of one texel, in a map of 12 x 9."""
    x, y = np.meshgrid(np.arange(12), np.arange(9))
    image = np.where(x < 6, 0.2, 0.6) + 0.0 * y
    image[6:, 8] += 0.3
    kept = np.random.default_rng(5).permutation(np.flatnonzero((x + y > 0).ravel()))
    ramp = (0.01 * x + 0.02 * y).ravel()[kept]
    found = distance_from_neighbors(np.stack([image.ravel()[kept], ramp], 1), kept, (12, 9))
    place = np.stack([kept % 12, kept // 12], axis=1)
    near = np.abs(place[:, None] - place).max(axis=2) == 1
    expected = [np.abs(image.ravel()[t] - np.median(image.ravel()[kept[n]]))
                for t, n in zip(kept, near, strict=True)]  # fmt: skip
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-6)
    step = (place[:, 0] > 0) & (place[:, 0] < 11) & (place[:, 1] > 0) & (place[:, 1] < 5)
    assert found[step, 0].max() < 1e-6
    inner = step & (place.sum(axis=1) > 3)
    assert found[inner, 1].max() < 1e-6
    spot = found[(place[:, 0] == 8) & (place[:, 1] > 6), 0]
    np.testing.assert_allclose(spot, 0.3, atol=1e-6)
    alone = distance_from_neighbors(np.ones((1, 2)), np.array([3]), (12, 9))
    np.testing.assert_array_equal(alone, 0)


def test_means_stay_and_error_bars_are_multiplied(estimates):
    """Factors end where a texel's standard deviation reaches the prior's."""
    untested, tested = (e.posterior for e in estimates)
    texels = np.flatnonzero(tested.observed)
    assert len(texels) == tested.count  # ``from_neighbors`` takes all texels
    prior_sd = {"roughness": 12**-0.5, "base_color": 12**-0.5, "metallic": np.sqrt(0.2 + 0.2 / 12)}
    for name in NAMES:
        before, after = (np.array(p.sd(name))[texels] for p in (untested, tested))
        mean = np.array(tested.mean(name))
        np.testing.assert_array_equal(mean, np.array(untested.mean(name)))
        mean, most = mean[texels], prior_sd[name]
        blur = 2.5e-5 / np.maximum(mean, 0.1) ** 3 if name == "roughness" else 0
        square = (tested.kernel.spread[name] * before) ** 2 + blur**2
        apart = from_neighbors(mean.reshape(len(texels), -1), estimates[1].texels)
        wide = np.sqrt(np.maximum(square, apart.reshape(mean.shape) ** 2 - square))
        factor = np.maximum(np.minimum(wide, most), before) / before
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


# --- what the object may stand on -----------------------------------------------------------


def test_plane_changes_irradiance_by_its_form_factor():
    """A plane of albedo 1/2 under uniform light halves what comes from below."""
    light = read_environment(mi.load_dict({"type": "constant", "radiance": 3.0}))
    normal = np.random.default_rng(4).normal(size=(50, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    up = np.array([0.6, 0.0, 0.8])
    factor = (1 - normal @ up) / 2  # [Howell, catalog of configuration factors]
    expected = np.repeat(0.5 * 0.5 * factor[:, None], 3, axis=1)
    np.testing.assert_allclose(support_error(light, up, normal), expected, atol=0.01)


@pytest.mark.slow
def test_photographs_from_above_widen_base_color_below(capture, layout, monkeypatch):
    heights = [s.world_transform().matrix[1, 3] for s in capture.sensors]
    above = chosen_views(capture, np.flatnonzero(np.ravel(heights) > -0.5))
    assert svu.estimate(capture, layout).posterior.kernel.support is None
    wide = svu.estimate(above, layout)
    seen, free = wide.observed.seen, wide.posterior.kernel
    mean, sd, own = (np.array(x)[seen] for x in (
        wide.posterior.mean("base_color"), wide.posterior.sd("base_color"),
        replace(wide.posterior, kernel=replace(free, support=None)).sd("base_color")))  # fmt: skip
    normal = np.stack([x.numpy() for x in layout.normal], axis=1)[seen]
    light = read_environment(capture.environment)
    added = mean * support_error(light, up_direction(capture), normal)
    np.testing.assert_allclose(sd, np.hypot(own, added), rtol=1e-4)
    monkeypatch.setattr("svu_mi.pipeline.TILE", 100)
    monkeypatch.setattr(TiledKernel, "size", 100)
    tiled = svu.estimate(above, layout).posterior
    np.testing.assert_allclose(np.array(tiled.sd("base_color"))[seen], sd, rtol=1e-3)


# --- light that the object reflects onto itself ---------------------------------------------


def test_a_disk_hides_its_view_factor():
    up, radius, height = [0.0, 0.0, 1.0], 0.8, np.array([0.2, 0.5, 1.0, 2.0])
    disk = {"type": "disk", "to_world": mi.ScalarTransform4f().scale([radius, radius, 1])}
    scene = mi.load_dict({"type": "scene", "disk": disk})
    surface = TexelLanes(
        position=mi.Point3f(mi.Float(0), mi.Float(0), mi.Float(-height)), normal=mi.Normal3f(up),
        geometric_normal=mi.Normal3f(up), offset=mi.Float(0),
    )  # fmt: skip
    expected = radius**2 / (radius**2 + height**2)  # [Howell, catalog of configuration factors]
    tree = build_light_tree(read_environment(mi.load_dict(sky())), 4096, 4096)
    hidden = trace_light_visibility(scene, surface, tree).hidden_share(surface)
    np.testing.assert_allclose(hidden, expected, atol=0.01)


def test_missing_light_moves_intervals_of_base_color_down(capture, layout):
    posterior = svu.estimate(capture, layout).posterior
    kernel, seen = posterior.kernel, np.flatnonzero(posterior.observed)
    assert kernel.missing.max() < 0.01  # nothing of a ball is hidden
    bounces = svu.preset("default", method="angular", bounces=True)
    assert svu.estimate(capture, layout, preset=bounces).posterior.kernel.missing is None
    part = np.float32(0.4)
    one, other = (replace(posterior, kernel=replace(kernel, missing=missing)) for missing in (
        None, np.full_like(kernel.missing, part)))  # fmt: skip
    (low, high), (new_low, new_high) = (
        (np.array(end, np.float64) for end in x.interval("base_color", 0.9, seen))
        for x in (one, other)
    )
    middle, half = (low + high) / 2, (high - low) / 2
    # u is uniform in [0, 1 / 4]: its mean is 1 / 8.
    wide = np.hypot(half, 1.645 * 0.25 / np.sqrt(12) * part * middle)
    inside = middle * (1 - part / 8) + wide < 1
    np.testing.assert_allclose(new_low, np.maximum(middle * (1 - part / 8) - wide, 0), atol=1e-3)
    mean = np.array(other.mean("base_color"))[seen]
    high = np.maximum(middle * (1 - part / 8) + wide, mean)
    np.testing.assert_allclose(new_high[inside], high[inside], atol=1e-3)
    assert np.array_equal(one.mean("base_color"), other.mean("base_color"))
    sd, new_sd = (np.array(x.sd("base_color"))[seen] for x in (one, other))
    np.testing.assert_allclose(new_sd, np.hypot(sd, mean * part / 4 / np.sqrt(3)), rtol=1e-3)
    assert np.array_equal(one.entropy(), other.entropy())


# --- prediction -----------------------------------------------------------------------------


def test_photographs_that_were_left_out_are_predicted(capture, layout, estimates):
    sound = svu.estimate(capture, layout).prediction
    assert sound.reliable and sound.r2 > 0.8 > sound.r2_of_means
    assert 0.8 < sound.coverage <= 1 and len(sound.photographs) == 24
    assert set(sound.sides) == {"+x", "-x", "+y", "-y", "+z", "-z"}
    assert not estimates[1].prediction.reliable
    assert estimates[0].prediction is None


@pytest.mark.slow
def test_a_photograph_with_a_wrong_pose_is_named(tmp_path):
    """The camera is turned by about four pixels."""
    capture = render_ball(tmp_path, sky(), paint(), views=32, spp=16)
    wrong, sensors = 7, list(capture.sensors)
    sensors[wrong] = moved_sensor(sensors[wrong], np.array([0.05, 0, 0, 0, 0, 0]), 1.0)
    layout = svu.texels(capture.mesh, 64)
    found = svu.estimate(replace(capture, sensors=tuple(sensors)), layout)
    assert found.prediction.odd() == [wrong]
    assert f"worse than the others: {capture.names[wrong]}. If blurred" in found.prediction_sentence
    assert svu.estimate(capture, layout).prediction.odd() == []


def test_ignored_gains_are_named(capture, layout):
    estimate = svu.estimate(with_gains(capture), layout)
    found = estimate.prediction
    assert not found.reliable and found.cause == "gains"
    assert min(estimate.posterior.kernel.spread.values()) >= 1.5  # unreliable
    assert "(--gains estimate)" in found.sentence()


@pytest.mark.parametrize(
    ("r2", "means", "cause", "reliable"),
    [(0.86, 0.9, "", True), (0.61, 0.4, "", True), (0.8, 0.8, "", False),
     (0.73, 0.69, "", True), (0.5, -2.0, "", False),
     (0.95, 0.6, "gains", False)],
)  # fmt: skip
def test_reliable_models_predict_better_than_means(r2, means, cause, reliable):
    prediction = HeldOutPrediction(r2, means, cause=cause)
    assert prediction.reliable == reliable
    sentence = prediction.sentence()
    assert sentence.startswith("Predicts" if reliable else "Unreliable")
    # 1 - R^2 of the means is 0.1: 0.14 is more than 0.95 of it, so texels alone explain as much.
    good = {0.86: "R^2 0.86, good from 0.85 (", 0.61: "0.61, good from 0.6 (", 0.73: "from 0.6 ("}
    assert not reliable or good[r2] in sentence
    noisy = HeldOutPrediction(0.3, 0.25, coverage=0.96).sentence()
    assert (
        noisy
        == "Predicts held-out photographs: R^2 0.30, the rest is noise (means of texels: 0.25)."
    )


def test_samples_are_scaled_to_those_of_other_folds():
    """Texel 0: 1 and 3 in fold 0, 5 in fold 1; texel 1 is in fold 0 only."""
    places = np.array([[0, 0], [0, 0], [0, 1], [1, 0]])  # texel, fold
    shown, base = np.array([[1.0], [3], [5], [7]]), np.array([[1.0], [2], [4], [1]])
    samples = HeldOutSamples(np.arange(4), *places.T, np.array([1.0, 2, 1, 1]), *[shown] * 4)
    means = samples.scaled_to_others(np.ones((4, 1)))[:, 0]
    np.testing.assert_allclose(means, [5, 5, (1 + 2 * 3) / 3, 0])
    scaled = samples.scaled_to_others(base)[:, 0]  # 5 x 4 / 16; (1 + 2 x 6) / (1 + 2 x 4)
    np.testing.assert_allclose(scaled, [1.25, 2.5, 13 / 9 * 4, 0])
    assert samples.scaled_to_others(base, 1.0)[:, 0].tolist() == [1, 2, 4, 0]


def test_errors_of_samples_are_those_of_statistics(capture, layout, estimates):
    """Oracle: the quadratic form of all statistics minus those without a fold, at a level."""
    observed, fold = estimates[0].observed, np.array([1, 4, 9, 20])
    texels, levels = observed.seen[::7], levels_of(8)
    weighting = Weighting(kappa=observed.unit / 2)
    parts = observed.without(texels, [np.array([], int), fold])
    table = parts.statistics(levels, preset(), 3, weighting=weighting).table()
    held_out = table[2, ..., : len(texels)] - table[2, ..., len(texels) :]  # (C, P, t)
    rng = np.random.default_rng(3)
    color, metallic = rng.random((2, len(texels), 3)), rng.random((2, len(texels), 1))
    values = {"base_color": color, "metallic": metallic,
              "roughness": np.full((2, len(texels), 1), levels[2])}  # fmt: skip
    numbers, there = np.ones(24, int), np.zeros((2, len(texels)), bool)
    numbers[fold], there[0] = 0, True
    model = parts.model(levels, preset(), 3, np.arange(len(texels)))
    found = predict_samples(parts, model, weighting, numbers, there, [values, values],
                            np.full(there.shape, 0.5))  # fmt: skip
    assert set(found.view) <= set(fold) and set(found.fold) == {0}
    c, m = color[0].T, metallic[0, :, 0]
    x = np.stack(np.broadcast_arrays(c * (1 - m), c * m, m, np.ones_like(c)))
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    form = sum((1 + (i != j)) * x[i] * x[j] * held_out[:, k] for k, (i, j) in enumerate(pairs))
    square = found.weight[:, None] * (found.radiance - found.predicted) ** 2
    sums = [np.bincount(found.texel, one, len(texels)) for one in square.T]
    np.testing.assert_allclose(sums, form, rtol=1e-3, atol=1e-4 * form.max())
    np.testing.assert_allclose(found.sd, np.repeat(0.5 / found.weight[:, None] ** 0.5, 3, axis=1))


def test_a_test_by_folds_is_restored():
    part = PartPrediction(0.5, 0.75)
    parts = part, PartPrediction(0.1, 0.2)
    sides = dict.fromkeys(("+x", "-x", "+y", "-y", "+z", "-z"), part)
    found = HeldOutPrediction(0.1, 0.2, 0.3, 0.4, "poses", parts, sides)
    for test in (FoldTest(), FoldTest({"roughness": 1.5}), FoldTest({"metallic": 2.0}, found)):
        assert restore_test(pack_test(test)) == test
