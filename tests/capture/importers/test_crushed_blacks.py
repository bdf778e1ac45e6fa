"""Tone curves of photographs, and crushed blacks."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from svu_mi.capture.image_io import open_image
from svu_mi.capture.importers.convert_photographs import (
    CRUSHED,
    convert_photograph,
    photograph_notes,
)
from svu_mi.capture.importers.source import Frame
from svu_mi.capture.photographs import CLIPPED, SATURATED, SATURATION
from svu_mi.capture.tone_curve import SampledCurve
from svu_mi.core.io.exr import read_exr

SEED = 40817
SIZE = (6, 8)  # height and width
GAMMA = 2.2


def photograph(path, pixels, **fields) -> Frame:
    """Write a photograph of 8 or 16 bits, and return its frame."""
    if pixels.dtype == np.uint16:
        bitmap = mi.Bitmap(np.ascontiguousarray(pixels))
        bitmap.set_srgb_gamma(True)
        bitmap.write(str(path))
    else:
        Image.fromarray(pixels).save(path)
    height, width = pixels.shape[:2]
    return Frame(**{
        "label": "frame 0", "image": path, "to_world": np.eye(4), "focal": (9.0, 9.0),
        "center": (width / 2, height / 2), "size": (width, height), **fields,
    })  # fmt: skip


def random(bits, seed=SEED) -> np.ndarray:
    most = 2**bits - 1
    pixels = np.random.default_rng(seed).integers(0, int(0.97 * most), (*SIZE, 3))
    pixels[0, 0] = most
    pixels[0, 1] = (most, most // 3, 0)
    return pixels.astype(np.uint8 if bits == 8 else np.uint16)


def converted(frame, path):
    """Return the converted photograph, its channels (H, W, 3), and the saturation radiance."""
    picture = convert_photograph(frame, path, (1, 1))
    layers = read_exr(path)
    header = open_image(path).header.attributes
    return picture, np.stack([layers[name] for name in "RGB"], axis=-1), header.get(SATURATION)


def test_each_channel_is_decoded_by_its_curve(tmp_path):
    bits, powers, codes = 8, (GAMMA, 1.8, 1.0), np.linspace(0, 1, 256, dtype=np.float32)
    curve = SampledCurve(
        name="a profile", codes=codes, values=np.stack([codes**p for p in powers], axis=-1)
    )
    pixels = random(bits)
    frame = photograph(tmp_path / "a.png", pixels, transfer=curve)
    picture, image, least = converted(frame, tmp_path / "a.exr")
    encoded = pixels / (2**bits - 1)
    over = encoded > SATURATED[bits]
    for channel, power in enumerate(powers):
        below = ~over[..., channel]
        wanted = encoded[below, channel] ** power
        np.testing.assert_allclose(image[below, channel], wanted, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(image[over], CLIPPED)
    assert least == pytest.approx(SATURATED[bits] ** GAMMA, abs=1e-4)  # of the darkest channel
    assert picture.saturated == 2 and picture.invalid == 0
    (note, *_) = photograph_notes([frame], [picture])
    assert f"not HDR: of {bits} bits, decoded as in a profile. 2 saturated pixels" in note


# --- blacks -----------------------------------------------------------------------------------


def dark(folder, part, mask=True, **fields) -> Frame:
    """A photograph with 0 in green on a share of the object, and on the background."""
    pixels = np.full((20, 20, 3), 60, np.uint8)
    object_ = np.zeros((20, 20), np.uint8)
    object_[:10] = 255  # 200 pixels
    pixels[10:] = 0
    pixels[:10].reshape(-1, 3)[: round(200 * part), 1] = 0
    Image.fromarray(object_).save(folder / "mask.png")
    return photograph(
        folder / "a.png", pixels, mask=folder / "mask.png" if mask else None, **fields
    )


def blacks(frames, folder) -> list[str]:
    pictures = [convert_photograph(frame, folder / "out.exr", (1, 1)) for frame in frames]
    return [note for note in photograph_notes(frames, pictures) if "blacks" in note]


@pytest.mark.parametrize(("part", "percent"), [(0.25, "25%"), (0.04, "4%")])
def test_crushed_blacks_are_said_and_stay_what_they_are(tmp_path, part, percent):
    (tmp_path / "other").mkdir()
    frames = [dark(tmp_path / "other", 0.0), dark(tmp_path, part)]
    assert blacks(frames, tmp_path) == [
        f"a.png: crushed blacks ({percent} of the object's pixels "
        "have a channel of 0): darker radiance is lost; expose longer or use HDR."
    ]
    picture, image, _ = converted(frames[1], tmp_path / "out.exr")
    assert picture.crushed == part and picture.invalid == 0
    assert image[0, 0].tolist() == [image[9, 9, 0], 0, image[9, 9, 2]]


def test_few_blacks_backgrounds_and_floats_are_not(tmp_path):
    assert 0.01 <= CRUSHED < 0.03
    assert not blacks([dark(tmp_path, 0.0)], tmp_path)
    assert not blacks([dark(tmp_path, 0.01)], tmp_path)
    assert not blacks([dark(tmp_path, 0.5, mask=False)], tmp_path)  # unknown object
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2)
    Image.fromarray(np.full((256, 1), 255, np.uint8)).save(tmp_path / "mask.png")
    assert not blacks([photograph(tmp_path / "b.png", ramp, mask=tmp_path / "mask.png")], tmp_path)
    empty = dark(tmp_path, 0.5)
    Image.fromarray(np.zeros((20, 20), np.uint8)).save(tmp_path / "mask.png")
    assert not blacks([empty], tmp_path)


def test_a_curve_says_which_codes_are_black(tmp_path):
    """Codes below the black level of a camera are noise."""
    for values, part, percent in (([0, 0, 1], 0.0, "100%"), ([0.1, 0.3, 1], 0.5, "50%")):
        curve = SampledCurve(
            name="a profile", codes=np.float32([0, 60 / 255, 1]),
            values=np.repeat(np.array(values, float)[:, None], 3, axis=1),
        )  # fmt: skip
        frame = dark(tmp_path, part, transfer=curve)
        assert f"{percent} of the object's" in blacks([frame], tmp_path)[0]
