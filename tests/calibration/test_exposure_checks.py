"""Checks of photographs too bright for the light, or with different gains."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball, memory_capture, render_views, run, unit

import svu_mi as svu
from svu_mi import scenes
from svu_mi.bench.captures import even_views
from svu_mi.calibration.checks.check import compare_gains
from svu_mi.calibration.checks.check_result import Finding
from svu_mi.calibration.checks.exposure_checks import (
    Excess,
    Irradiance,
    excess_of,
    saturated_share,
    too_bright,
    warn_of_exposure,
)
from svu_mi.calibration.checks.surface_samples import PointSamples, emitter_of, scatter_points
from svu_mi.calibration.checks.thumbnails import reduce_photographs
from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.quantization import Saturation
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.light.environment import read_environment
from svu_mi.light.latlong import directions
from svu_mi.scenes import lights

VIEWS, SEED = 24, 1203
TOO_BRIGHT = re.compile(
    r"\d\d % of the surface reflects more light than it receives: the photographs are "
    r"too bright for this light, by a factor of [12]\.\d or more; check their gain \(svu import "
    r"--exposures, or divide the photographs\) and the scale of the light "
    r"\(--environment-scale, or scale in the scene\)\."
)


@pytest.fixture(scope="module")
def vase(tmp_path_factory):
    """Photographs of the vase from all sides, in a folder. Read only."""
    return svu.render_capture(
        scenes.path("vase"), 16, folder=tmp_path_factory.mktemp("vase") / "capture", views=VIEWS,
        resolution=(96, 96), defines={"light": "window"},
    )  # fmt: skip


def gained(capture, gains):
    pairs = zip(capture.images, gains, strict=True)
    return replace(capture, images=tuple(image * np.float32(gain) for image, gain in pairs))


def gain_finding(capture):
    return compare_gains(capture, reduce_photographs(capture, 128), [])


def test_right_photographs_have_one_gain(vase):
    finding = gain_finding(vase)
    assert finding.verdict == "fits"
    assert finding.sentence == "All photographs have the same gain, to about 20 %."
    assert gain_finding(gained(vase, [3.0e-5] * VIEWS)).verdict == "fits"  # any unit


@pytest.mark.slow
def test_doubled_photographs_are_too_bright_for_the_light(vase):
    """Photographs half as bright are consistent with a dark vase."""
    finding = gain_finding(gained(vase, [2.0] * VIEWS))
    assert finding.verdict == "unclear" and TOO_BRIGHT.fullmatch(finding.sentence)
    assert gain_finding(gained(vase, [0.5] * VIEWS)).verdict == "fits"


@pytest.mark.few(1)
@pytest.mark.parametrize(("view", "gain"), [(7, 1.5), (2, 0.67), (11, 2.0)])
def test_the_one_photograph_with_another_gain_is_named(vase, view, gain):
    """The gain is approximate, as materials are estimated with it."""
    gains = np.ones(VIEWS)
    gains[view] = gain
    finding = gain_finding(gained(vase, gains))
    assert finding.verdict == "unclear"
    result = re.fullmatch(
        rf"One photograph has a different gain: view_{view:04d}\.exr \(x (\d\.\d\d)\); "
        r"give the exposure of each photograph \(svu import --exposures, or divide its "
        r"pixels by it\), or exclude it\.",
        finding.sentence,
    )
    assert result, finding.sentence
    assert float(result[1]) == pytest.approx(gain, rel=0.08)


def test_many_gains_are_named_largest_first(vase):
    gains = np.exp(np.random.default_rng(SEED).normal(0, 0.3, VIEWS))
    finding = gain_finding(gained(vase, gains))
    assert finding.verdict == "unclear"
    told = [float(x) for x in re.findall(r"\(x (\d\.\d\d)\)", finding.sentence)]
    sizes = np.abs(np.log(told))
    assert len(told) >= 3 and all(a >= b - 0.02 for a, b in pairwise(sizes))
    views = [int(x) for x in re.findall(r"view_(\d{4})", finding.sentence)]
    relative = gains[views] / np.median(gains)
    np.testing.assert_array_equal(np.sign(np.log(told)), np.sign(np.log(relative)))


def test_of_few_photographs_no_gain_is_told(vase):
    finding = gain_finding(even_views(vase, 5))
    assert finding.verdict == "unknown"
    assert finding.sentence == (
        "The gains of the photographs cannot be compared: there are fewer than 8."
    )


def test_gains_wait_for_axes(vase):
    wrong = Finding(question="poses", verdict="wrong", sentence="", fixes=("camera-x180",))
    finding = compare_gains(vase, reduce_photographs(vase, 128), [wrong])
    assert finding.verdict == "unknown" and "must fit first" in finding.sentence


@pytest.mark.slow
@pytest.mark.parametrize(("name", "light"), [("vase", "studio"), ("knot", "clear")])
def test_gains_of_our_own_scenes(name, light):
    """Doubled and single gains of 24 photographs are detected without false positives."""
    all_of_it = svu.render_capture(
        scenes.path(name), 32, views=24, resolution=(96, 96), defines={"light": light}
    )
    for count in (24, 8):
        capture = even_views(all_of_it, count)
        assert gain_finding(capture).verdict == "fits"
        single = np.ones(count)
        single[5] = 0.6
        result = gain_finding(gained(capture, single))
        named = re.findall(r"view_\d+\.exr", result.sentence)
        assert named in ([], [capture.names[5]])
        if count == 24:
            doubled = gain_finding(gained(capture, [2.0] * count))
            assert TOO_BRIGHT.fullmatch(doubled.sentence), doubled.sentence
            assert len(named) == 1, result.sentence


MATERIALS = {"gold": ((0.9, 0.7, 0.3), 0.3, 1.0), "mirror": ((0.95,) * 3, 0.1, 1.0),
             "black": ((0.03,) * 3, 0.15, 0.0), "white": ((0.95,) * 3, 0.8, 0.0)}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("count", [24, 8])
@pytest.mark.parametrize("material", MATERIALS)
def test_no_material_is_taken_for_a_gain(vase, material, count):
    color, roughness, metallic = MATERIALS[material]
    vase.shape.set_bsdf(mi.load_dict({
        "type": "principled", "roughness": roughness, "metallic": metallic,
        "base_color": {"type": "rgb", "value": list(color)},
    }))  # fmt: skip
    sensors = sphere_sensors(vase.shape, count, (64, 64))
    images = render_views(vase.scene, sensors, 16)
    finding = gain_finding(memory_capture(vase.scene, images, sensors))
    assert finding.verdict in ("fits", "unknown"), finding.sentence


@pytest.fixture(scope="module")
def lit_ball():
    """Return a ball, a window light in double precision, and white radiance under it."""
    shape = capture_mesh.make_mesh("ball", ball())
    picture = np.ascontiguousarray(lights.window(), np.float32)
    scene = mi.load_dict(
        {"type": "scene", "light": {"type": "envmap", "bitmap": mi.Bitmap(picture)},
         "ball": shape}, optimize=False,
    )  # fmt: skip
    capture = memory_capture(scene, [], ())
    environment = read_environment(emitter_of(capture))
    points = scatter_points(capture.shape, 300)
    return capture, points, Irradiance.of(scene, points, environment), oracle(environment, points)


def oracle(environment, points):
    """Return irradiance / pi by the trapezoidal rule on the grid of the map, unoccluded.

    (N, 3) float64.
    """
    height, width = environment.radiance.shape[:2]
    toward = directions(width, height).reshape(-1, 3) @ environment.to_local
    theta = np.pi * np.arange(height) / (height - 1)
    area = np.repeat(np.sin(theta) * np.pi / (height - 1) * 2 * np.pi / width, width)
    cosine = np.maximum(points.normal @ toward.T, 0)
    return (cosine * area) @ environment.radiance.reshape(-1, 3) / np.pi


@pytest.mark.slow
def test_the_bound_is_what_a_white_surface_shows(lit_ball):
    _, _, arriving, white = lit_ball
    bright = white.mean(axis=1) > np.median(white.mean(axis=1))
    error = np.abs(arriving.white / white - 1).max(axis=1)[bright]
    assert np.median(error) < 0.005 and error.max() < 0.06  # a window at the horizon is one cell
    assert arriving.free.min() > 0.9


def from_around(points, degrees):
    """Return unit directions (4, N, 3) to four cameras at an angle to the normals."""
    across = unit(np.cross(points.normal, [0.36, 0.48, 0.8]))
    up = np.cross(points.normal, across)
    angle = np.radians(degrees)
    return np.stack([
        np.cos(angle) * points.normal + np.sin(angle) * side for side in (across, -across, up, -up)
    ])  # fmt: skip


def excess_from_four_sides(lit_ball, albedo, degrees, unit):
    _, points, arriving, white = lit_ball
    shown = np.broadcast_to(albedo * white / unit, (4, len(points.position), 3))
    seen = PointSamples(np.ones(shown.shape[:2], bool), shown, from_around(points, degrees))
    return excess_of(seen, points, arriving, unit)


@pytest.mark.parametrize(("albedo", "part"), [(0.95, 0.0), (1.1, 1.0), (1.3, 1.0)])
def test_what_is_brighter_than_white_is_counted(lit_ball, albedo, part):
    """Return samples with equal radiance in four views, in any unit."""
    excess = excess_from_four_sides(lit_ball, albedo, 40, 250.0)
    assert excess.part == pytest.approx(part, abs=0.01)
    assert excess.factor == pytest.approx(albedo, rel=0.04)
    assert (excess.sentence() is None) == (albedo < 1.2)  # paint may slightly exceed the bound


@pytest.mark.parametrize(("degrees", "judged"), [(10, False), (30, True)])
def test_what_is_seen_from_one_side_only_is_not_judged(lit_ball, degrees, judged):
    """Polished metal that mirrors a window to all cameras is three times as bright as white."""
    assert (excess_from_four_sides(lit_ball, 3, degrees, 1.0) is not None) == judged


def test_a_few_bright_points_are_not_a_gain():
    assert Excess(0.09, 3.0).sentence() is None
    assert Excess(0.4, 1.15).sentence() is None  # the whitest possible paint
    assert TOO_BRIGHT.fullmatch(Excess(0.12, 1.6).sentence())


def test_much_saturation_is_reported(vase, monkeypatch):
    """The share is that of the object's pixels, with and without masks."""
    left = np.zeros((96, 96), np.uint8)
    left[:, :48] = 2  # green
    record = Saturation(left, np.ones(3, np.float32))
    capture = replace(vase, clipped=(record, *[None] * (VIEWS - 1)))
    used = replace(capture, used=(True,) + (False,) * (VIEWS - 1))
    part = vase.masks[0][:, :48].sum() / vase.masks[0].sum()
    assert 0.3 < part < 0.7
    for side in (96, 31):
        small = reduce_photographs(used, side)
        assert saturated_share(used, small) == pytest.approx(part, abs=0.05)
        everything = replace(small, masks=(None,) * VIEWS)
        assert saturated_share(used, everything) == pytest.approx(part, abs=0.05)
    gaps = np.random.default_rng(7719).random((96, 96, 1)) < 0.4  # of straightened photographs
    images = (np.where(gaps, np.nan, vase.images[0]), *vase.images[1:])
    small = reduce_photographs(replace(used, images=images), 48)
    assert saturated_share(replace(used, images=images, clipped=(None,) * VIEWS), small) == (
        pytest.approx(0.4, abs=0.06)
    )
    (whole,) = [one for one in svu.check(used).findings if one.question == "saturation"]
    assert whole.verdict == "unclear"
    assert whole.sentence.endswith("photograph with a shorter exposure, or in HDR.")
    assert saturated_share(capture, reduce_photographs(capture, 31)) < 0.05  # of all photographs

    monkeypatch.setattr("svu_mi.calibration.checks.exposure_checks.too_bright", lambda _: None)
    words = "15 % of the samples of texels are saturated or unusable"
    for counts, told in (([2, 0], []), ([0, 3], [words])):
        seen = SimpleNamespace(clipped_coverage=np.array(counts), shown=np.array([12, 8]))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            kept = warn_of_exposure(vase, SimpleNamespace(observed=seen)).warnings
        assert [sentence.partition(":")[0] for sentence in kept] == told
        assert [str(one.message) for one in caught] == list(kept)


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
@pytest.mark.slow
def test_the_console_names_the_gain(vase, tmp_path, capsys):
    """svu entropy warns like svu check; correct photographs cause no warning."""
    texels = svu.texels(vase.mesh, 64)
    assert too_bright(svu.estimate(vase, texels)) is None
    doubled = tmp_path / "doubled"
    doubled.mkdir()
    for image, mask, name in zip(vase.images, vase.masks, vase.files, strict=True):
        alpha = np.float32(mask)[..., None]
        mi.Bitmap(np.concatenate([2 * image, alpha], axis=2)).write(str(doubled / name))
    record = json.loads((vase.source / "capture.json").read_text())
    record["scene"] = str(scenes.path("vase"))
    kept = ("format", "version", "scene", "define", "shape", "sensors")
    (doubled / "capture.json").write_text(json.dumps({key: record[key] for key in kept}))
    out = tmp_path / "out"
    assert run("entropy", doubled, "--resolution", 64, "-o", out, "--no-pictures") == 0
    warned = [x for x in capsys.readouterr().err.splitlines() if x.startswith("svu: warning")]
    assert len(warned) == 1
    assert TOO_BRIGHT.fullmatch(warned[0].removeprefix("svu: warning: "))
    assert run("check", doubled, "-o", tmp_path / "check", "--strict") == 3
    printed = " ".join(capsys.readouterr().out.split())
    assert "gain (UNCLEAR): " in printed and TOO_BRIGHT.search(printed)
    assert (
        "Axes fit, but results may be wrong for another reason: gains or outliers." in printed
    )
