"""Objects with Lighting: cameras, tone curve and maps, compared with its README."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.helpers import foreign_source, projected, write_ball
from support.owl import write_owl

from svu_mi.capture.image_io import read_planes
from svu_mi.capture.importers.envmap import write_environment
from svu_mi.capture.importers.objects_with_lighting import find_inputs, read
from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import OPENCV, Light
from svu_mi.core.io.exr import write_exr
from svu_mi.errors import CaptureError

STOPS = -0.75
POINTS = np.random.default_rng(8086).uniform(-0.4, 0.4, (6, 3))
TURN = np.linalg.qr(np.random.default_rng(118).normal(size=(3, 3)))[0]
TURN[:, 0] *= np.linalg.det(TURN)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A source with mesh, light, and a photograph with half the exposure."""
    folder = tmp_path_factory.mktemp("source")
    made = foreign_source(folder)
    pixels = np.random.default_rng(52).uniform(0, 3, (8, 16, 3)).astype(np.float32)
    write_exr(folder / "sky.exr", {"RGB": pixels})
    return replace(
        made,
        frames=[replace(made.frames[0], exposure=0.5), *made.frames[1:]],
        mesh=write_ball(folder),
        light=Light(path=folder / "sky.exr", to_world=TURN, scale=2.0),
    )


@pytest.fixture(scope="module")
def written(source, tmp_path_factory):
    root = tmp_path_factory.mktemp("owl") / "ball"
    write_owl(root, source, exposure=STOPS)
    return root


def test_what_is_written_is_read(source, written):
    again = read(written, ReadOptions())
    assert again.format == "owl" and (again.camera_axes == OPENCV).all()
    assert again.root == written / "test" and "is for debugging" in again.notes[0]
    for got, wanted in zip(again.frames, source.frames, strict=True):
        np.testing.assert_allclose(got.to_world, wanted.to_world, atol=1e-12)
        assert (got.focal, got.center, got.size) == (wanted.focal, wanted.center, wanted.size)
        assert got.exposure == 2**STOPS and got.transfer == "gamma 2.2"
        assert (got.mask is None) == (wanted.mask is None)
        if got.mask is not None:
            np.testing.assert_array_equal(Image.open(got.mask), Image.open(wanted.mask))
    assert again.mesh.read_bytes() == source.mesh.read_bytes()
    box = np.loadtxt(written / "test/inputs/object_bounding_box.txt")
    np.testing.assert_allclose(box, [-1, 1] * 3, atol=1e-6)
    np.testing.assert_allclose(again.light.to_world, TURN, atol=1e-12)
    pixels, given = (np.stack(read_planes(light.path)[0]) for light in (again.light, source.light))
    largest = given.max(axis=0)  # RGBE has one exponent for three channels, and 8 bits
    assert (np.abs(pixels - 2 * given) <= 2 * largest / 128).all()


def test_cameras_are_those_of_the_readme(written):
    """``x = K (R X + t)``, as in the code of the data set."""
    for index, frame in enumerate(read(written, ReadOptions()).frames):
        rows = np.loadtxt(written / f"test/inputs/camera_{index:04d}.txt")
        K, R, t = rows[:3], rows[3:6], rows[6]
        x = (POINTS @ R.T + t) @ K.T
        np.testing.assert_allclose(projected(frame, POINTS), x[:, :2] / x[:, 2:], atol=1e-3)
        assert tuple(rows[7]) == (*frame.size, 3)


# (u, v) of directions, from the README.
TABLE = {
    (0, 0, 1): (0.5, 0), (0, 0, -1): (0.5, 1), (1, 0, 0): (0.5, 0.5), (0, 1, 0): (0.25, 0.5),
    (0, -1, 0): (0.75, 0.5), (-1, 0, 0): (0, 0.5),
}  # fmt: skip


@pytest.mark.parametrize("turned_by_data_set", [True, False])
def test_directions_of_the_map_are_those_of_the_readme(written, tmp_path, turned_by_data_set):
    """Mitsuba's emitter returns the coordinates that the map contains."""
    height, width = 64, 128
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([(u + 0.5) / width, v / (height - 1), 0 * u], axis=-1).astype(np.float32)
    test = tmp_path / "test"
    (test / "inputs").mkdir(parents=True)
    for file in (written / "test/inputs").iterdir():
        (test / "inputs" / file.name).write_bytes(file.read_bytes())
    name = "env_512_rotated.hdr" if turned_by_data_set else "env.hdr"
    mi.Bitmap(pixels).write(str(test / name))
    world_to_env = np.eye(4)
    world_to_env[:3, :3] = TURN
    np.savetxt(test / "world_to_env.txt", world_to_env)
    pose, _ = write_environment(read(tmp_path, ReadOptions()).light, tmp_path / "map.exr")
    emitter = mi.load_dict({"type": "envmap", "filename": str(tmp_path / "map.exr"),
                            "to_world": mi.ScalarTransform4f(pose)})  # fmt: skip
    for direction, wanted in TABLE.items():
        in_world = np.array(direction, float) @ (np.eye(3) if turned_by_data_set else TURN)
        interaction = mi.SurfaceInteraction3f()
        interaction.wi = mi.Vector3f(-in_world)
        radiance = np.array(emitter.eval(interaction)).ravel()
        if direction[0] == -1:  # the seam
            radiance[0] = 0
        if direction[2] != 0:  # the poles
            radiance[0] = 0.5
        np.testing.assert_allclose(radiance[:2], wanted, atol=0.02)


def test_an_object_is_found_from_any_of_its_folders(written):
    inputs = written / "test" / "inputs"
    for path in (written, written / "test", inputs):
        assert find_inputs(path) == inputs
        assert read(path, ReadOptions()).light is not None
    assert find_inputs(written.parent) is None


GOOD = "9 0 4\n0 9 3\n0 0 1\n1 0 0\n0 1 0\n0 0 1\n0 0 4\n8 6 3\n"
CAMERA, EXPOSURE = "inputs/camera_0000.txt", "inputs/exposure.txt"
BROKEN = {
    "an exposure in words": ({EXPOSURE: "bright"}, "exposure.txt: could not convert .*bright"),
    "two exposures": ({EXPOSURE: "1 2"}, "exposure.txt: content must be 1 num"),
    "an endless exposure": ({EXPOSURE: "1e9"}, r"in \[-64, 64\], got 1000000000.0; copy"),
    "an exposure of 65 stops": ({EXPOSURE: "-65"}, r"in \[-64, 64\], got -65"),
    "half a camera": ({CAMERA: GOOD[:30]}, "camera_0000.txt: content must be 24"),
    "a long camera": ({CAMERA: GOOD + "1"}, "24 numbers in .* a list of 25"),
    "words in a camera": ({CAMERA: GOOD.replace("9", "nine")}, "could not convert"),
    "nan in a camera": ({CAMERA: GOOD.replace("0 0 4", "0 0 nan")}, "must be 24 numbers .*nan"),
    "bytes": ({CAMERA: "\udcff\udcfe"}, "not a file of numbers"),
    "skew": ({CAMERA: GOOD.replace("9 0 4", "9 1 4")}, "skew"),
    "a K of another kind": ({CAMERA: GOOD.replace("0 0 1\n1", "0 0 2\n1")}, "its K must"),
    "a mirror": ({CAMERA: GOOD.replace("0 1 0", "0 -1 0")}, "mirrored"),
    "no rotation": ({CAMERA: GOOD.replace("0 1 0", "0 0 0")}, "R is not a rotation"),
    "a broken size": (
        {CAMERA: GOOD.replace("8 6", "8.5 6")},
        "2 whole numbers .* pixels, got 8.5",
    ),
    "a huge size": ({CAMERA: GOOD.replace("8 6", "1e300 6")}, "24 numbers .* 1e.300"),
    "a large size": (
        {CAMERA: GOOD.replace("8 6", "1e9 6")},
        r"size must be 2 whole numbers in \[1, 65536\]",
    ),
    "no photograph": ({"inputs/image_0000.png": None}, "image_0000.png: no such photograph"),
    "no camera": ({CAMERA: None}, "no camera_0000.txt"),
    "no exposure": ({EXPOSURE: None}, "expected test/inputs/exposure.txt"),
    "a map without its frame": (
        {"env.hdr": ""},
        "env.txt: not a file of numbers that",
    ),
    "a mirrored map": (
        {"env.hdr": "", "world_to_env.txt": "0 1 0 0 1 0 0 0 0 0 1 0 0 0 0 1"},
        "not a rotation",
    ),
    "a map without rotation": ({"env.hdr": "", "world_to_env.txt": "1 " * 16}, "not a rotation"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_object_is_named(tmp_path, case):
    changes, sentence = BROKEN[case]
    files = {CAMERA: GOOD, EXPOSURE: "0.5", "inputs/image_0000.png": "", **changes}
    test: Path = tmp_path / "test"
    (test / "inputs").mkdir(parents=True)
    for name, text in files.items():
        if text is not None:
            (test / name).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(CaptureError, match=sentence) as error:
        read(tmp_path, ReadOptions())
    assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)
