"""What is too large is told in a sentence, before any work."""

from __future__ import annotations

import re
import time

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from support.helpers import fails, sensor_xml, unit_vectors, write_scene

from svu_mi import scenes
from svu_mi.capture.crop import Window
from svu_mi.capture.photographs import open_photographs, read_photographs
from svu_mi.capture.rendering import render_capture
from svu_mi.capture.scene import load_scene
from svu_mi.core import validation
from svu_mi.core.io.exr import read_exr, read_header, write_exr
from svu_mi.errors import CaptureError, OptionError, SceneError
from svu_mi.light.environment import read_environment
from svu_mi.light.latlong import grid_size, radiance_from

SECONDS = 8  # a refusal, on a busy machine
VASE = scenes.path("vase")
ABSURD = [
    (("render", VASE, "--views", 10**9), r"--views: at most 10000 are supported, got 10+; use"),
    (("render", VASE, "--views", 1, "--resolution", 10**6), "film must be 1 to 65536 per side"),
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
    begin = time.perf_counter()
    line = fails(capsys, *words, *where)
    assert re.search(says, line), line
    assert time.perf_counter() - begin < SECONDS
    assert not (tmp_path / "out" / "view_0000.exr").exists()


def test_texels_are_compared_with_the_memory(monkeypatch, shot, tmp_path, capsys):
    free(monkeypatch, 4 * 10**9)
    line = fails(capsys, "entropy", shot, "--resolution", 8192, "-o", tmp_path / "out")
    assert "8192 x 8192 texels take at least 17.2 GB of memory, but only 4 GB are free; use" in line


def test_a_scene_with_80000_sensors_is_refused_unread(tmp_path, capsys):
    path = write_scene(tmp_path, sensors=sensor_xml(1) * 80_000)
    begin = time.perf_counter()
    line = fails(capsys, "entropy", path, "-o", tmp_path / "out")
    assert "sensors: at most 10000 are supported, got 80000" in line
    assert time.perf_counter() - begin < SECONDS


def test_sensors_are_counted_wherever_they_are_and_nowhere_else(tmp_path):
    comment = f"<!-- {'<sensor' * 20_000} -->"
    assert load_scene(write_scene(tmp_path, extra=comment)).sensors()
    more = f'<scene version="3.0.0">{sensor_xml(1) * 20_000}</scene>'
    (tmp_path / "more.xml").write_text(more, encoding="utf-16")
    path = write_scene(tmp_path, extra='<include filename="more.xml"/>')
    with pytest.raises(SceneError, match="sensors: at most 10000 are supported, got 20003"):
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
    begin = time.perf_counter()
    light = read_environment(emitter)
    mean = light.coefficients(16)[0] / np.sqrt(4 * np.pi)
    assert time.perf_counter() - begin < SECONDS
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
