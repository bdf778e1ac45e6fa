"""Measured response curves of cameras, and crushed blacks."""

from __future__ import annotations

import json
import re
import shlex

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.helpers import ball, fails, run

import svu_mi as svu
from svu_mi.capture.content_hash import photographs_key
from svu_mi.capture.image_io import open_image, srgb
from svu_mi.capture.importers.camera_response import LARGEST, read_response
from svu_mi.capture.importers.convert_photographs import (
    CRUSHED,
    convert_photograph,
    photograph_notes,
    with_response,
)
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import OPENGL, Frame
from svu_mi.capture.mesh import write_ply
from svu_mi.capture.photographs import CLIPPED, SATURATED, SATURATION
from svu_mi.capture.sensors import affine
from svu_mi.capture.tone_curve import linearize
from svu_mi.cli.import_ import reimport_command
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import CaptureError

SEED = 40817
SIZE = (6, 8)  # height and width
GAMMA = 2.2


def table(path, curves, codes=None, between=" "):
    """Write a response curve: codes, and linear values in an arbitrary unit."""
    codes = np.linspace(0, 255, 256) if codes is None else codes
    columns = [codes, *([7 * curve(codes / codes[-1]) for curve in curves])]
    lines = [between.join(f"{number:.9g}" for number in row) for row in np.transpose(columns)]
    path.write_text("# code radiance\n\n" + "\n".join(lines) + "  # white\n")
    return path


def gamma(encoded):
    return encoded**GAMMA


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


@pytest.mark.parametrize("bits", SATURATED)
@pytest.mark.parametrize("largest", LARGEST)
def test_codes_become_what_was_measured(bits, largest, tmp_path):
    codes = np.linspace(0, 1, 256) * largest
    curve = table(tmp_path / "curve.txt", [gamma], codes, between=", ")
    pixels = random(bits)
    frame = photograph(tmp_path / "a.png", pixels)
    (frame,) = with_response([frame], curve)
    picture, image, least = converted(frame, tmp_path / "a.exr")
    encoded = pixels / (2**bits - 1)
    over = encoded > SATURATED[bits]
    error = GAMMA * (GAMMA - 1) / 8 / 255**2  # error of linear interpolation between 256 samples
    np.testing.assert_allclose(image[~over], gamma(encoded[~over]), rtol=1e-5, atol=error)
    np.testing.assert_array_equal(image[over], CLIPPED)
    assert least == pytest.approx(gamma(SATURATED[bits]), abs=1e-5)
    assert picture.saturated == 2 and picture.invalid == 0
    (note, *_) = photograph_notes([frame], [picture])
    assert f"not HDR: of {bits} bits, decoded as in curve.txt. 2 saturated pixels" in note


def test_eight_bits_hit_samples_exactly(tmp_path):
    """A curve with 256 samples needs no interpolation for 8-bit codes."""
    curve = table(tmp_path / "curve.txt", [lambda x: x**6])
    pixels = np.repeat(np.arange(250, dtype=np.uint8)[:, None, None], 3, axis=2)
    (frame,) = with_response([photograph(tmp_path / "a.png", pixels)], str(curve))
    _, image, least = converted(frame, tmp_path / "a.exr")
    np.testing.assert_allclose(image[:, 0, 1], (np.arange(250) / 255) ** 6, rtol=1e-5)
    assert least is None


def test_each_channel_has_its_own_curve_and_unit(tmp_path):
    curves = [gamma, lambda x: 100 * x**1.8, lambda x: 0.01 * x]
    pixels = random(8)
    response = table(tmp_path / "curve.txt", curves)
    (frame,) = with_response([photograph(tmp_path / "a.png", pixels)], response)
    _, image, least = converted(frame, tmp_path / "a.exr")
    encoded = pixels / 255
    for channel, power in enumerate((GAMMA, 1.8, 1.0)):
        below = encoded[..., channel] <= SATURATED[8]
        wanted = encoded[below, channel] ** power
        np.testing.assert_allclose(image[below, channel], wanted, rtol=1e-5, atol=1e-7)
    assert least == pytest.approx(SATURATED[8] ** GAMMA, abs=1e-4)  # of the darkest channel


def test_response_overrides_the_source_and_ignores_floats(tmp_path):
    response = table(tmp_path / "curve.txt", [gamma])
    write_exr(tmp_path / "b.exr", {"RGB": np.full((*SIZE, 3), 0.5, np.float32)})
    frames = [photograph(tmp_path / "a.png", random(8), transfer="linear")]
    frames.append(Frame(
        label="b", image=tmp_path / "b.exr", to_world=np.eye(4), focal=(9.0, 9.0),
        center=(4.0, 3.0), size=SIZE[::-1],
    ))  # fmt: skip
    given = with_response(frames, response)
    _, image, _ = converted(given[0], tmp_path / "out.exr")
    assert image[1, 1, 0] == pytest.approx(gamma(random(8)[1, 1, 0] / 255), rel=1e-4)
    picture, image, _ = converted(given[1], tmp_path / "out.exr")
    assert picture.bits == 0 and (image == 0.5).all() and picture.crushed == 0
    assert with_response(frames, None) is frames
    with pytest.raises(svu.SvuError, match=r"--response: b.exr and all other.* omit this option\."):
        with_response(frames[1:], response)


WRONG = {
    "empty": ("# nothing\n", r"a response curve needs at least 2 samples, got 0; write one"),
    "one line": ("255 1\n", r"a response curve needs at least 2 samples, got 1; write"),
    "words": ("code,radiance\n0 0\n1 1\n", r"line 1: could not convert string to float"),
    "three": ("0 0 0\n1 1 1\n", r"line 1: has 3 numbers, not 4; write one line ENCODED LINEAR"),
    "another count": ("0 0 0 0\n1 1\n", r"line 2: has 2 numbers, not 4; write one line ENC"),
    "descending": ("0 0\n\n200 1\n100 2", r"line 4: the encoded value 100 comes after 200, but"),
    "twice": ("0 0\n128 1\n128 2\n255 3", r"line 3: the encoded value 128 comes after 128"),
    "falling": ("0 0\n128 2\n255 1", r"line 3: the linear value decreases"),
    "falling in blue": ("0 0 0 2\n255 1 1 1", r"line 2: the linear value decreases"),
    "NaN": ("0 0\n128 nan\n255 1", r"line 2: sample\[1\] must be .*, got nan"),
    "infinite": ("0 0\n255 1e999", r"line 2: sample\[1\] must be a number in \[0, .*, got inf"),
    "negative": ("0 -0.1\n255 1", r"line 1: sample\[1\] must be .*, got -0.1"),
    "no black": ("16 0\n255 1", r"its codes range from 16 to 255, not from 0 to 1, 255 or "),
    "no white": ("0 0\n235 1", r"its codes range from 0 to 235, .*; add lines for the first and"),
    "dark": ("0 0\n255 0", r"a channel is 0 up to 98% of the largest code; add samples"),
    "too close": ("0 0\n0.5 1\n0.500000001 2\n1 3", r"the encoded values 0.5 and 0.500000001 are"),
    "a threshold": ("0 0 0 0\n254 1 0 1\n255 1 1 1", r"a channel is 0 up to 98%"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_tables_that_are_none_are_a_sentence(kind, tmp_path):
    text, said = WRONG[kind]
    path = tmp_path / "curve.txt"
    path.write_text(text)
    refused(path, said)


def refused(path, said) -> None:
    with pytest.raises(CaptureError, match=f"^{re.escape(str(path))}: {said}") as error:
        read_response(path)
    sentence = str(error.value)
    assert sentence.endswith(".") and "\n" not in sentence and len(sentence) < 400


def test_files_that_are_no_text_are_a_sentence(tmp_path):
    path = tmp_path / "curve.txt"
    refused(path, r"not a response curve that can be read: .*; write one line ENCODED LINEAR or")
    Image.fromarray(random(8)).save(path, "png")
    refused(path, r"not a response curve that can be read: .*; write one line")
    path.write_bytes(b"0 0\n1 1\n" + b"#" * 2**24)
    refused(path, r"not a response curve that can be read: more than 16 MiB; write one line")


def test_response_beyond_single_precision_is_finite(tmp_path):
    path = tmp_path / "curve.txt"
    path.write_text("0 0\n1e-40 1e-300\n1e-30 1e307\n1 1.7e308\n")
    radiance = linearize(np.linspace(0, 1, 256, dtype=np.float32), read_response(path), 0)
    assert np.isfinite(radiance).all() and radiance[-1] == 1 and (np.diff(radiance) >= 0).all()


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


def test_a_response_says_which_codes_are_black(tmp_path):
    """Codes below the black level of a camera are noise."""
    (tmp_path / "curve.txt").write_text("0 0\n60 0\n255 1\n")
    (frame,) = with_response([dark(tmp_path, 0.0)], tmp_path / "curve.txt")
    assert "100% of the object's" in blacks([frame], tmp_path)[0]
    (tmp_path / "curve.txt").write_text("0 0.1\n255 1\n")  # stray light
    (frame,) = with_response([dark(tmp_path, 0.5)], tmp_path / "curve.txt")
    assert "50% of the object's" in blacks([frame], tmp_path)[0]


# --- the command ------------------------------------------------------------------------------


@pytest.fixture
def shots(tmp_path, monkeypatch):
    """Two 8-bit photographs in the working directory, poses, a mesh, and a response curve."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "shots"
    folder.mkdir()
    write_ply(folder / "ball.ply", "ball", ball(8, 6))
    frames = []
    for view, side in enumerate((1, -1)):
        pose = affine(np.diag([side, 1.0, side]), [0, 0, 4 * side]) @ OPENGL
        frames.append(photograph(folder / f"{view}.png", random(8, view), to_world=pose))
    write_transforms(folder / "transforms.json", frames)
    table(tmp_path / "curve.txt", [gamma])
    return folder


WORDS = ("import", "shots", "--mesh", "shots/ball.ply")


def test_an_import_decodes_by_the_response_and_says_so_again(shots, capsys):
    assert run(*WORDS, "--response", "curve.txt", "-o", "mine") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "not HDR: of 8 bits, decoded as in curve.txt. 4 saturated pixels" in said
    capture = svu.load_capture("mine", light="optional")
    for view in range(2):
        pixels = random(8, view) / 255
        over = pixels > SATURATED[8]
        np.testing.assert_array_equal(capture.clipped[view].flags, over)
        np.testing.assert_allclose(capture.clipped[view].least, gamma(SATURATED[8]), atol=1e-4)
        np.testing.assert_allclose(capture.images[view][~over], gamma(pixels[~over]), atol=1e-5)
    record = json.loads((shots.parent / "mine" / "capture.json").read_text())["import"]
    assert record["options"][-2:] == ["--response", "curve.txt"]
    line = reimport_command(capture, ["camera-z180"])
    assert "--response curve.txt" in line
    assert run(*shlex.split(line)[1:]) == 0
    assert run(*WORDS, "-o", "plain") == 0  # other pixels, so another key
    plain = svu.load_capture("plain", light="optional")
    assert photographs_key(plain) != photographs_key(capture)
    assert srgb(plain.images[0][3, 3, 0]) * 255 == pytest.approx(random(8, 0)[3, 3, 0], abs=0.1)


def test_the_command_refuses_in_one_line(shots, capsys):
    words = (*WORDS, "-o", "mine", "--response")
    (shots.parent / "curve.txt").write_text("0 0\n")
    assert fails(capsys, *words, "curve.txt") == (
        "svu: curve.txt: a response curve needs at least 2 samples, got 1; write one line "
        "ENCODED LINEAR or ENCODED R G B for each sample of the curve."
    )
    assert "none.txt: not a response curve that can be read" in fails(capsys, *words, "none.txt")
    assert not (shots.parent / "mine").exists()
