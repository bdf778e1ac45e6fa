"""Held-out photographs, predicted from the others; and a capture as a phone makes it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle.levels import levels as levels_of
from PIL import Image
from support.helpers import fails, launched_kernels, run

import svu_mi as svu
from svu_mi import scenes
from svu_mi.bench.cases import own_cases
from svu_mi.bench.experiment import BenchRun
from svu_mi.bench.real import find_bars
from svu_mi.bench.real.posterior_predictive import Prediction, diffuse_seen_from
from svu_mi.bench.real.predictors import PREDICTORS, PredictedView, Score, fitted_gain, r_squared
from svu_mi.bench.study import Selection, run_bench
from svu_mi.calibration.light import resolve_light
from svu_mi.capture.image_io import quantized, srgb
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.scene import to_world
from svu_mi.errors import OptionError
from svu_mi.presets import preset
from svu_mi.reflection.roughness_levels import level_shares, spline_weights

VIEWS, FILM = 24, 72
CLIPPED = 0.01  # part of the object's channels
GAIN, BALANCE = 0.3, 0.15  # logarithms, at most
SPOILT = 9  # the photograph that is four times as bright


@pytest.fixture(scope="module")
def phone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a phone and a photogrammetry tool leave it: JPEG photographs, exposed and
    white-balanced one by one, clipped, with masks, poses and a mesh, and no light."""
    folder = tmp_path_factory.mktemp("phone")
    capture = svu.render_capture(
        scenes.path("vase"), spp=16, views=VIEWS, resolution=(FILM, FILM),
        defines={"light": "window"},
    )  # fmt: skip
    on_object = [mi.TensorXf(_depth(capture, sensor)).numpy() > 0 for sensor in capture.sensors]
    rng = np.random.default_rng(3)
    exposures = rng.uniform(-GAIN, GAIN, (VIEWS, 1))
    gains = np.exp(exposures + rng.uniform(-BALANCE, BALANCE, (VIEWS, 3)))
    gains[SPOILT] = 1
    shown = [np.nan_to_num(x) * gain for x, gain in zip(capture.images, gains, strict=True)]
    brightest = np.concatenate([x[mask].ravel() for x, mask in zip(shown, on_object, strict=True)])
    shown[SPOILT] = 4 * shown[SPOILT]
    exposure = 1 / np.quantile(brightest, 1 - CLIPPED)
    frames = []
    for view, sensor in enumerate(capture.sensors):
        photograph, mask = folder / f"IMG_{view:04d}.jpg", folder / f"mask_{view:04d}.png"
        pixels = quantized(srgb(np.clip(exposure * shown[view], 0, 1)))
        Image.fromarray(pixels).save(photograph, quality=92, subsampling=0)
        Image.fromarray(np.uint8(255) * on_object[view]).save(mask)
        frames.append(frame_of(sensor, photograph, mask=mask))
    write_transforms(folder / "transforms.json", frames)
    shutil.copy(scenes.path("vase").parent / "mesh.ply", folder / "mesh.ply")
    return folder


def _depth(capture: svu.Capture, sensor: object) -> object:
    """1 where a sensor sees the object, 0 elsewhere."""
    width, height = sensor.film().crop_size()
    index = dr.arange(mi.UInt32, int(width * height))
    place = mi.Point2f((index % int(width) + 0.5) / width, (index // int(width) + 0.5) / height)
    ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    hit = capture.scene.ray_intersect(ray)
    on = hit.is_valid() & (hit.shape == mi.ShapePtr(capture.shape))
    return dr.reshape(mi.TensorXf(dr.select(on, mi.Float(1), 0)), (int(height), int(width)))


@pytest.fixture(scope="module")
def imported(phone: Path) -> Path:
    assert run("import", phone, "--mesh", phone / "mesh.ply", "-o", phone.parent / "mine") == 0
    return phone.parent / "mine"


@pytest.fixture(scope="module")
def measured(imported: Path) -> Path:
    out = imported.parent / "real"
    assert run("bench", "real", imported, "--quick", "--every", 4, "-o", out) == 0
    return out


@pytest.mark.slow
def test_photographs_of_a_phone_are_predicted(measured):
    (case,) = json.loads((measured / "real.json").read_text())["cells"]
    rows = case["rows"]
    assert (case["photographs"], case["left_out"]) == (VIEWS, VIEWS // 4)
    assert case["odd"] == [f"IMG_{SPOILT:04d}.jpg"]
    assert rows["posterior"]["r2"] > rows["texel means"]["r2"] + 0.03  # .912 beside .856
    assert rows["posterior"]["r2"] > rows["diffuse only"]["r2"]
    assert 0.8 <= rows["posterior"]["holds"]["0.9"] <= 0.97
    assert len(rows["posterior"]["views"]) == VIEWS // 4


@pytest.mark.slow
def test_check_reports_estimated_gains(imported, tmp_path, capsys, monkeypatch):
    few = svu.LightOptions(texels=400, depths=((256, 8),), draws=2, moves=False)
    monkeypatch.setattr(resolve_light, "OPTIONS", few)
    words = ("check", imported, "--gains", "estimate", "-o", tmp_path)
    assert run(*words, "--strict") == 3
    said = " ".join(capsys.readouterr().out.split())
    assert (
        "gain (UNCLEAR): Exposure gains range from 0." in said and "White balance differs" in said
    )
    assert f"IMG_{SPOILT:04d}.jpg is an outlier" in said
    assert "Axes fit, but results may be wrong for another reason: gains or outliers." in said


def test_the_real_benchmark_needs_a_capture(tmp_path):
    with pytest.raises(OptionError, match="No capture given"):
        run_bench(
            BenchRun(tmp_path / "out"), ["real"], Selection(cases=own_cases(["vase"], ["window"]))
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_an_invalid_real_capture_is_refused(imported, tmp_path, capsys):
    out = ("-o", tmp_path / "out")
    assert "needs a capture" in fails(capsys, "bench", "real", *out)
    assert "no such file" in fails(capsys, "bench", "real", tmp_path / "none", *out)
    assert "--every must be at least 2, got 1." in fails(
        capsys, "bench", "real", imported, "--every", 1, *out
    )
    assert "runs on scenes" in fails(capsys, "bench", "speed", imported, *out)
    assert not (tmp_path / "out").exists()


# --- predictions ------------------------------------------------------------------------------


@pytest.mark.slow
def test_predictions_equal_the_model_of_the_statistics(vase):
    """The squared errors of single views add up to the squared errors of the statistics."""
    observed, switches = vase.estimate.observed, preset("default", method="angular")
    number = np.flatnonzero(observed.coverage == observed.coverage.max())[:40]
    levels = levels_of(switches.levels)
    model = observed.model(levels, switches, 3, number)
    level, metallic, color = 6, 0.25, 0.4
    values = {
        "roughness": [dr.full(mi.Float, levels[level], len(number))],
        "metallic": [dr.full(mi.Float, metallic, len(number))],
        "base_color": [dr.full(mi.Float, color, len(number))] * 3,
    }  # fmt: skip
    shares = level_shares(np.full(len(number), levels[level]), switches.levels)
    shares = [mi.Float(x) for x in shares.T.astype(np.float32)]
    prediction = Prediction(observed.views.scene, model, [values], [shares])
    sums = observed.statistics(levels, switches, 3, texels=number)
    expected = sums.errors(np.array([metallic]), np.array([color]))[:, level, :, 0, 0]
    samples = seen_in_views(observed, number)
    sums = np.zeros_like(expected)
    for view, sensor in enumerate(vase.capture.used_sensors):
        (shown,) = prediction.seen_from(to_world(sensor)[:3, 3])
        seen, radiance = samples[view]
        sums += seen[:, None] * np.square(shown - radiance)
    sums /= sum(seen for seen, _ in samples)[:, None]
    np.testing.assert_allclose(sums, expected, rtol=2e-3, atol=1e-5 * observed.unit**2)


def seen_in_views(observed, number) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return visibility and radiance of some texels in every view."""
    from svu_mi.core.arrays import to_drjit
    from svu_mi.geometry.sample_view import TexelLanes, sample_view, sample_visible

    surface = TexelLanes.of(observed.texels, to_drjit(mi.UInt32, number.astype(np.uint32)))
    samples = []
    for view in range(sum(observed.capture.used)):
        which = dr.opaque(mi.UInt32, view)
        seen = sample_view(observed.views, surface, which).seen
        shown = sample_visible(observed.views, surface, which, seen)
        samples.append((seen.numpy().astype(float), shown.radiance.numpy().T))
    return samples


def test_predictions_interpolate_between_levels():
    shares = level_shares(np.array([0.07, 0.5, 1.0]), 8)
    near, weights = spline_weights(np.array([0.07, 0.5, 1.0]), 8)
    for row, which, counts in zip(shares, near, weights, strict=True):
        expected = np.zeros(8)
        np.add.at(expected, which, counts)
        np.testing.assert_allclose(row, expected, atol=1e-6)
    np.testing.assert_allclose(shares.sum(axis=1), 1, rtol=1e-6)
    assert shares[0].min() < 0  # not linear


def test_equal_views_are_equal_and_compile_no_kernels(vase):
    observed = vase.estimate.observed
    number = observed.seen[:200]
    prediction = Prediction.of(vase.estimate, number, draws=2)
    eye = to_world(vase.capture.sensors[0])[:3, 3]
    first = prediction.seen_from(eye)
    assert first.shape == (2, 200, 3) and np.isfinite(first).all() and (first >= 0).all()
    with launched_kernels() as kernels:
        prediction.seen_from(to_world(vase.capture.sensors[1])[:3, 3])
        again = prediction.seen_from(eye)
    assert kernels and not [kernel for kernel in kernels if not kernel["cache_hit"]]
    np.testing.assert_array_equal(first, again)


def test_diffuse_radiance_varies_at_grazing_angles_only(vase):
    observed, switches = vase.estimate.observed, preset("default", method="angular")
    white = diffuse_seen_from(observed, switches, observed.seen[:200])
    center = np.array([0.0, 0.5, 0.0])
    near, far = white(center + [0, 0, 4.0]), white(center + [0, 0, 400.0])
    assert near.shape == (200, 3) and (near >= 0).all()
    np.testing.assert_allclose(np.median(near / np.maximum(far, 1e-9)), 1, rtol=0.2)


def test_prediction_requires_a_calibrated_posterior(vase):
    fixed = svu.estimate(vase.estimate, preset="fixed")
    fast = svu.estimate(vase.estimate, preset="fast")
    for estimated in (fixed, fast):  # without noise, and in grey
        with pytest.raises(OptionError, match="preset default"):
            Prediction.of(estimated, np.arange(4))


# --- scores -----------------------------------------------------------------------------------


def test_gains_do_not_affect_scores():
    rng = np.random.default_rng(0)
    right = rng.uniform(0.1, 1, (400, 3))
    gain = np.array([0.5, 2.0, 1.5])
    np.testing.assert_allclose(fitted_gain(right, right * gain), gain)
    score = Score.start(400)
    score.add(np.arange(400), right * gain, np.ones(400), PredictedView(right[None]))
    record = score.record()
    assert record["facing"] == pytest.approx(1) and np.isnan(record["steep"])
    assert record["r2"] == pytest.approx(1) and record["views"] == pytest.approx([1])
    assert record["holds"] == {} and score.predicted[0].shape == ((~score.first).sum(), 3)


def test_r_squared_of_the_mean_is_zero():
    shown = np.random.default_rng(1).uniform(0, 1, (100, 3))
    mean = np.broadcast_to(shown.mean(axis=0), shown.shape)
    assert r_squared([mean], [shown]) == pytest.approx(0)
    assert r_squared([mean + 1], [shown]) < 0


def test_few_highlights_do_not_decide():
    """One of 400 texels is predicted ten times too bright: R^2 of radiance would be -4.6."""
    right = np.linspace(0.1, 1, 400)[:, None].repeat(3, axis=1)
    wrong, score = right.copy(), Score.start(400)
    wrong[np.flatnonzero(~score.first)[-1]] = 10
    score.add(np.arange(400), right, np.ones(400), PredictedView(wrong[None]))
    b, mean = np.linspace(0.1, 1, 400)[~score.first], right[~score.first].mean()
    squeezed = b / (b + mean)
    error = (10 / (10 + mean) - squeezed[-1]) ** 2
    expected = 1 - error / np.square(squeezed - squeezed.mean()).sum()
    assert score.record()["r2"] == pytest.approx(expected) and expected > 0.9


def test_brightness_of_photographs_does_not_affect_scores():
    """R^2 is 0 without differences between texels, for any exposures of the photographs."""
    rng, score = np.random.default_rng(3), Score.start(400)
    for gain in np.exp(rng.normal(0, 0.7, 12)):
        shown = gain * rng.uniform(0.1, 1, (400, 3))
        score.add(np.arange(400), shown, np.ones(400), PredictedView(np.ones((1, 400, 3))))
    assert -0.2 < score.record()["r2"] < 0.05


def test_a_black_photograph_is_not_scored():
    score = Score.start(400)
    score.add(np.arange(400), np.zeros((400, 3)), np.ones(400), PredictedView(np.ones((1, 400, 3))))
    record = score.record()
    assert np.isnan(record["r2"]) and record["holds"] == {}
    rows = {way.label: record for way in PREDICTORS}
    assert find_bars({"cells": [{"rows": rows}]}) == []


@pytest.mark.parametrize(("claimed", "low", "high"), [(0.1, 0.88, 0.92), (0.03, 0.2, 0.5)])
def test_coverage_of_intervals_depends_on_the_claimed_noise(claimed, low, high):
    rng = np.random.default_rng(2)
    right = rng.uniform(0.5, 1, (8000, 3))
    score = Score.start(8000)
    shown = right + rng.normal(0, 0.1, right.shape)
    score.add(
        np.arange(8000),
        shown,
        np.ones(8000),
        PredictedView(right[None], np.full((1, 8000), claimed)),
    )
    assert low < score.record()["holds"]["0.9"] < high
