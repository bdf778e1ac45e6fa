"""What a picture holds is read as it is meant, or said, or refused; pictures repeat themselves."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from support.helpers import render_ball, sensor_xml, write_scene

from svu_mi.capture.image_io import decoded, open_image, read_planes
from svu_mi.capture.importers.convert_photographs import convert_photograph, photograph_notes
from svu_mi.capture.importers.envmap import read_environment_map
from svu_mi.capture.importers.source import Frame, Light
from svu_mi.capture.loading import load_capture
from svu_mi.capture.photographs import SATURATED
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.core.io.files import may_hold
from svu_mi.errors import CaptureError, SceneError, SvuWarning
from svu_mi.geometry.texels import texels
from svu_mi.light.environment import read_environment
from svu_mi.output.overview import write_overview
from svu_mi.output.recovery_page import write_recovery_overview
from svu_mi.pipeline import estimate
from svu_mi.posterior.observations import observe
from svu_mi.recovery.recover import recover

SIZE = (20, 30)
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
DISPLAY_P3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290)


def colors(height: int = SIZE[0], width: int = SIZE[1]) -> np.ndarray:
    return np.random.default_rng(8).random((height, width, 3)).astype(np.float32) + 0.5


def write_channels(path, names, chromaticities=None, pixels=None):
    pixels = colors() if pixels is None else pixels
    planes = {name: np.ascontiguousarray(pixels[..., k % 3]) for k, name in enumerate(names)}
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    if chromaticities is not None:
        header["chromaticities"] = chromaticities
    with OpenEXR.File(header, planes) as file:
        file.write(str(path))
    return path


def frame(path, **fields) -> Frame:
    return Frame(**{
        "label": "frame 0", "image": path, "to_world": np.eye(4), "focal": (20.0, 20.0),
        "center": (SIZE[1] / 2, SIZE[0] / 2), "size": SIZE[::-1], **fields,
    })  # fmt: skip


# --- EXR ----------------------------------------------------------------------------------


@pytest.mark.parametrize("names, what", [
    ("XYZ", r"contains CIE XYZ \(X, Y, Z\) instead of RGB; export it as plain RGB"),
    (("Y", "RY", "BY"), r"contains luminance and chroma \(Y, RY, BY\) instead of RGB"),
])  # fmt: skip
def test_other_colours_are_not_taken_for_grey(names, what, tmp_path):
    with pytest.raises(CaptureError, match=what):
        read_planes(write_channels(tmp_path / "a.exr", names))


@pytest.mark.parametrize("names", ["RGB", "Y", "RGBAXYZ", "YZ"])
def test_colours_among_other_channels_are_read(names, tmp_path):
    assert len(read_planes(write_channels(tmp_path / "a.exr", names))[0]) >= 3


@pytest.fixture
def scene(tmp_path):
    """A scene with one photograph to come, as ``view_0000``."""
    return write_scene(tmp_path, sensors=sensor_xml(1, *SIZE[::-1]))


def notes_of(scene) -> list[str]:
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        return list(load_capture(scene).warnings)


def test_64_mib_or_2000_times_the_file_may_be_in_it(tmp_path):
    (tmp_path / "small").write_bytes(bytes(100))
    (tmp_path / "large").touch()
    os.truncate(tmp_path / "large", 2**20)
    for name, most in (("small", 2**26), ("large", 2000 * 2**20)):
        assert may_hold(tmp_path / name, most) and not may_hold(tmp_path / name, most + 1)


@pytest.mark.parametrize("given, said", [(None, 0), (REC_709, 0), (DISPLAY_P3, 1)])
def test_foreign_chromaticities_are_converted(given, said, scene):
    path = write_channels(scene.parent / "view_0000.exr", "RGB", given)
    assert not notes_of(scene)
    photograph = convert_photograph(frame(path), scene.parent / "out.exr", (1, 1))
    notes = photograph_notes([frame(path)], [photograph])
    assert sum("to linear sRGB from Display P3; colours" in note for note in notes) == said
    changed = not np.allclose(load_capture(scene).images[0], colors(), rtol=1e-3)
    assert changed == bool(said)
    light = write_channels(scene.parent / "light.exr", "RGB", given, colors(8, 16))
    pixels = read_environment_map(Light(path=light, to_world=np.eye(3)))[0]
    assert (not np.allclose(pixels[1::2], colors(8, 16), rtol=1e-3)) == bool(said)


# --- Integers -----------------------------------------------------------------------------


def write_16_bits(path, pixels) -> None:
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels, np.uint16))
    bitmap.set_srgb_gamma(True)
    bitmap.write(str(path))


def test_16_bits_are_decoded_as_16_and_called_so(scene):
    pixels = np.random.default_rng(1).integers(20_000, 60_000, (*SIZE, 3))
    pixels[0, 0], pixels[0, 1] = 65_535, round(0.985 * 65_535)  # clipped, and merely bright
    path = scene.parent / "view_0000.png"
    write_16_bits(path, pixels)
    assert open_image(path).bits == 16
    assert any("view_0000.png: 16-bit, not HDR; decoded as sRGB, 1 sat" in note
               for note in notes_of(scene))  # fmt: skip
    with warnings.catch_warnings(action="ignore"):
        capture = load_capture(scene)
    wanted = decoded((pixels / 65_535).astype(np.float32))
    np.testing.assert_allclose(capture.images[0][1:], wanted[1:], rtol=1e-5)
    assert np.isnan(capture.images[0][0, 0]).all() and np.isfinite(capture.images[0][0, 1]).all()


@pytest.mark.parametrize("bits", SATURATED)
def test_clipping_threshold_depends_on_bits(bits, tmp_path):
    most = 2**bits - 1
    values = np.full((*SIZE, 3), most // 2)
    values[0] = round(0.985 * most)
    path = tmp_path / "a.png"
    if bits == 16:
        write_16_bits(path, values)
    else:
        Image.fromarray(values.astype(np.uint8)).save(path)
    photograph = convert_photograph(frame(path), tmp_path / "a.exr", (1, 1))
    assert photograph.bits == bits and photograph.saturated == (SIZE[1] if bits == 8 else 0)
    written = read_exr(tmp_path / "a.exr")["R"]
    wanted, kept = decoded(values[1:, :, 0] / most), 1e-3 if bits == 8 else 1e-6  # half floats
    np.testing.assert_allclose(written[1:], wanted, rtol=kept)
    (note, *_) = photograph_notes([frame(path)], [photograph])
    assert f"not HDR: of {bits} bits, decoded as srgb. " in note


def test_inks_are_refused(tmp_path):
    image = Image.fromarray((colors() * 100).astype(np.uint8))
    image.convert("CMYK").save(tmp_path / "a.jpg")
    with pytest.raises(CaptureError, match=r"a.jpg: the image is in CMYK or Lab; export"):
        read_planes(tmp_path / "a.jpg")
    image.save(tmp_path / "a.bmp")
    with pytest.raises(CaptureError, match=r"a.bmp: not a supported image format \(.exr, .hdr"):
        read_planes(tmp_path / "a.bmp")


def test_a_palette_is_looked_up(tmp_path):
    image = Image.fromarray((colors() * 100).astype(np.uint8)).quantize(16)
    image.save(tmp_path / "a.png")
    planes, _ = read_planes(tmp_path / "a.png")
    wanted = np.array(image.convert("RGB"))
    np.testing.assert_array_equal(np.stack(planes, axis=-1) * 255, wanted)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_exif_rotation_causes_a_warning(suffix, scene):
    image = Image.fromarray((colors() * 100).astype(np.uint8))
    tags = image.getexif()
    tags[0x0112] = 6
    image.save(scene.parent / f"view_0000{suffix}", exif=tags)
    assert any("not turned, although EXIF data request it" in note for note in notes_of(scene))


# --- Light --------------------------------------------------------------------------------


def dented(value: float, count: int) -> np.ndarray:
    pixels = colors(32, 64)
    pixels[5, :count] = value
    return pixels


def envmap(path):
    return mi.load_dict({"type": "envmap", "filename": str(path)})


def test_few_negative_pixels_of_light_become_0_with_warning(tmp_path):
    write_exr(tmp_path / "sky.exr", {"RGB": dented(-0.25, 3)})
    with pytest.warns(SvuWarning, match=r"\(.*sky.exr\): 3 negative pixels were set to 0\.$"):
        light = read_environment(envmap(tmp_path / "sky.exr"))
    assert light.radiance.min() == 0
    pixels, _, notes = read_environment_map(Light(path=tmp_path / "sky.exr", to_world=np.eye(3)))
    assert pixels.min() == 0 and notes[0].endswith("sky.exr: 3 negative pixels were set to 0.")


def test_black_pixels_of_light_are_not_negative(tmp_path):
    write_exr(tmp_path / "sky.exr", {"RGB": dented(0.0, 3)})
    assert not read_environment_map(Light(path=tmp_path / "sky.exr", to_world=np.eye(3)))[2]


def test_much_negative_light_is_refused(tmp_path):
    write_exr(tmp_path / "sky.exr", {"RGB": dented(-40.0, 20)})
    with pytest.raises(SceneError, match="sky.exr.*pixels are negative and cancel more than 1% of"):
        read_environment(envmap(tmp_path / "sky.exr"))
    with pytest.raises(
        CaptureError, match="sky.exr: 20 pixels are negative and cancel more than 1% of"
    ):
        read_environment_map(Light(path=tmp_path / "sky.exr", to_world=np.eye(3)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_error_of_invalid_light_names_its_file(value, tmp_path):
    write_channels(tmp_path / "sky.exr", "RGB", pixels=dented(value, 2))
    with pytest.raises(SceneError, match="sky.exr.* has NaN or infinite radiance; repair its map"):
        read_environment(envmap(tmp_path / "sky.exr"))


# --- Pictures of results ------------------------------------------------------------------


@pytest.mark.slow
def test_pages_of_two_equal_runs_are_equal_byte_for_byte(tmp_path):
    capture = render_ball(tmp_path, {"type": "constant"}, {"type": "principled"}, 4, (24, 24), 4)
    seen = observe(capture, texels(capture.mesh, 24))
    result, got = estimate(seen), recover(seen)
    for run, seconds in enumerate((0.11, 77.7)):
        timings = dict.fromkeys(result.timings, seconds)
        write_overview(capture, replace(result, timings=timings), tmp_path / f"overview{run}.png")
        timings = dict.fromkeys(got.timings, seconds)
        again = replace(got, timings=timings)
        write_recovery_overview(capture, again, [], tmp_path / f"recovery{run}.png")
    for name in ("overview", "recovery"):
        first, second = ((tmp_path / f"{name}{run}.png").read_bytes() for run in range(2))
        assert first == second
