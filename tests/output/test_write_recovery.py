"""Recovered textures as files, the scene that uses them, relit pictures, and the page."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball, memory_capture, sensor_xml, write_older, write_scene

import svu_mi as svu
from svu_mi.capture import mesh as meshes
from svu_mi.capture import scene_xml
from svu_mi.capture.quantization import Saturation
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.sensors import describe, make_sensor, sphere_sensors
from svu_mi.core.io.exr import read_exr, read_header, write_exr
from svu_mi.errors import CaptureError, OptionError, OutputError, SvuWarning
from svu_mi.evaluation.psnr import psnr
from svu_mi.light.environment import read_environment
from svu_mi.output.rerender import RenderComparison, compare_renders, write_relit
from svu_mi.output.texture_files import read_textures, write_textures
from svu_mi.output.texture_files import write_scene as write_recovered
from svu_mi.output.write_recovery import write_recovery
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.relighting import novel_light, path_length, relight
from svu_mi.recovery.svbrdf_textures import Textures, lay_out, scene_textures

RNG_SEED = 1186230517
BETTER_THAN = 40.0  # dB; below what one differing texel of a hundred would leave


def scaled_psnr(image, truth):
    """Peak signal-to-noise ratio; the peak is the 99 % quantile of the truth."""
    peak = np.quantile(truth, 0.99)
    return psnr(np.array(image) / peak, np.array(truth) / peak)


def any_textures(height=6, width=10):
    rng = np.random.default_rng(RNG_SEED)
    return Textures.of({n: rng.random((height, width, CHANNELS[n]), np.float32) for n in NAMES})


def fake_recovery(texels, textures, steps=60):
    losses = np.exp(-np.arange(steps) / 20, dtype=np.float32) + 0.01
    return SimpleNamespace(
        estimate=None, method="sh", texels=texels, textures=textures, losses=losses,
        coverage=mi.UInt32(np.arange(texels.count) % 4), timings={"Descending": 1.5},
        settings={"tv": 0.01, "seed": 3},
        image=lambda name: np.squeeze(np.array(getattr(textures, name))),
    )  # fmt: skip


@pytest.fixture(scope="module")
def fine(vase):
    """Texels of the vase as fine as its true textures, and these."""
    texels = svu.texels(vase.capture.mesh, resolution=256)
    return SimpleNamespace(texels=texels, truth=scene_textures(vase.capture, texels))


# --- Textures -----------------------------------------------------------------------------


def test_textures_come_back_bit_by_bit(tmp_path):
    images = {name: np.array(tensor) for name, tensor in any_textures().items()}
    for image in images.values():
        image[0, :2] = [[0], [1]]  # the ends of the range
    textures = Textures.of(images)
    write_textures(textures, tmp_path, {"svu:method": "sh"})
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "base_color.exr", "metallic.exr", "roughness.exr",
    ]  # fmt: skip
    assert sorted(read_exr(tmp_path / "base_color.exr")) == ["B", "G", "R"]
    assert list(read_exr(tmp_path / "roughness.exr")) == ["Y"]
    header = read_header(tmp_path / "metallic.exr").attributes
    assert header["svu:method"] == "sh" and header["svu:version"] == svu.__version__
    for name, tensor in read_textures(tmp_path).items():
        np.testing.assert_array_equal(np.array(tensor), np.array(getattr(textures, name)))


@pytest.mark.parametrize("channel", ["R", "RGB"])
def test_a_grey_texture_of_another_program_is_read(tmp_path, channel):
    textures = any_textures()
    write_textures(textures, tmp_path)
    grey = np.array(textures.roughness)[..., 0]
    values = grey if channel == "R" else np.dstack([grey] * 3)
    write_exr(tmp_path / "roughness.exr", {channel: values})
    np.testing.assert_array_equal(np.array(read_textures(tmp_path).roughness)[..., 0], grey)


@pytest.mark.parametrize(
    ("name", "channels", "sentence"),
    [
        ("base_color", {"Y": np.zeros((6, 10))}, "expected the channels R, G, B, found Y"),
        ("metallic", {"Z": np.zeros((6, 10))}, "expected the channels Y, found Z"),
        ("roughness", {"RGB": np.random.default_rng(5).random((6, 10, 3))}, "unequal"),
        ("roughness", {"Y": np.zeros((5, 10))}, "roughness.exr 10 x 5, metallic.exr 10 x 6"),
        ("roughness", {"Y": np.full((6, 10), 1.5)}, r"60 values are outside \[0, 1\]"),
        ("base_color", None, r"has no base_color\.exr, so it is not a result of svu recover"),
    ],
)
def test_files_that_are_not_textures_are_refused(tmp_path, name, channels, sentence):
    write_textures(any_textures(), tmp_path)
    if channels is None:
        (tmp_path / f"{name}.exr").unlink()
    else:
        write_exr(tmp_path / f"{name}.exr", channels)
    with pytest.raises(CaptureError, match=sentence):
        read_textures(tmp_path)
    with pytest.raises(CaptureError, match="nowhere: no such folder"):
        read_textures(tmp_path / "nowhere")


def test_textures_that_are_nan_are_not_written(tmp_path):
    images = {name: np.array(tensor) for name, tensor in any_textures().items()}
    images["metallic"][2, 3] = np.nan
    with pytest.raises(OutputError, match="NaN"):
        write_textures(Textures.of(images), tmp_path)
    assert not (tmp_path / "metallic.exr").exists()


# --- The scene ----------------------------------------------------------------------------


def test_the_scene_shows_what_the_capture_shows(vase, fine, tmp_path):
    """With the true textures, render equals render: same paths, so there is no noise between."""
    path = write_recovered(vase.capture, fine.truth, tmp_path)
    scene = mi.load_file(str(path))
    for view in (0, 3):
        mine = mi.render(scene, sensor=view, spp=32, seed=view)
        sensor = vase.capture.sensors[view]
        own = mi.render(vase.capture.scene, sensor=sensor, spp=32, seed=view)
        assert mine.shape == (36, 48, 3)
        assert scaled_psnr(mine, own) > BETTER_THAN


def test_the_scene_has_ids_and_relative_names(vase, fine, tmp_path):
    folder = tmp_path / "a folder"
    path = write_recovered(vase.capture, fine.truth, folder)
    root = ElementTree.parse(path).getroot()
    names = [node.get("value") for node in root.iter("string") if node.get("name") == "filename"]
    assert sorted(names) == [
        "assets/environment.exr", "assets/mesh.ply", "base_color.exr", "metallic.exr",
        "roughness.exr",
    ]  # fmt: skip
    moved = tmp_path / "elsewhere"
    folder.rename(moved)
    scene = mi.load_file(str(moved / path.name), optimize=False)
    assert [shape.id() for shape in scene.shapes()] == ["vase"]
    assert [sensor.id() for sensor in scene.sensors()] == [f"view_{k:04d}" for k in range(4)]
    params = mi.traverse(scene)
    assert {"vase.bsdf.base_color.data", "vase.bsdf.roughness.data"} <= {key for key, _ in params}
    assert scene.emitters()[0].id() == "light"
    assert scene.integrator().class_name() == "PathIntegrator"
    assert path_length(scene) == path_length(vase.capture.scene) == 6


def test_mitsuba_alone_loads_the_scene(vase, fine, tmp_path):
    path = write_recovered(vase.capture, fine.truth, tmp_path)
    code = (
        "import sys, mitsuba as mi; mi.set_variant('scalar_rgb');"
        f"s = mi.load_file({str(path)!r}, spp=1); assert 'svu_mi' not in sys.modules;"
        "print(len(s.sensors()), s.sensors()[0].sampler().sample_count())"
    )
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=clean,
        cwd=tmp_path,
    )  # fmt: skip
    assert done.stdout.split() == ["4", "1"]


def odd_capture(tmp_path, **changes):
    """A ball with a neighbour, odd films, a turned light, and pictures of nothing."""
    extra = """
      <shape type="sphere" id="neighbour"><float name="radius" value="0.4"/>
        <point name="center" x="1.2" y="0.3" z="0.5"/>
        <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.7 0.3 0.2"/>
        </bsdf></bsdf></shape>
      <shape type="rectangle" id="floor"><transform name="to_world"><scale value="3"/>
        <rotate x="1" angle="-90"/><translate y="-1"/></transform>
        <bsdf type="principled"><rgb name="base_color" value="0.2 0.5 0.3"/>
        <float name="roughness" value="0.3"/><float name="clearcoat" value="0.5"/></bsdf></shape>
      <shape type="disk"><transform name="to_world"><translate x="-1.5" z="0.2"/></transform>
        <bsdf type="conductor"/></shape>"""
    path = write_scene(tmp_path, sensors=sensor_xml(1), extra=extra, **changes)
    scene = mi.load_file(str(path), optimize=False)
    object_ = next(s for s in scene.shapes() if s.id() == "ball")
    sensors = []
    for index, sensor in enumerate(sphere_sensors(object_, 3, (60, 40))[:2]):  # above the floor
        record = describe(sensor)
        record["principal_point_offset"] = [0.07, -0.04 * index]
        record["crop_offset"], record["crop_size"] = [4, 2 * index], [40, 30]
        sensors.append(make_sensor(record, f"odd {index}"))
    images = [np.ones((30, 40, 3))] * 2
    return memory_capture(scene, images, sensors, shape=object_, mesh=object_)


def without(capture, *kinds):
    """The same capture without shapes of some classes."""
    kept = [s for s in capture.scene.shapes() if s.class_name() not in kinds]
    return replace(capture, scene=make_scene([*capture.scene.emitters(), *kept]))


def under(capture, emitter):
    """The same capture under another light, in a scene of its own."""
    scene = make_scene([mi.load_dict(emitter), *capture.scene.shapes()])
    return replace(capture, scene=scene)


def lopsided_map():
    pixels = np.random.default_rng(RNG_SEED).gamma(0.4, size=(17, 32, 3)).astype(np.float32)
    pixels[[0, -1]] = pixels[[0, -1], :1]  # at a pole all columns are one direction
    return mi.Bitmap(pixels)


def turned(mirror: bool):
    turn = mi.ScalarTransform4f().rotate([0.6, 0.8, 0], 50)
    if not mirror:
        return turn
    return mi.ScalarTransform4f(np.array(turn.matrix) @ np.diag([-1.0, 1, 1, 1]))


LIGHTS = {
    "turned map": lambda: {"type": "envmap", "bitmap": lopsided_map(), "to_world": turned(False)},
    "mirrored map": lambda: {
        "type": "envmap", "bitmap": lopsided_map(), "to_world": turned(True), "scale": 2.5,
    },
    "constant": lambda: {"type": "constant", "radiance": {"type": "rgb", "value": [1, 2, 0.5]}},
    "sky": lambda: {
        "type": "sunsky", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90),
        "sun_direction": [0.3, 0.8, 0.4], "turbidity": 4.0, "sun_aperture": 4.0,
    },
}  # fmt: skip


@pytest.mark.parametrize("light", LIGHTS)
def test_any_light_is_kept(tmp_path, light):
    capture = without(odd_capture(tmp_path), "Disk", "Rectangle", "Sphere")
    capture = under(capture, LIGHTS[light]())
    path = write_recovered(capture, any_textures(), tmp_path / "out")
    scenes_ = (mi.load_file(str(path), optimize=False), capture.scene)
    one, other = (read_environment(scene.emitters()[0]) for scene in scenes_)
    # float32 matrices turn directions by 1e-7; next to a sun's edge that is seen.
    np.testing.assert_allclose(one.radiance, other.radiance, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(one.to_local, other.to_local, atol=1e-6)
    assert len(one.disk_weights) == len(other.disk_weights)
    for degree in (0, 3):  # with the sun
        expected = other.coefficients(degree)
        tolerance = 1e-3 * np.abs(expected).max()  # where the edge of the disk is found
        np.testing.assert_allclose(one.coefficients(degree), expected, atol=tolerance)


@pytest.mark.slow
def test_odd_films_and_neighbours_are_kept(tmp_path):
    """Crops, principal points, spheres, floors, a mirrored map: the same to the last path."""
    capture = under(without(odd_capture(tmp_path), "Disk"), LIGHTS["mirrored map"]())
    textures = any_textures(32, 64)
    written = mi.load_file(str(write_recovered(capture, textures, tmp_path / "out")))
    # Mitsuba puts meshes first.
    assert sorted(shape.id() for shape in written.shapes()) == ["ball", "floor", "neighbour"]
    for view, image in enumerate(relight(capture, textures, None, spp=16)):
        render = mi.render(written, sensor=view, spp=16, seed=view)
        assert render.shape == image.shape == (30, 40, 3)
        assert scaled_psnr(render, image) > BETTER_THAN


def test_a_material_that_cannot_be_written_is_said(tmp_path):
    capture = odd_capture(tmp_path)
    with pytest.warns(SvuWarning, match="SmoothConductor cannot be written"):
        write_recovered(capture, any_textures(), tmp_path / "out")


@pytest.mark.parametrize(("texture", "sentence"), [
    ({"type": "checkerboard"}, "has its default value"),
    ({"type": "bitmap", "bitmap": None, "to_uv": 8.0}, "loses its to_uv"),
])  # fmt: skip
def test_textures_that_change_in_writing_are_reported(tmp_path, texture, sentence):
    texture = dict(texture)
    if "bitmap" in texture:
        texture["bitmap"] = mi.Bitmap(np.ones((4, 4, 3), np.float32))
        texture["to_uv"] = mi.ScalarTransform3f().scale(texture["to_uv"])
    with pytest.warns(SvuWarning, match=f"reflectance .* {sentence}"):
        scene_xml.material(
            mi.load_dict({"type": "diffuse", "reflectance": texture}), tmp_path, "floor"
        )


@pytest.mark.slow
def test_a_mesh_without_uvs_is_written_with_those_of_its_texels(tmp_path):
    flat = ball()
    path = write_scene(
        tmp_path, sensors=sensor_xml(2), uvs=None, positions=flat.positions * [1, 1.3, 0.8],
        normals=None,
    )  # fmt: skip
    with pytest.warns(SvuWarning, match="has no UVs"):
        capture = svu.render_capture(path, spp=2)
    texels = svu.texels(capture.mesh, resolution=48)
    rng = np.random.default_rng(RNG_SEED)
    values = {"base_color": rng.random((texels.count, 3)), "roughness": rng.random(texels.count),
              "metallic": rng.random(texels.count)}  # fmt: skip
    textures = lay_out(texels, values)
    written = mi.load_file(str(write_recovered(capture, textures, tmp_path / "out")))
    assert path_length(written) == 2  # the scene's integrator is direct
    assert meshes.has_uvs(written.shapes()[0])
    assert written.shapes()[0].has_vertex_normals() == capture.mesh.has_vertex_normals()
    image = relight(capture, textures, None, spp=16)[1]
    assert scaled_psnr(mi.render(written, sensor=1, spp=16, seed=1), image) > BETTER_THAN


def test_an_object_open_to_both_sides_stays_so(tmp_path):
    capture = svu.render_capture(write_scene(tmp_path, sensors=sensor_xml(2)), spp=1)
    capture.shape.set_bsdf(mi.load_dict({"type": "twosided", "b": {"type": "principled"}}))
    written = mi.load_file(str(write_recovered(capture, any_textures(), tmp_path / "out")))
    assert "TwoSided" in written.shapes()[0].bsdf().class_name()


@pytest.mark.filterwarnings("ignore:Light reflected by:svu_mi.errors.SvuWarning")
def test_ids_that_meet_are_told_apart(tmp_path):
    """The light has no name and is called light, as is the object; another is named as a camera."""
    extra = """<shape type="disk" id="view_0000"><bsdf type="diffuse"/></shape>
      <shape type="disk" id="light_material"><bsdf type="diffuse"/></shape>"""
    path = write_scene(tmp_path, sensors=sensor_xml(2), extra=extra)
    text = path.read_text().replace(' id="light"', "").replace('id="ball"', 'id="light"')
    path.write_text(text)
    capture = svu.render_capture(path, spp=1, shape="light")
    written = write_recovered(capture, any_textures(), tmp_path / "out")
    scene = mi.load_file(str(written), optimize=False)
    shapes = {shape.id() for shape in scene.shapes()}
    assert shapes == {"light", "view_0000", "light_material"}
    assert [sensor.id() for sensor in scene.sensors()] == ["view_0000_2", "view_0001"]


# --- Another light ------------------------------------------------------------------------


@pytest.mark.slow
def test_relit_truth_is_truth(vase, fine):
    """Recovered textures that are the true ones look the same under any light."""
    light = novel_light(vase.capture)
    sensors = vase.capture.sensors[:2]
    truth = relight(vase.capture, None, light, sensors, spp=32)
    for mine, own in zip(
        relight(vase.capture, fine.truth, light, sensors, spp=32), truth, strict=True
    ):
        assert mine.dtype == np.float32 and mine.shape == (36, 48, 3)
        assert scaled_psnr(mine, own) > BETTER_THAN
    own_light = relight(vase.capture, None, None, sensors[:1], spp=32)[0]
    assert scaled_psnr(own_light, truth[0]) < 25  # it is another light indeed


def test_the_novel_light_is_as_bright_and_stands_upright(vase, tmp_path):
    mean = read_environment(vase.capture.scene.emitters()[0]).coefficients(0)
    light = read_environment(novel_light(vase.capture))
    np.testing.assert_allclose(light.coefficients(0).mean(), mean.mean(), rtol=1e-2)
    capture = under(odd_capture(tmp_path), LIGHTS["turned map"]())
    up = read_environment(novel_light(capture)).to_local
    np.testing.assert_allclose(up, np.array(turned(False).matrix)[:3, :3].T, atol=1e-6)


def test_relighting_refuses_no_samples(vase, fine):
    with pytest.raises(OptionError, match="spp must be at least 1"):
        relight(vase.capture, fine.truth, spp=0)


@pytest.mark.slow
def test_relighting_leaves_the_capture_as_it_was(vase):
    before = relight(vase.capture, None, None, vase.capture.sensors[:1], spp=4)[0]
    relight(vase.capture, None, novel_light(vase.capture), spp=1)
    relight(vase.capture, any_textures(), novel_light(vase.capture), spp=1)
    after = relight(vase.capture, None, None, vase.capture.sensors[:1], spp=4)[0]
    np.testing.assert_array_equal(before, after)
    assert vase.capture.shape.id() == "vase" and vase.capture.scene.emitters()[0].id() == "light"


# --- Pictures -----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_perfect_recovery_differs_by_noise_alone(vase, fine, tmp_path):
    comparison = compare_renders(vase.capture, fine.truth, [1], spp=32)[0]
    wrong = compare_renders(vase.capture, any_textures(), [1], spp=32)[0]
    assert comparison.photograph.shape == comparison.render.shape == (36, 48, 3)
    error = comparison.difference
    assert np.isnan(error[~comparison.inside]).all()
    assert comparison.mean_difference < 0.6 * wrong.mean_difference
    write_relit([comparison, wrong], tmp_path / "relit.png")
    assert mi.Bitmap(str(tmp_path / "relit.png")).size()[0] == 1160


@pytest.mark.slow
def test_pictures_of_large_photographs_are_small(vase, fine):
    """A photograph of more than 320 pixels is reduced; pixels next to unusable ones are lost."""
    record = describe(vase.capture.sensors[0])
    record.update(film=[1200, 900], crop_size=[1200, 900])
    photograph = np.ones((900, 1200, 3), np.float32)
    photograph[400:440, 500:540] = np.nan
    capture = replace(vase.capture, sensors=(make_sensor(record, "large"),), images=(photograph,))
    comparison = compare_renders(capture, fine.truth, [0], spp=1)[0]
    assert comparison.photograph.shape == (240, 320, 3)
    hole = np.isnan(comparison.photograph).all(axis=2)
    assert hole[112, 138] and 100 < hole.sum() < 400 and (comparison.exact == ~hole).all()
    np.testing.assert_allclose(comparison.photograph[~hole], 1, rtol=1e-3)  # filters ring
    red = np.isnan(photograph).all(axis=2).astype(np.uint8)
    saturated = replace(capture, clipped=(Saturation(red, np.full(3, 5, np.float32)),))
    bright = compare_renders(saturated, fine.truth, [0], spp=1)[0]
    assert (bright.exact == comparison.exact).all() and np.isnan(bright.photograph[112, 138]).all()
    photograph[400:440, 500:540, 1:] = 1  # only red has no value
    bright = compare_renders(saturated, fine.truth, [0], spp=1)[0]
    np.testing.assert_allclose(bright.photograph[112, 138], [5, 1, 1], rtol=1e-3)
    assert not bright.exact[112, 138]


def test_nothing_to_compare_is_no_error(tmp_path):
    nothing = np.full((8, 8, 3), np.nan, np.float32)
    empty = RenderComparison(
        view=0, name="a.jpg", photograph=nothing, render=np.ones((8, 8, 3)),
        relit=np.ones((8, 8, 3)), exact=np.zeros((8, 8), bool), inside=np.zeros((8, 8), bool),
    )  # fmt: skip
    assert empty.mean_difference is None
    write_relit([empty], tmp_path / "relit.png")
    assert (tmp_path / "relit.png").stat().st_size > 0


FILES = [
    "assets", "base_color.exr", "coverage.exr", "entropy.exr", "losses.csv", "metallic.exr",
    "recovered.xml", "recovery.png", "relit.png", "roughness.exr", "run.json", "uncertainty.exr",
]  # fmt: skip


@pytest.mark.slow
def test_without_an_estimate_there_is_no_entropy(vase, fine, tmp_path):
    unknown = ("entropy.exr", "uncertainty.exr")
    write_older(tmp_path, "recover", "run.json", unknown)
    recovery = fake_recovery(fine.texels, fine.truth, steps=0)
    write_recovery(vase.capture, recovery, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [f for f in FILES if f not in unknown]
    assert read_exr(tmp_path / "coverage.exr")["Y"].max() == 3
    assert (tmp_path / "losses.csv").read_text() == "step,loss\n"
    assert json.loads((tmp_path / "run.json").read_text())["result"]["last_loss"] is None
