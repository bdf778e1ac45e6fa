"""Round trips: captures are written in the formats of other tools and imported again."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy.interpolate import interp1d
from support.written import WRITERS, as_orb, write_glb

import svu_mi as svu
from svu_mi import scenes
from svu_mi.capture import scene_xml
from svu_mi.capture.capture import Flash
from svu_mi.capture.importers.import_capture import ImportOptions, import_capture
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.registry import read_source
from svu_mi.capture.importers.source import ENVIRONMENT_AXES, Light, Source, frame_of
from svu_mi.capture.mesh import arrays, write_ply
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import affine, describe, make_sensor
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import OptionError

POSE = 1e-5  # tolerance; a matrix is rounded to single precision once
SAME = 0.999  # smallest Pearson correlation of entropy
RESOLUTION = 48
SIZE, SHIFT = (72, 52), (0.06, -0.04)  # size of the photographs, and their principal point
VIEWS = 8
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a world whose +Z is the scene's +Y
LIGHT = Z_UP.T @ ENVIRONMENT_AXES["blender"]  # rotation of the map in that world


@dataclass(frozen=True)
class Original:
    """A capture, its expected values, and its files."""

    capture: svu.Capture
    entropy: np.ndarray
    source: Source


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Original:
    """Eight wide photographs of the knot, with the principal point off the centre."""
    return photographed(tmp_path_factory.mktemp("original"), SHIFT)


@pytest.fixture(scope="module")
def centered(tmp_path_factory) -> Original:
    """The capture with a centred principal point, for formats without one."""
    return photographed(tmp_path_factory.mktemp("centered"), (0.0, 0.0))


def photographed(folder: Path, shift: tuple[float, float]) -> Original:
    shutil.copytree(scenes.path("knot").parent, folder / "knot")
    shutil.copytree(scenes.path("knot").parent.parent / "lights", folder / "lights")
    window = read_exr(folder / "lights" / "window.exr")
    # Twice as wide as high, as photographed. With one row more, it would count as a map for
    # Mitsuba.
    write_exr(folder / "probe.exr", {name: plane[:-1] for name, plane in window.items()})
    write_exr(folder / "lights" / "window.exr", {"RGB": for_mitsuba(folder / "probe.exr")})
    scene = mi.load_file(str(folder / "knot" / "knot.xml"), optimize=False)
    changes = {"film": SIZE, "crop_size": SIZE, "principal_point_offset": shift}
    light = scene_xml.plugin("emitter", "envmap", id="light")
    scene_xml.put(light, filename="../lights/window.exr", to_world=affine(LIGHT))
    root = scene_xml.scene()
    root.append(light)
    scene_xml.write_document(root, folder / "lights" / "window.xml")
    root = scene_xml.scene()
    for k, sensor in enumerate(scene.sensors()[::3][:VIEWS]):
        changed = make_sensor({**describe(sensor), **changes}, "changed")
        root.append(scene_xml.sensor(changed, f"view_{k:04d}"))
    scene_xml.write_document(root, folder / "knot" / "sensors.xml")
    capture = svu.render_capture(folder / "knot" / "knot.xml", spp=16, folder=folder / "capture")
    frames = [
        frame_of(sensor, folder / "capture" / name)
        for sensor, name in zip(capture.sensors, capture.names, strict=True)
    ]
    source = Source(
        format="svu", root=folder / "capture", frames=frames, mesh=folder / "knot" / "mesh.ply",
        light=Light(path=folder / "probe.exr", to_world=LIGHT),
    )  # fmt: skip
    return Original(capture, entropy_of(capture), source)


def for_mitsuba(path: Path) -> np.ndarray:
    """Resample a map to Mitsuba's rows, from pole to pole."""
    pixels = np.stack([read_exr(path)[name] for name in "RGB"], axis=-1).astype(np.float64)
    height = len(pixels)
    poles = [np.broadcast_to(row.mean(axis=0), row.shape) for row in (pixels[0], pixels[-1])]
    rows = np.stack([poles[0], *pixels, poles[1]])
    return interp1d([0, *(np.arange(height) + 0.5), height], rows, axis=0)(
        np.linspace(0, height, 2 * height + 1)
    )


def entropy_of(capture: svu.Capture) -> np.ndarray:
    estimate = svu.estimate(capture, svu.texels(capture.mesh, resolution=RESOLUTION))
    return np.array(estimate.entropy)


def in_z_up_world(source: Source, folder: Path) -> Source:
    """The capture in a world with +Z up, with Blender's environment map and a GLB."""
    frames = [replace(frame, to_world=affine(Z_UP) @ frame.to_world) for frame in source.frames]
    given = read_textured_mesh(source.mesh).mesh
    # glTF always has +Y up, so the options contain both axes.
    write_glb(folder / "mesh.glb", given, np.full((4, 4, 3), 128, np.uint8))
    light = replace(source.light, to_world=ENVIRONMENT_AXES["blender"])
    return replace(source, frames=frames, mesh=folder / "mesh.glb", light=light)


def with_long_pixels(source: Source, folder: Path) -> Source:
    """The photographs with each row written twice, so that pixels are not square."""
    frames = []
    for frame in source.frames:
        image = folder / f"long_{frame.image.name}"
        channels = read_exr(frame.image)
        write_exr(image, {name: np.repeat(plane, 2, axis=0) for name, plane in channels.items()})
        frames.append(replace(
            frame, image=image, focal=(frame.focal[0], 2 * frame.focal[1]),
            center=(frame.center[0], 2 * frame.center[1]), size=(SIZE[0], 2 * SIZE[1]),
        ))  # fmt: skip
    return replace(source, frames=frames)


OWN_FILES = ("owl", "stanford-orb")  # formats that contain mesh and light
VARIANTS = {
    "as it is": (lambda source, _: source, {}),
    "z up": (in_z_up_world, {"mesh_up": "y", "world_up": "z"}),
    "long pixels": (with_long_pixels, {}),
}


# Every format (Stanford-ORB below), and every variant in one of them.
CASES = [("transforms", "as it is"), ("colmap", "as it is"), ("owl", "as it is"),
         ("transforms", "z up"), ("colmap", "long pixels")]  # fmt: skip


@pytest.mark.few(3)
@pytest.mark.parametrize("form, variant", CASES)
def test_a_capture_comes_back(original, tmp_path, form, variant):
    change, options = VARIANTS[variant]
    for name in ("changed", "written"):
        (tmp_path / name).mkdir()
    source = change(original.source, tmp_path / "changed")
    path = WRITERS[form](tmp_path / "written", source)
    if form not in OWN_FILES:
        options = {**options, "mesh": source.mesh, "environment": source.light}
    check(original, source, imported(path, tmp_path / "capture", options), SHIFT)


@pytest.mark.slow
def test_a_capture_comes_back_from_stanford_orb(centered, tmp_path):
    path = as_orb(tmp_path, centered.source)
    check(centered, centered.source, imported(path, tmp_path / "capture", {}), (0, 0))


def imported(path: Path, folder: Path, options: dict[str, object]) -> svu.Capture:
    import_capture(read_source(path), folder, ImportOptions(**options))
    return svu.load_capture(folder)


@pytest.mark.filterwarnings("ignore:Light reflected by")
def test_a_table_stands_under_the_object(original, tmp_path):
    """Below its lowest point along the cameras' up direction, here +Z; facing the object."""
    source = in_z_up_world(original.source, tmp_path)
    path = WRITERS["transforms"](tmp_path, source)
    options = {"mesh": source.mesh, "mesh_up": "y", "world_up": "z", "every": 4}
    below = {"table": -0.1, "table_albedo": 0.25, "environment": source.light}
    capture = imported(path, tmp_path / "capture", {**options, **below})
    assert capture.flash is None
    (table,) = [shape for shape in capture.scene.shapes() if shape.id() == "table"]
    positions = arrays(capture.shape).positions
    pose = np.array(mi.traverse(table)["to_world"].matrix).reshape(4, 4)
    normal = pose[:3, 2] / np.linalg.norm(pose[:3, 2])
    np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-6)
    assert pose[2, 3] == pytest.approx(positions[:, 2].min() - 0.1, abs=1e-5)
    wide = 2 * np.linalg.norm(np.ptp(positions, axis=0))
    np.testing.assert_allclose(np.linalg.norm(pose[:3, :2], axis=0), wide, rtol=1e-5)
    reflectance = np.array(mi.traverse(table.bsdf())["reflectance.value"]).ravel()
    np.testing.assert_allclose(reflectance, 0.25)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::svu_mi.errors.SvuWarning")
def test_overlapping_uvs_are_named_at_import_and_by_the_check(original, tmp_path):
    """Both halves of the texture share one half, as of mirrored models."""
    flat = read_textured_mesh(original.source.mesh).mesh
    halves = flat.uvs * [-1, 1] + [1, 0]
    folded = replace(flat, uvs=np.where(flat.uvs[:, :1] > 0.5, halves, flat.uvs))
    write_ply(tmp_path / "folded.ply", "folded", folded)
    options = {"mesh": tmp_path / "folded.ply", "every": 4}
    notes = import_capture(original.source, tmp_path / "capture", ImportOptions(**options))
    (said,) = [note for note in notes if "overlapping UV charts" in note]
    assert said.startswith(str(tmp_path / "folded.ply")) and "--geometry-only" in said
    found = svu.check(svu.load_capture(tmp_path / "capture")).findings
    (uvs,) = [one for one in found if one.question == "uvs"]
    assert uvs.verdict == "wrong" and "--unwrap" in uvs.sentence
    again = ImportOptions(**options, geometry_only=True)
    notes = import_capture(original.source, tmp_path / "capture", again)
    assert not any("overlapping UV charts" in note for note in notes)


def test_a_flash_is_the_light(original, tmp_path):
    path = WRITERS["transforms"](tmp_path, original.source)
    lamp = {"flash": (-0.1, 0.2, 0.0), "flash_intensity": (4.0, 5.0, 6.0)}
    options = {"mesh": original.source.mesh, "every": 4, **lamp}
    assert imported(path, tmp_path / "capture", options).flash == Flash(*lamp.values())


@pytest.mark.parametrize(("option", "ends", "beyond"), [
    ("flash", ((0, 0, 0),), ((0, np.nan, 0),)),
    ("flash_intensity", ((1e-9, 1, 1),), ((0, 1, 1), (1, 1, np.inf))),
    ("table_albedo", (0, 1), (-0.01, 1.01, np.nan)), ("table", (-1e30, 1e30), (np.inf, np.nan)),
    ("every", (1,), (0,)), ("faces", (100,), (99,)), ("mesh_scale", (1e-300,), (0, np.inf, np.nan)),
])  # fmt: skip
def test_ends_of_ranges_are_included(option, ends, beyond):
    for value in ends:
        assert getattr(ImportOptions(**{option: value}), option) == value
    for value in beyond:
        with pytest.raises(OptionError, match=f"^--{option.replace('_', '-')} must be"):
            ImportOptions(**{option: value})


def check(
    original: Original, source: Source, capture: svu.Capture, shift: tuple[float, float]
) -> None:
    """Compare poses, intrinsics and entropy."""
    for sensor, frame in zip(capture.sensors, source.frames, strict=True):
        np.testing.assert_allclose(to_world(sensor), frame.to_world, atol=POSE)
        record = describe(sensor)
        assert tuple(record["film"]) == SIZE
        np.testing.assert_allclose(record["principal_point_offset"], shift, atol=POSE)
        assert record["x_fov"] == pytest.approx(describe(original.capture.sensors[0])["x_fov"])
    assert np.corrcoef(entropy_of(capture), original.entropy)[0, 1] > SAME
