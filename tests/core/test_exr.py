"""EXR: round trips, files that OpenEXR reads, and failures."""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from svu_mi.core.io import exr
from svu_mi.core.io.exr import read_exr, read_header, write_exr
from svu_mi.core.io.files import prepare_folder, replacing
from svu_mi.errors import CaptureError, OutputError, ShapeError

RGB = np.random.default_rng(717209344).normal(size=(5, 7, 3)).astype(np.float32)


def stored(path: Path) -> dict[str, np.ndarray]:
    """Return the channels of a file as read by OpenEXR, in the stored type."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


LAYOUTS = {
    "slice": lambda: RGB[..., 1],
    "flip": lambda: RGB[::-1, :, 0],
    "mirror": lambda: RGB[:, ::-1, 2],
    "transpose": lambda: RGB[..., 0].T,
    "fortran": lambda: np.asfortranarray(RGB[..., 0]),
    "stride": lambda: RGB[::2, ::3, 0],
    "one channel": lambda: RGB[..., :1],
    "float64": lambda: RGB[..., 0].astype(np.float64),
    "big endian": lambda: RGB[..., 0].astype(">f4"),
    "integers": lambda: (RGB[..., 0] * 100).astype(np.int64),
    "bool": lambda: RGB[..., 0] > 0,
    "tensor": lambda: mi.TensorXf(np.ascontiguousarray(RGB[..., 0])),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_any_memory_layout_is_stored_as_it_reads(tmp_path, layout):
    image = LAYOUTS[layout]()
    write_exr(tmp_path / "a.exr", {"Y": image})
    expected = np.squeeze(np.array(image)).astype(np.float32)
    np.testing.assert_array_equal(stored(tmp_path / "a.exr")["Y"], expected)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["Y"], expected)


def test_grouped_channels_are_stored_one_by_one(tmp_path):
    write_exr(tmp_path / "a.exr", {"RGB": RGB[::-1], "base.RGBA": np.dstack([RGB, RGB[..., :1]])})
    channels = stored(tmp_path / "a.exr")
    assert sorted(channels) == ["B", "G", "R", "base.A", "base.B", "base.G", "base.R"]
    np.testing.assert_array_equal(channels["G"], RGB[::-1, :, 1])
    np.testing.assert_array_equal(channels["base.A"], RGB[..., 0])


def test_half_floats_on_request(tmp_path):
    image = RGB[..., 0]
    write_exr(tmp_path / "a.exr", {"Y": image}, half=True)
    assert stored(tmp_path / "a.exr")["Y"].dtype == np.float16
    assert read_exr(tmp_path / "a.exr")["Y"].dtype == np.float32
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["Y"], image.astype(np.float16))
    with pytest.raises(OutputError, match="too large for float16"):
        write_exr(tmp_path / "a.exr", {"Y": image + 1e5}, half=True)


def test_attributes_come_back(tmp_path):
    given = {"svu:config": '{"a": [1]}', "svu:views": np.int64(24), "svu:sigma": 0.5}
    write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 3))}, given)
    attributes = read_header(tmp_path / "a.exr").attributes
    assert {name: attributes[name] for name in given} == given
    for value, sentence in (([1], "a list"), (2**40, "32 bits"), (None, "NoneType")):
        with pytest.raises(OutputError, match=sentence):
            write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 2))}, {"svu:x": value})


@pytest.mark.parametrize(
    ("channels", "error", "sentence"),
    [
        ({}, ShapeError, "got none"),
        ({"Y": np.zeros(4)}, ShapeError, r"channel Y must be \(H, W\)"),
        ({"RGB": np.zeros((4, 4))}, ShapeError, r"channel RGB must be \(H, W, 3\)"),
        ({"Y": np.zeros((4, 4, 2))}, ShapeError, r"got \(4, 4, 2\)"),
        ({"Y": np.zeros((0, 4))}, ShapeError, "one size"),
        ({"R": np.zeros((2, 2)), "G": np.zeros((2, 3))}, ShapeError, r"R \(2, 2\), G \(2, 3\)"),
        ({"Y": np.full((2, 2), np.nan)}, OutputError, "channel Y has 4 values that are NaN"),
        ({"Y": np.full((2, 2), np.inf)}, OutputError, "infinite"),
        ({"Y": np.full((2, 2), 1e300)}, OutputError, "too large"),
        ({"Y": np.zeros((2, 2), complex)}, OutputError, "complex128"),
        ({"Y": np.full((2, 2), "a")}, OutputError, "expected real numbers"),
    ],
)
def test_what_is_no_image_is_refused_before_a_file_exists(tmp_path, channels, error, sentence):
    with pytest.raises(error, match=sentence):
        write_exr(tmp_path / "a.exr", channels)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    """Files that differ after read-back, or were interrupted, are discarded."""
    path = tmp_path / "a.exr"
    write_exr(path, {"Y": np.ones((2, 2))})
    before = path.read_bytes()
    monkeypatch.setattr(exr, "_read_channels", lambda _: ({"Y": np.zeros((2, 2), "f4")}, {}))
    with pytest.raises(OutputError, match="channel Y differs after read-back"):
        write_exr(path, {"Y": np.full((2, 2), 2.0)})
    with pytest.raises(ZeroDivisionError), replacing(path) as temporary:
        temporary.write_text("half a fi")
        _ = 1 / 0
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_bytes() == before
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder.exr").mkdir()
    for place, sentence in (
        ("missing/a.exr", "missing does not exist"),
        ("file/a.exr", "is not a folder"),
        ("folder.exr", "is a folder"),
        ("x" * 300 + ".exr", "too long"),
    ):
        with pytest.raises(OutputError, match=sentence):
            write_exr(tmp_path / place, {"Y": np.zeros((2, 2))})
    for place, sentence in (("file", "is a file"), ("file/sub", "cannot be created")):
        with pytest.raises(OutputError, match=sentence) as caught:
            prepare_folder(tmp_path / place)
        assert str(tmp_path / place) in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.exr"]
    assert (tmp_path / "file").read_text() == "mine"


def test_reading_says_what_is_wrong_and_nothing_else(tmp_path, capfd):
    """OpenEXR's lines on stdout and stderr are hidden."""
    # Compressible: raw pixels have no checksum, so damage would not be detected.
    write_exr(tmp_path / "good.exr", {"Y": np.outer(np.arange(64), np.arange(48))})
    data = (tmp_path / "good.exr").read_bytes()
    middle = len(data) // 2
    (tmp_path / "folder.exr").mkdir()
    for name, content, sentence in (
        ("missing.exr", None, "No such file or directory; give an EXR file"),
        ("folder.exr", None, "Is a directory; give"),
        ("empty.exr", b"", "empty"),
        ("png.exr", b"\x89PNG\r\n", "not an EXR"),
        ("magic.exr", data[:4], "damaged"),
        ("header.exr", data[:200], "damaged"),
        ("half.exr", data[:middle], "damaged"),
        ("cut.exr", data[:-1], "damaged"),
        ("broken.exr", data[:middle] + bytes(64) + data[middle + 64 :], "damaged"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(CaptureError, match=sentence) as caught:
            read_exr(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_other_programs_files_are_read(tmp_path):
    """Half floats, integers, several parts (the first counts), NaN."""
    y = np.array([[1, np.nan], [3, 4]], np.float16)
    kind = {"type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part(dict(kind), {name: y}, name) for name in "YZ"]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "parts.exr")["Y"], y.astype(np.float32))
    id_map = np.array([[1, 2, 70000]], np.uint32)
    OpenEXR.File(dict(kind), {"id": id_map}).write(str(tmp_path / "id.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "id.exr")["id"], id_map)


def test_what_others_print_meanwhile_is_not_lost(tmp_path, capfd):
    """Output of other threads is kept while photographs, also damaged ones, are read."""
    good, bad = tmp_path / "good.exr", tmp_path / "bad.exr"
    write_exr(good, {"RGB": np.zeros((400, 400, 3))})
    data = good.read_bytes()
    middle = len(data) // 2
    bad.write_bytes(data[:middle] + bytes(64) + data[middle + 64 :])
    stop = threading.Event()
    said = 0

    def talk() -> None:
        nonlocal said
        while not stop.is_set():
            sys.stdout.write(f"out {said}\n")
            sys.stderr.write(f"err {said}\n")
            os.write(2, b"raw %d\n" % said)
            said += 1
            time.sleep(1e-4)

    other = threading.Thread(target=talk)
    other.start()
    for _ in range(10):
        read_exr(good)
        with pytest.raises(CaptureError, match="damaged"):
            read_exr(bad)
    stop.set()
    other.join()
    out, err = capfd.readouterr()
    assert said > 10
    assert out.splitlines() == [f"out {k}" for k in range(said)]
    lines = (f"{who} {k}" for k in range(said) for who in ("err", "raw"))
    assert sorted(err.splitlines()) == sorted(lines)  # lines may be swapped when a reader leaves
