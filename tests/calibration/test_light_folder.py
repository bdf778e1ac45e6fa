"""Folder of estimated light, its scale from known base colours, and its summary."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import Said, ball_scene, made_up_light, names, render_ball

import svu_mi as svu
from svu_mi.calibration.light import grey_card
from svu_mi.calibration.light.light_estimate import UNANCHORED
from svu_mi.calibration.light.light_folder import photographs_of
from svu_mi.calibration.light.light_summary import (
    brightest,
    compare_lights,
    comparison_sentence,
    scale_sentence,
    summary_sentences,
)
from svu_mi.calibration.light.resolve_light import with_light, with_map, with_resolved_light
from svu_mi.capture.capture import LightUncertainty
from svu_mi.capture.content_hash import capture_key, capture_parts, photographs_key
from svu_mi.capture.importers.import_options import ENVIRONMENT_AXES
from svu_mi.capture.replace_material import make_scene
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.core.io.npz import read_arrays, write_arrays
from svu_mi.errors import CaptureError, OptionError, OutputError, SceneError
from svu_mi.posterior.observations import observe
from svu_mi.posterior.prediction import HeldOutPrediction

FIELDS = (
    "logarithm",
    "cell_sd",
    "draws",
    "scale_sd",
    "tint_sd",
    "misfit",
    "widening",
    "texels",
    "remarks",
)
PAINT = {"type": "principled", "roughness": 0.5, "metallic": 0.0,
         "base_color": {"type": "rgb", "value": [0.3, 0.3, 0.3]}}  # fmt: skip


@pytest.fixture(scope="module")
def gray_ball(tmp_path_factory):
    """Return a ball of base colour 0.3 from all sides, in a light with one bright side."""
    light = {"type": "envmap", "bitmap": mi.Bitmap(made_up_light().radiance)}
    return render_ball(tmp_path_factory.mktemp("ball"), light, PAINT, views=12, spp=32)


@pytest.fixture
def kept(tmp_path):
    svu.save_light(made_up_light(), tmp_path / "light", photographs="0" * 32)
    return tmp_path / "light"


def test_what_is_read_is_what_was_written(kept):
    written, light = made_up_light(), svu.load_light(kept)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(light, name), getattr(written, name), name)
    assert light.radiance.tobytes() == written.radiance.tobytes()
    assert photographs_of(kept) == "0" * 32
    layers = read_exr(kept / "light.exr")
    assert sorted(layers) == ["B", "G", "R", "known.Y", "sd.Y"]
    np.testing.assert_array_equal(layers["R"], light.radiance[..., 0])
    np.testing.assert_array_equal(layers["sd.Y"], light.sd)
    record = json.loads((kept / "light.json").read_text())["light"]
    assert record["known"] == pytest.approx(written.known_part)
    assert record["misfit"] == {"still": 0.02, "moving": None}
    assert record["remarks"] == ["Nothing is seen from below."]


def test_an_older_result_is_replaced_but_not_other_files(kept):
    svu.save_light(made_up_light(seed=2), kept)
    (kept / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="notes.txt was not written by svu light"):
        svu.save_light(made_up_light(seed=3), kept)
    assert names(kept) == ["light.exr", "light.json", "light.npz", "notes.txt"]
    assert not np.array_equal(svu.load_light(kept).logarithm, made_up_light().logarithm)


def test_a_folder_that_is_none_is_named(kept, tmp_path):
    with pytest.raises(
        CaptureError, match=r"no such folder; give a folder written by svu light\.$"
    ):
        svu.load_light(tmp_path / "nothing")
    (kept / "light.npz").unlink()
    with pytest.raises(
        CaptureError, match=r"has no light\.npz; give a folder written by svu light"
    ):
        svu.load_light(kept)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file, not a folder"):
        svu.save_light(made_up_light(), tmp_path / "file")


@pytest.mark.parametrize("name", ["light.exr", "light.npz"])
def test_files_of_two_runs_are_refused(kept, tmp_path, name):
    svu.save_light(made_up_light(seed=2), tmp_path / "other")
    shutil.copy(tmp_path / "other" / name, kept / name)
    with pytest.raises(CaptureError, match="different run|another run"):
        svu.load_light(kept)


def test_modified_map_is_refused(kept):
    marks = {"svu:run": json.loads((kept / "light.json").read_text())["written"]["run"]}
    layers = read_exr(kept / "light.exr")
    write_exr(kept / "light.exr", {name: 2 * plane for name, plane in layers.items()}, marks)
    with pytest.raises(CaptureError, match=r"light\.exr: was changed since svu light wrote it"):
        svu.load_light(kept)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"logarithm": np.full((64, 3), np.nan)},
            r"logarithm must be numbers for 64 cells x 3 in \[-60, 60\], got nan",
        ),
        (
            {"draws": np.zeros((2, 63, 3))},
            r"draws must .* 2 draws x 64 cells x 3 .*, got float64 of shape \(2, 63, 3\)",
        ),
        ({"cell_sd": -np.ones(64)}, r"cell_sd must be numbers for 64 cells in \[0, 60\], got -1"),
        ({"widening": 0.5}, r"widening must be a number in \[1, 100000\], got 0.5"),
        ({"moves": 2}, r"moves must be a number in \[0, 1\], got 2"),
        ({"texels": "many"}, "texels must be a number in .*, got 'many'"),
        ({"remarks": 3}, "remarks must be texts for .* remarks, got 3"),
        ({"misfit": None}, "misfit is missing"),
    ],
    ids=lambda value: "_".join(value) if isinstance(value, dict) else "",
)
def test_arrays_that_are_none_are_named(kept, changes, message):
    arrays = {**read_arrays(kept / "light.npz"), **changes}
    kept_ones = {name: value for name, value in arrays.items() if value is not None}
    write_arrays(kept / "light.npz", kept_ones)
    with pytest.raises(CaptureError, match=rf"light\.npz: {message}"):
        svu.load_light(kept)


@pytest.mark.parametrize("misfit", [(np.nan, 0.02), (np.nan, np.nan), (0.02, np.inf), (-1, 1)])
def test_the_light_in_use_has_a_misfit(kept, misfit):
    """NaN stands for light that was not tested, here moving light only."""
    arrays = read_arrays(kept / "light.npz")
    assert not arrays["moves"] and np.isnan(arrays["misfit"]).tolist() == [False, True]
    write_arrays(kept / "light.npz", {**arrays, "misfit": np.array(misfit)})
    with pytest.raises(CaptureError, match=r"light\.npz: .*misfit"):
        svu.load_light(kept)


def test_a_cut_file_is_named(kept):
    path = kept / "light.npz"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CaptureError, match=r"light\.npz: .*; run svu light"):
        svu.load_light(kept)


# --- captures under it ------------------------------------------------------------------------


def test_photographs_key_ignores_light_and_material(gray_ball, tmp_path):
    lit = svu.with_light(gray_ball, made_up_light())
    scene = ball_scene(tmp_path, {"type": "constant"}, {"type": "diffuse"})
    other = replace(gray_ball, scene=scene, shape=scene.shapes()[0], mesh=scene.shapes()[0])
    key = photographs_key(gray_ball)
    assert photographs_key(lit) == photographs_key(other) == key
    assert capture_key(lit) != capture_key(gray_ball)
    brighter = [2 * image for image in gray_ball.images]
    assert photographs_key(replace(gray_ball, images=tuple(brighter))) != key
    assert photographs_key(replace(gray_ball, exposures=(1.0,) * 11 + (2.0,))) != key
    unused = (True,) * 11 + (False,)
    left_out = replace(gray_ball, used=unused)
    assert photographs_key(left_out) != key
    changed = (*gray_ball.images[:11], brighter[11])
    assert photographs_key(replace(left_out, images=changed)) == photographs_key(left_out)


def test_doubt_is_a_part_of_the_light(gray_ball):
    """A recovery cannot be resumed under a light with a different uncertainty."""
    known, doubtful = (
        svu.with_light(gray_ball, replace(made_up_light(), widening=widening))
        for widening in (1.0, 2.0)
    )
    first, second = capture_parts(known), capture_parts(doubtful)
    assert [name for name in first if first[name] != second[name]] == ["light"]


def test_the_scene_keeps_its_integrator(gray_ball):
    lit = svu.with_light(gray_ball, made_up_light())
    assert lit.scene.integrator().class_name() == gray_ball.scene.integrator().class_name()
    assert lit.found_light is not None and lit.environment.id() == "found_light"


def test_a_map_replaces_the_light_and_is_certain(gray_ball, kept):
    lit, notes = with_map(
        svu.with_light(gray_ball, made_up_light()), svu.Light(path=kept / "light.exr")
    )
    assert not notes and lit.light_uncertainty is None and lit.found_light is None
    data = mi.traverse(lit.environment)["data"].numpy()[:, 1:-1]
    np.testing.assert_array_equal(data, made_up_light().radiance)


def test_a_map_may_have_other_axes_and_another_unit(gray_ball, kept):
    """The emitter shows the map turned: along R d it is what the plain map is along d."""
    axes, toward = ENVIRONMENT_AXES["blender"], np.array([0.48, -0.6, 0.64])
    lights = [svu.Light(path=kept / "light.exr"),
              svu.Light(path=kept / "light.exr", to_world=axes, scale=2.0)]  # fmt: skip
    shown = []
    for light, direction in zip(lights, (toward, axes @ toward), strict=True):
        sky = with_map(gray_ball, light)[0].environment
        interaction = dr.zeros(mi.SurfaceInteraction3f)
        interaction.wi = -mi.Vector3f(direction.tolist())
        shown.append(np.array(sky.eval(interaction)).ravel())
    np.testing.assert_allclose(shown[1], 2 * shown[0], rtol=1e-4)
    with pytest.raises(OptionError, match="environment-scale are for maps"):
        with_resolved_light(gray_ball, svu.Light(path=kept, scale=2.0))


def test_a_capture_without_a_light_names_the_way_to_one(gray_ball):
    dark = replace(gray_ball, scene=mi.load_dict({"type": "scene"}))
    with pytest.raises(SceneError) as refused:
        svu.estimate(dark, svu.texels(dark.mesh, 16))
    assert str(refused.value) == (
        "The scene: the capture has no light; estimate it with svu.with_light(capture, "
        "svu.estimate_light(capture, texels))."
    )


def test_a_light_that_moves_is_refused_in_one_sentence(gray_ball, kept):
    svu.save_light(replace(made_up_light(), moves=True, misfit=(0.02, 0.01)), kept)
    with pytest.raises(SceneError, match="The light moves with the camera"):
        with_resolved_light(gray_ball, svu.Light(path=kept))


# --- brightness -------------------------------------------------------------------------------


@pytest.fixture
def proportional(monkeypatch):
    """Base colours are 0.3 under the true light, and inversely proportional to its scale."""

    def estimate(seen, known=None):
        light, truth = seen.capture.found_light.logarithm, made_up_light().logarithm
        mean = np.tile(0.3 * np.exp((truth - light).mean(axis=0)), (seen.texels.count, 1))
        sd = np.full_like(mean, 0.1)
        sd[::2] = 0.01  # uncertain base colours differ
        mean[1::2] *= 1 if known is None else 1.05
        tables = {"mean": {"base_color": mean}, "sd": {"base_color": sd}}
        posterior = SimpleNamespace(**{what: of.__getitem__ for what, of in tables.items()})
        return SimpleNamespace(posterior=posterior)

    monkeypatch.setattr(grey_card, "estimate", estimate)


@pytest.mark.usefixtures("proportional")
@pytest.mark.parametrize("tint", [(0.6, 0.6, 0.6), (1.7, 1.7, 1.7), (1.3, 1.0, 0.8)])
def test_known_base_colours_fix_the_brightness(gray_ball, tint):
    """A wrong scale is corrected by the mean albedo; a grey card corrects channels."""
    truth = made_up_light()
    light = replace(truth, logarithm=truth.logarithm + np.log(tint))
    seen = observe(gray_ball, svu.texels(gray_ball.mesh, 24))
    by_mean = grey_card.scaled_by_mean(light, seen, 0.3)
    by_card = grey_card.scaled_by_card(light, seen, (0.5, 0.5), 0.3)
    ours = [np.exp(one.logarithm - light.logarithm)[0] for one in (by_mean, by_card)]
    np.testing.assert_allclose(ours[1] * tint, 1, rtol=0.02)
    np.testing.assert_allclose(ours[0], ours[0][0], rtol=1e-6)
    np.testing.assert_allclose((1 / ours[0]).mean(), np.mean(tint), rtol=0.05)
    np.testing.assert_array_equal(by_mean.scale_sd, [0.0, 0.15, 0.0])  # tint stays unknown
    # The spot is as uncertain as its texels, whose errors are alike: 0.02 to 0.1 of 0.3.
    assert ((by_card.scale_sd > 0.06) & (by_card.scale_sd < 0.1)).all()


@pytest.mark.slow
def test_a_card_on_a_ball_fixes_the_brightness(gray_ball):
    """As above, with real posteriors."""
    truth = made_up_light()
    light = replace(truth, logarithm=truth.logarithm + np.log(0.6))
    seen = observe(gray_ball, svu.texels(gray_ball.mesh, 24))
    by_card = grey_card.scaled_by_card(light, seen, (0.5, 0.5), 0.3)
    np.testing.assert_allclose(np.exp(by_card.logarithm - light.logarithm), 1 / 0.6, rtol=0.15)


@pytest.mark.usefixtures("proportional")
def test_a_card_that_is_none_is_named(gray_ball):
    seen = observe(gray_ball, svu.texels(gray_ball.mesh, 24))
    with pytest.raises(OptionError, match=r"must be in \[0.01, 1\], got 1.2"):
        grey_card.scaled_by_card(made_up_light(), seen, (0.5, 0.5), 1.2)
    with pytest.raises(OptionError, match=r"texture coordinates are in \[0, 1\]"):
        grey_card.scaled_by_card(made_up_light(), seen, (0.5, 1.5), 0.3)
    with pytest.raises(CaptureError, match="under light that moves with the camera"):
        grey_card.scaled_by_mean(replace(made_up_light(), moves=True), seen, 0.3)
    known = seen.visibility
    blind = replace(known, coverage=0 * known.coverage, total=0 * known.total)
    with pytest.raises(CaptureError, match="no photograph shows the surface at texture coordina"):
        grey_card.scaled_by_card(made_up_light(), replace(seen, visibility=blind), (0.5, 0.5), 0.3)


@pytest.mark.usefixtures("proportional")
def test_a_base_colour_that_no_light_explains_is_named(gray_ball, monkeypatch):
    seen = observe(gray_ball, svu.texels(gray_ball.mesh, 24))
    monkeypatch.setattr(grey_card, "MOST_ROUNDS", 2)
    far = made_up_light().scaled(1e4)
    with pytest.raises(CaptureError, match="No brightness of the light gives this base colour"):
        grey_card.scaled_by_mean(far, seen, 0.3)


# --- words ------------------------------------------------------------------------------------


def test_the_brightest_direction_is_where_the_light_is():
    direction = brightest(made_up_light())
    assert direction is not None and direction @ np.array([1, 0, 0]) > np.cos(np.radians(15))
    even = replace(made_up_light(), logarithm=np.zeros((64, 3)))
    assert brightest(even) is None
    said = list(summary_sentences(made_up_light(), np.eye(3)[1]))
    assert said[0].startswith("The photographs determine ")
    assert "azimuth 9" in said[1] or "azimuth 8" in said[1]
    assert "degrees (0 is -Z, 90 is +X)." in said[1]
    assert said[-1] == "Nothing is seen from below."
    assert "no brightest direction" in list(summary_sentences(even, np.eye(3)[1]))[1]
    from_x = list(summary_sentences(made_up_light(), np.eye(3)[0]))[1]
    assert re.search(r"elevation (8\d|9\d)", from_x)


def test_the_scale_is_said_as_long_as_it_is_open():
    assert scale_sentence(made_up_light()) == (
        "Base colours are determined up to a factor per channel, as brightness and colour of the "
        "light are estimated: R 0.72 to 1.39, G 0.66 to 1.51, B 0.72 to 1.39 (90 % intervals). It "
        "is narrowed by a well-seen spot for --grey-card of svu light, and its part common to all "
        "channels is removed by --mean-albedo. Metals may deviate further."
    )
    assert "R 1.00 to 1.00, G 0.78 to 1.28, B 1.00" in scale_sentence(made_up_light().scaled(2))
    assert "were given" in scale_sentence(made_up_light().scaled(np.full(3, 2)))


def test_a_level_that_was_given_is_known():
    """A scaled light has no remark and no interval about its scale."""
    light = made_up_light()
    light = replace(light, remarks=(*light.remarks, UNANCHORED))
    given = light.scaled(np.full(3, 2.0))
    assert given.remarks == light.remarks[:-1]
    np.testing.assert_allclose(given.radiance, 2 * light.radiance, rtol=1e-5)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(light.radiance)})
    assert compare_lights(given, emitter).inside is None
    assert "the interval" not in comparison_sentence(compare_lights(given, emitter))


def test_doubt_counts_once_however_often_it_is_asked(gray_ball):
    doubted = replace(gray_ball, light_uncertainty=LightUncertainty(3.0, (0.2, 0.2, 0.2)))
    texels = svu.texels(gray_ball.mesh, 16)
    first = svu.estimate(doubted, texels)
    second = svu.estimate(first, preset=first.preset)
    assert first.preset == svu.preset("default", method="angular")
    assert first.switches.overdispersion == 3 * first.preset.overdispersion
    np.testing.assert_array_equal(np.array(first.entropy), np.array(second.entropy))
    own = replace(first.posterior, kernel=replace(first.posterior.kernel, common=(0.0,) * 3))
    seen = np.array(first.coverage) > 0
    for name in ("base_color", "roughness"):
        wide, narrow = (np.array(one.sd(name))[seen] for one in (first.posterior, own))
        assert (wide >= narrow).all() and ((wide > narrow).any() == (name == "base_color"))


def test_possible_maps_differ_about_as_much_as_their_cells():
    """Returns at most the stored number of maps."""
    light = made_up_light()
    same = replace(light, draws=np.tile(light.logarithm, (2, 1, 1)))
    np.testing.assert_array_equal(same.drawn(2), np.stack([light.radiance] * 2))
    maps = light.drawn(9)
    assert maps.shape == (2, 129, 256, 3)
    assert 0.1 < np.log(maps / light.radiance).std() < 0.25


def test_likeness_is_that_of_the_maps():
    truth = made_up_light()
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(truth.radiance)})
    same = compare_lights(truth.scaled(0.5), emitter)
    assert same.correlation > 0.999 and same.angle < 3
    np.testing.assert_allclose(same.scale, 2, rtol=1e-3)
    assert not same.inside and compare_lights(truth, emitter).inside
    opposite = compare_lights(made_up_light(side=-1), emitter)
    assert opposite.correlation < 0 and opposite.angle > 150


# --- photographs in another unit than the light --------------------------------------------------


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_the_common_gain_of_relative_exposures_is_estimated(gray_ball, factor):
    """Photographs that are some times too bright get their brightness back, with an interval."""
    images = [image * np.float32(factor) for image in gray_ball.images]
    relative = replace(gray_ball, images=tuple(images), buffer=None, exposures_relative=True)
    said = Said()
    lit = with_resolved_light(relative, progress=said)
    left = [np.nansum(x) / np.nansum(y) for x, y in zip(lit.images, gray_ball.images, strict=True)]
    sd = np.array(lit.light_uncertainty.scale)
    assert (np.abs(np.log(left)) < 1.645 * sd.max()).all() and (sd < 0.5).all()
    (line,) = (line for line in said.lines if "relative to the environment map" in line)
    low, high = map(float, re.findall(r"R ([\d.]+) to ([\d.]+),", line)[0])
    assert low < factor < high < 8 * low  # unknown: 10


def test_predictions_name_the_light_that_knew_all_photographs(gray_ball):
    known = svu.estimate(gray_ball, svu.texels(gray_ball.mesh, 16), preset="fast")
    known = replace(known, prediction=HeldOutPrediction(0.9, 0.8))
    assert known.prediction_sentence == known.prediction.sentence()
    lit = with_light(gray_ball, made_up_light())
    found = replace(known, observed=replace(known.observed, capture=lit))
    assert found.prediction_sentence.endswith(" The light was estimated from all photographs.")
    floor = mi.load_dict({"type": "rectangle", "id": "floor"})
    tabled = replace(lit, scene=make_scene([*lit.scene.shapes(), floor, *lit.scene.emitters()]))
    found = replace(known, observed=replace(known.observed, capture=tabled))
    assert found.prediction_sentence.endswith("give the light, or leave other shapes out.")
