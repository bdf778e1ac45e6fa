"""What is too large is told in a sentence, before any work."""

from __future__ import annotations

import io
import os
import re
import struct
import time

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from support.helpers import fails, sensor_xml, unit_vectors, write_scene

from svu_mi import scenes
from svu_mi.capture.crop import Window
from svu_mi.capture.importers.registry import read_source
from svu_mi.capture.photographs import open_photographs, read_photographs
from svu_mi.capture.rendering import render_capture
from svu_mi.capture.scene import load_scene
from svu_mi.cli.batch.capture_list import read_list
from svu_mi.cli.main import main
from svu_mi.core import validation
from svu_mi.core.io.exr import read_exr, read_header, write_exr
from svu_mi.core.io.files import replacing, write_text
from svu_mi.errors import CaptureError, OptionError, SceneError
from svu_mi.light.environment import read_environment
from svu_mi.light.latlong import grid_size, radiance_from
from svu_mi.output.relight_page import view_file_names

SECONDS = 8  # of the processor; a refusal takes far less
VASE = scenes.path("vase")
ABSURD = [
    (("render", VASE, "--views", 10**9), r"--views: at most 10000 are supported, got 10+; use"),
    (
        ("render", VASE, "--views", 1, "--resolution", 10**6),
        r"film must be 2 whole numbers in \[1, 65536\]",
    ),
    (("render", VASE, "--spp", 10**9), "spp must be at most 65535|spp must be at most 16383"),
    (("render", VASE, "--spp", 10**12), r"--spp must be at least 1 and below 2\^32, got 10+\."),
    (("guide", "SHOT", "--candidates", 10**9), "--candidates: at most 10000 are supported"),
    (("guide", "SHOT", "--hypotheses", 10**9), r"hypotheses must be in \[1, 4096\]"),
    *(
        ((command, "SHOT", "--resolution", *size), words)
        for command in ("entropy", "recover", "report", "guide")
        for size, words in (
            ([10**6], "must be 2 to 16384 texels per side, got 1000000 x 1000000"),
            ([1, 300], "must be 2 to 16384 texels per side, got 1 x 300"),
        )
    ),
    (("view", "SHOT", "--resolution", 1, 300), "must be 2 to 16384 texels per side"),
]


def free(monkeypatch, size: int) -> None:
    monkeypatch.setattr(validation, "free_memory", lambda: size)


@pytest.mark.parametrize("words, says", ABSURD)
def test_absurd_options_are_refused_at_once(words, says, shot, tmp_path, capsys):
    words = [shot if word == "SHOT" else word for word in words]
    where = () if words[0] == "view" else ("-o", tmp_path / "out")
    begin = time.process_time()
    line = fails(capsys, *words, *where)
    assert re.search(says, line), line
    assert time.process_time() - begin < SECONDS
    assert not (tmp_path / "out" / "view_0000.exr").exists()


def test_texels_are_compared_with_the_memory(monkeypatch, shot, tmp_path, capsys):
    free(monkeypatch, 4 * 10**9)
    line = fails(capsys, "entropy", shot, "--resolution", 8192, "-o", tmp_path / "out")
    assert "8192 x 8192 texels take at least 17.2 GB of memory, but only 4 GB are free; use" in line


def test_a_scene_with_80000_sensors_is_refused_unread(tmp_path, capsys):
    path = write_scene(tmp_path, sensors=sensor_xml(1) * 80_000)
    begin = time.process_time()
    line = fails(capsys, "entropy", path, "-o", tmp_path / "out")
    assert "sensors: at most 10000 are supported, got 80000" in line
    assert time.process_time() - begin < SECONDS


def test_sensors_are_counted_wherever_they_are_and_nowhere_else(tmp_path):
    comment = f"<!-- {'<sensor' * 20_000} -->"
    assert load_scene(write_scene(tmp_path, extra=comment)).sensors()
    more = f'<scene version="3.0.0">{sensor_xml(1) * 20_000}</scene>'
    (tmp_path / "more.xml").write_text(more, encoding="utf-16")
    path = write_scene(tmp_path, extra='<include filename="more.xml"/>')
    with pytest.raises(SceneError, match="sensors: at most 10000 are supported, got 20003"):
        load_scene(path)


def test_a_scene_of_more_than_64_mib_is_refused_unread(tmp_path):
    path = tmp_path / "scene.xml"
    path.touch()
    os.truncate(path, 2**26 + 1)
    with pytest.raises(SceneError, match="has more than 64 MiB .*; split it by <include>"):
        load_scene(path)


def huge(tmp_path, side: int, count: int = 3):
    return write_scene(tmp_path, sensors=sensor_xml(count, side, side))


def test_films_above_kernel_limits_are_not_rendered(tmp_path):
    with pytest.raises(SceneError, match="a film of 60000 x 60000 pixels is too large to render"):
        render_capture(huge(tmp_path, 60_000), 1)


def test_forty_films_of_20000_pixels_are_not_rendered(monkeypatch, tmp_path):
    free(monkeypatch, 24 * 10**9)
    with pytest.raises(
        CaptureError,
        match=r"40 photographs of up to 20000 x 20000 pixels take at "
        r"least 296 GB of memory, but only 24 GB are free; m",
    ):
        render_capture(huge(tmp_path, 20_000, 40), 1)


def test_the_most_samples_are_named(tmp_path):
    with pytest.raises(OptionError, match="spp must be at most 42949 for a film of 1000 x 100 pix"):
        validation.require_render([(1000, 100)], 42_950, "scene")
    validation.require_render([(1000, 100)], 42_949, "scene")


def test_photographs_that_do_not_fit_into_memory_are_not_read(monkeypatch, tmp_path):
    write_exr(tmp_path / "view_0000.exr", {"RGB": np.ones((20, 30, 3))})
    free(monkeypatch, 20_000)
    with pytest.raises(CaptureError, match="3 photographs of up to 30 x 20 pixels take at least"):
        pictures = open_photographs([tmp_path / "view_0000.exr"] * 3, [(30, 20)] * 3)
        read_photographs(pictures, [Window(0, 0, 30, 20)] * 3, [1.0] * 3)


def test_wrong_film_is_refused_before_allocation(tmp_path):
    write_exr(tmp_path / "view_0000.exr", {"RGB": np.ones((20, 30, 3))})
    with pytest.raises(CaptureError, match="has 30 x 20 pixels but its sensor's film has 60000 x"):
        open_photographs([tmp_path / "view_0000.exr"], [(60_000, 60_000)])


def map_of(width: int, height: int):
    pixels = np.random.default_rng(5).random((height, width, 3)).astype(np.float32) + 0.1
    return mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(pixels)})


@pytest.mark.parametrize("size", [(1, 1), (4096, 1), (1, 4096), (1, 300)])
def test_maps_of_odd_sizes_are_quick(size):
    """4096 x 1 was sampled 65 times finer on both sides: 35 million nodes."""
    emitter = map_of(*size)
    columns, rows = grid_size(emitter)
    assert columns * rows < 2**22
    begin = time.process_time()
    light = read_environment(emitter)
    mean = light.coefficients(16)[0] / np.sqrt(4 * np.pi)
    assert time.process_time() - begin < SECONDS
    directions = unit_vectors(np.random.default_rng(1), 400_000)
    np.testing.assert_allclose(mean, radiance_from(emitter, directions).mean(axis=0), rtol=0.01)


def test_a_map_that_does_not_fit_into_memory_is_refused(monkeypatch):
    emitter = map_of(64, 32)
    free(monkeypatch, 300_000)
    with pytest.raises(SceneError, match="64 x 32 pixels take at least 0.000369 GB of memory, but"):
        read_environment(emitter)


def part(name: str | None, channels, **header):
    kind = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIPS_COMPRESSION, **header}
    return OpenEXR.Part(kind, channels, name) if name else OpenEXR.File(kind, channels)


def colors(side: int = 6) -> dict[str, np.ndarray]:
    return {name: np.full((side, side), k, np.float32) for k, name in enumerate("RGB")}


def deep(side: int = 6) -> dict[str, np.ndarray]:
    pixels = np.empty((side, side), object)
    for index in np.ndindex(side, side):
        pixels[index] = np.ones(2, np.float32)
    return dict.fromkeys("RGB", pixels)


def test_a_deep_file_is_refused_by_its_header(tmp_path, capfd):
    path = str(tmp_path / "deep.exr")
    with part(None, deep(), type=OpenEXR.deepscanline) as file:
        file.write(path)
    capfd.readouterr()
    for read in (read_exr, read_header):
        with pytest.raises(CaptureError, match="a deep EXR file; export it as a flat image"):
            read(path)
    assert capfd.readouterr() == ("", "")


def test_thousands_of_channels_are_refused(tmp_path):
    many = {f"c{k}": np.zeros((2, 2), np.float32) for k in range(3000)}
    with part(None, many | colors(2)) as file:
        file.write(str(tmp_path / "many.exr"))
    with pytest.raises(CaptureError, match="has 3003 channels, more than 1024; export only"):
        read_exr(tmp_path / "many.exr")


def test_tiles_and_parts_are_read(tmp_path):
    with part(None, colors(), type=OpenEXR.tiledimage, tiles=OpenEXR.TileDescription()) as file:
        file.write(str(tmp_path / "tiled.exr"))
    depth = {"Z": np.zeros((6, 6), np.float32)}
    with OpenEXR.File([part("beauty", colors()), part("depth", depth)]) as file:
        file.write(str(tmp_path / "parts.exr"))
    for name in ("tiled.exr", "parts.exr"):
        channels = read_exr(tmp_path / name)
        assert {key: float(channels[key].mean()) for key in "RGB"} == {"R": 0, "G": 1, "B": 2}


def test_all_parts_are_compared_with_the_memory(tmp_path, monkeypatch):
    """The binding reads every part, whichever is asked for."""
    large = {"Z": np.zeros((200, 200), np.float32)}
    window = (np.zeros(2, np.int32), np.full(2, 199, np.int32))
    parts = [part(*words, displayWindow=window) for words in (("a", colors()), ("b", large))]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "parts.exr"))
    free(monkeypatch, 300_000)
    with pytest.raises(CaptureError, match="values take at least .* export only its colours"):
        read_exr(tmp_path / "parts.exr")


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


MANY = 10_001  # poses; 10 000 are supported
CAMERA = struct.pack("<IiQQ4d", 1, 1, 16, 8, 20, 20, 8, 4)
IMAGE = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 3, 1) + b"a.png\0" + struct.pack("<Q", 0)
POSES = {
    "colmap images": lambda: {
        "cameras.bin": struct.pack("<Q", 1) + CAMERA,
        "images.bin": struct.pack("<Q", MANY) + IMAGE * MANY,
    },
    "colmap cameras": lambda: {
        "cameras.bin": struct.pack("<Q", MANY) + CAMERA * MANY, "images.bin": b"",
    },
    "colmap text images": lambda: {
        "cameras.txt": b"1 PINHOLE 16 8 20 20 8 4\n",
        "images.txt": b"1 1 0 0 0 0 0 3 1 a.png\n\n" * MANY,
    },
    "colmap text cameras": lambda: {
        "cameras.txt": b"".join(b"%d PINHOLE 16 8 20 20 8 4\n" % k for k in range(MANY)),
        "images.txt": b"",
    },
    "llff": lambda: {"poses_bounds.npy": npy(np.zeros((MANY, 17)))},
    "idr": lambda: {"cameras.npz": npz({f"world_mat_{k}": np.zeros(1) for k in range(2 * MANY)})},
    "owl": lambda: {"exposure.txt": b"0", **{f"camera_{k:05d}.txt": b"" for k in range(MANY)}},
    "transforms": lambda: {"transforms.json": b'{"frames": [%s{}]}' % (b"{}," * (MANY - 1))},
}  # fmt: skip


@pytest.mark.parametrize("kind", POSES)
def test_too_many_poses_are_refused_before_the_first_is_used(tmp_path, kind):
    for name, data in POSES[kind]().items():
        (tmp_path / name).write_bytes(data)
    start = time.process_time()
    with pytest.raises(
        CaptureError, match=r"(at most [12]0000|1 to 10000) .* got .*(10001|20002)\b.*; "
    ):
        read_source(tmp_path)
    assert time.process_time() - start < 2


LONG = "\u82b1" * 80  # 240 bytes; file systems take 255


def test_names_are_measured_in_bytes(tmp_path, capsys):
    """80 letters, with what is added to them, were too long when all work was done."""
    write_text(tmp_path / f"{LONG}.html", "page")
    with replacing(tmp_path / f"a.{LONG}") as temporary:
        temporary.write_text("")
    assert view_file_names([LONG, "b"]) == [LONG, "b"]
    write_exr(tmp_path / f"{LONG}.exr", {"Y": np.zeros((2, 2), np.float32)})
    assert view_file_names([LONG + "\u82b1", "b"]) == ["view_0000", "view_0001"]
    write_scene(tmp_path, sensors=sensor_xml(1))
    for end, length in ((LONG[:79] + ".html", 242), (LONG + "\u82b1", 243)):
        assert len(end.encode()) == length
        command = ["report"] if length == 242 else ["entropy"]
        assert main([*command, str(tmp_path / "scene.xml"), "-o", str(tmp_path / end)]) == 2
        said = capsys.readouterr().err
        assert said.endswith(": the name has over 240 bytes; choose a shorter one.\n")
    (tmp_path / "captures" / (LONG + "\u82b1")).mkdir(parents=True)
    (tmp_path / "captures" / (LONG + "\u82b1") / "capture.json").write_text("{}")
    with pytest.raises(OptionError, match=r"capture name .* is too long; rename the capture"):
        read_list(tmp_path / "captures")
