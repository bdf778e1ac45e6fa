"""Large photographs: cropped to the object, made smaller, kept in a file."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.helpers import fails, python, run

import svu_mi as svu
from svu_mi import scenes
from svu_mi.capture import capture_folder, crop, pixel_buffer
from svu_mi.capture.crop import Detail, Window
from svu_mi.capture.image_io import decoded, quantized, srgb
from svu_mi.capture.importers import convert_photographs
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.sensors import film_size, make_sensor
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import CaptureError
from svu_mi.geometry.packed_views import pack_views

pytestmark = pytest.mark.filterwarnings("ignore:.*8-bit:svu_mi.errors.SvuWarning")


@pytest.fixture
def large(monkeypatch):
    """Treat photographs of any size as large."""
    monkeypatch.setattr(crop, "LARGE", 1)


@pytest.fixture(scope="module")
def integers(shot, tmp_path_factory):
    """The vase in PNG of 8 bits with masks, highlights clipped."""
    folder = tmp_path_factory.mktemp("integers")
    shutil.copy(shot / "capture.json", folder)
    for path in sorted(shot.glob("view_*.exr")):
        pixels = read_exr(path)
        color = np.nan_to_num(np.stack([pixels[c] for c in "RGB"], axis=-1))
        Image.fromarray(quantized(srgb(np.clip(color, 0, 1)))).save(folder / f"{path.stem}.png")
        Image.fromarray(quantized(pixels["A"])).save(folder / f"mask_{path.stem[5:]}.png")
    return folder


def test_a_window_sees_what_the_whole_photograph_does_there():
    sensor = make_sensor(
        {"to_world": np.array(mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0.1, 0], [0, 1, 0])
                              .matrix, np.float64),
         "x_fov": 40.0, "principal_point_offset": [0.03, -0.02], "clip": [0.1, 100],
         "film": [120, 90], "crop_offset": [10, 5], "crop_size": [101, 77]}, "a")  # fmt: skip
    part = Window(left=13, top=22, width=25, height=9, shrink=3)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3))
    pixels = [_pixels(each, points) for each in (sensor, part.seen_by(sensor))]
    np.testing.assert_allclose(pixels[1], (pixels[0] - [13, 22]) / 3, atol=2e-4)
    assert part.seen_by(sensor).id() == "a"
    assert Window.whole((101, 77)).seen_by(sensor) is sensor


def _pixels(sensor, points):
    it = mi.SurfaceInteraction3f()
    it.p = mi.Point3f(*points.T.astype(np.float32))
    sample, _ = sensor.sample_direction(it, mi.Point2f(0.5))
    return np.array(sample.uv).T.astype(np.float64)


def test_crop_keeps_object_and_pixels_that_texels_need(shot, large):
    whole = svu.load_capture(shot)
    seen = [int(np.array(pack_views(whole).usable).sum())]
    fine, coarse = (
        Detail(texels=(side, side)).windows(whole.shape, whole.sensors) for side in (512, 6)
    )
    assert {w.shrink for w in fine} == {1}
    assert all(w.width < 40 or w.height < 32 for w in fine)
    assert min(w.shrink for w in coarse) >= 2
    kept = svu.load_capture(shot, detail=Detail(texels=(512, 512)))
    seen.append(int(np.array(pack_views(kept).usable).sum()))
    assert seen[0] == seen[1]
    small = svu.load_capture(shot, detail=Detail(texels=(6, 6)))
    assert [image.shape[1::-1] for image in small.images] == [w.size for w in coarse]
    for one, other, part in zip(small.images, whole.images, coarse, strict=True):
        k = part.shrink
        blocks = part.cut(other).reshape(part.height, k, part.width, k, 3)
        np.testing.assert_allclose(one, blocks.mean(axis=(1, 3)), rtol=1e-5)


def test_texels_larger_than_a_photograph_leave_it_a_pixel(shot, large):
    """As those of a small chart in a coarse texture."""
    capture = svu.load_capture(shot, views=())
    params = mi.traverse(capture.shape)
    uvs = mi.Float(params["vertex_texcoords"])
    params["vertex_texcoords"] = uvs * 0.02
    params.update()
    for part, sensor in zip(
        Detail(texels=(4, 4)).windows(capture.shape, capture.sensors), capture.sensors, strict=True
    ):
        width, height = film_size(sensor)
        assert part.cut(np.zeros((height, width))).shape == (part.shrink, part.shrink)
    params["vertex_texcoords"] = uvs
    params.update()


def test_cropping_alone_changes_nothing(shot, large):
    """Texels as small as pixels leave photographs their resolution."""
    whole = svu.load_capture(shot)
    kept = svu.load_capture(shot, detail=Detail(texels=(512, 512)))
    assert any(a.shape != b.shape for a, b in zip(whole.images, kept.images, strict=True))
    estimates = [svu.estimate(each, svu.texels(each.mesh, 48)) for each in (whole, kept)]
    same = np.array(estimates[0].coverage) == np.array(estimates[1].coverage)
    assert same.mean() > 0.999
    entropy = [np.array(each.entropy)[same] for each in estimates]
    np.testing.assert_allclose(entropy[1], entropy[0], atol=1e-3)
    assert np.abs(entropy[1] - entropy[0]).mean() < 1e-5


@pytest.mark.parametrize("kind", ["shot", "integers"])
def test_a_pixel_is_the_mean_of_its_block(kind, request, large):
    folder = request.getfixturevalue(kind)
    whole = svu.load_capture(folder)
    kept = svu.load_capture(folder, detail=Detail(side=20))
    assert {image.shape for image in kept.images} == {(16, 20, 3)}
    for view in range(whole.count):
        blocks = whole.images[view].reshape(16, 2, 20, 2, 3)
        np.testing.assert_allclose(kept.images[view], blocks.mean(axis=(1, 3)), rtol=1e-6)
        mask = whole.masks[view].reshape(16, 2, 20, 2).all(axis=(1, 3))
        np.testing.assert_array_equal(kept.masks[view], mask)
        if whole.clipped and whole.clipped[view] is not None:
            flags = whole.clipped[view].flags.reshape(16, 2, 20, 2, 3).all(axis=(1, 3))
            saturation = kept.clipped[view]
            assert not flags.any() if saturation is None else (saturation.flags == flags).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["shot", "integers"])
def test_mapped_photographs_give_equal_bits(kind, request, monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    folder = request.getfixturevalue(kind)
    estimates = []
    for memory in (None, 0.0):
        capture = svu.load_capture(folder, memory=memory)
        estimates.append(svu.estimate(capture, svu.texels(capture.mesh, 32)))
    np.testing.assert_array_equal(np.array(estimates[0].entropy), np.array(estimates[1].entropy))
    assert not list(tmp_path.iterdir())  # the file has no name
    views = estimates[1].observed.views
    assert views.number == 8


def test_full_disk_is_reported(shot, monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pixel_buffer.os, "posix_fallocate", full)
    with pytest.raises(
        CaptureError, match=r"no space for 0.0 GB of photographs \(No space left on"
    ):
        svu.load_capture(shot, memory=0.0)


MANY_FILES = """
import resource
import sys
from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.errors import CaptureError

hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (64, hard))
kept = [PixelBuffer.allocate([(4, 4)], memory=0) for _ in range(30)]
assert all(part.file for part in kept)
resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[0],) * 2)
try:
    kept += [PixelBuffer.allocate([(4, 4)], memory=0) for _ in range(2)]
except CaptureError as error:
    sys.exit(str(error))
"""


def test_files_above_the_default_limit_are_opened():
    """In a process of its own: how many are open in this one depends on the tests before."""
    pytest.importorskip("resource")
    done = python("-c", MANY_FILES)
    assert done.returncode == 1, done.stderr
    said = (
        r"Photographs in files need \d+ open files, but ulimit -n allows \d+; raise the limit, or "
    )
    assert re.fullmatch(said + r"increase --memory\.\n", done.stderr), done.stderr


def test_the_command_takes_memory(shot, tmp_path, capsys):
    size = ("--resolution", 16)
    assert run("entropy", shot, *size, "--memory", "0M", "--no-pictures", "-o", tmp_path / "a") == 0
    line = fails(capsys, "entropy", shot, *size, "--memory", "lots", "-o", tmp_path / "b")
    assert "--memory takes a size such as 4G or 800M, got 'lots'" in line


def test_integers_are_decoded_as_they_were(integers):
    """By a table; NumPy's own formula, value by value, is the truth."""
    capture = svu.load_capture(integers)
    codes = np.array(Image.open(integers / "view_0003.png"))
    values = decoded(codes.astype(np.float32) / 255)
    expected = np.where(codes / 255 > 0.98, np.nan, values)
    np.testing.assert_array_equal(capture.images[3], expected.astype(np.float32))
    np.testing.assert_array_equal(capture.clipped[3].flags, codes / 255 > 0.98)


@pytest.mark.slow
def test_a_large_jpeg_is_imported_as_it_is(shot, monkeypatch, tmp_path, capsys):
    """With its mask beside it; what it says is what an EXR made of it would."""
    description = capture_folder.read(shot)
    source = tmp_path / "source"
    source.mkdir()
    frames = []
    for view, sensor in enumerate(description.make_sensors(shot)):
        planes = read_exr(shot / f"view_{view:04d}.exr")
        color = np.nan_to_num(np.stack([planes[c] for c in "RGB"], axis=-1))
        path, mask = source / f"IMG_{view}.jpg", source / f"IMG_{view}_mask.png"
        Image.fromarray(quantized(srgb(np.clip(2 * color, 0, 1)))).save(path, quality=95)
        Image.fromarray(quantized(planes["A"])).save(mask)
        frames.append(replace(frame_of(sensor, path, exposure=2.0), mask=mask))
    write_transforms(source / "transforms.json", frames)
    mesh = scenes.path("vase").parent / "mesh.ply"
    light = scenes.path("vase").parent.parent / "lights" / "window.exr"
    words = ("import", source, "--mesh", mesh, "--environment", light)
    assert run(*words, "-o", tmp_path / "exr") == 0
    monkeypatch.setattr(convert_photographs, "LARGE", 1)
    assert run(*words, "-o", tmp_path / "jpeg") == 0
    assert (tmp_path / "jpeg" / "view_0003.jpg").read_bytes() == frames[3].image.read_bytes()
    assert not list((tmp_path / "jpeg").glob("view_*.exr"))
    one, other = (svu.load_capture(tmp_path / name) for name in ("exr", "jpeg"))
    for a, b, c, d in zip(one.images, other.images, one.masks, other.masks, strict=True):
        np.testing.assert_array_equal(c, d)
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-4)  # the EXR is in half floats
    for a, b in zip(one.clipped, other.clipped, strict=True):
        assert (a is None) == (b is None)
        if a is not None:
            np.testing.assert_array_equal(a.channels, b.channels)
            np.testing.assert_allclose(a.least, b.least, rtol=1e-5)
    for a, b in zip(one.rounding, other.rounding, strict=True):
        np.testing.assert_allclose([*a.first, *a.slope], [*b.first, *b.slope], rtol=1e-5)
    estimates = [svu.estimate(each, svu.texels(each.mesh, 24)) for each in (one, other)]
    entropy = [np.array(each.entropy) for each in estimates]
    assert np.abs(entropy[1] - entropy[0]).mean() < 2e-3
