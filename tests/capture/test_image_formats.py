"""Each row of the table of image formats in the notebook of captures, and consequences."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pillow_heif
import pytest
import trimesh
from PIL import Image, ImageOps, TiffImagePlugin
from support.helpers import peak_memory
from support.image_files import (
    ACESCG,
    ADOBE,
    P3,
    PROPHOTO,
    REC_2020,
    SRGB,
    SRGB_PARA,
    chrm,
    codes,
    curv,
    dng,
    exif,
    exr,
    gamma_encoded,
    hdr,
    icc,
    iccp,
    in_space,
    linear_colors,
    para,
    png,
    srgb_encoded,
    to_pcs,
    with_oiio,
)

from svu_mi.capture.crop import Window
from svu_mi.capture.image_formats import image_header, recognition
from svu_mi.capture.image_io import open_image
from svu_mi.capture.importers.convert_photographs import convert_photograph, photograph_notes
from svu_mi.capture.importers.exposure_list import with_exif_gains
from svu_mi.capture.importers.import_capture import _fitted_pictures
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.source import Frame
from svu_mi.capture.match_photographs import match_photographs
from svu_mi.capture.photographs import open_photographs, read_photographs
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import CaptureError

LINEAR = linear_colors()
BLOCKS = np.kron(linear_colors(3, 4), np.ones((16, 16, 1)))  # for lossy formats
CENTRES = (slice(8, None, 16), slice(8, None, 16))
WITHIN = 5e-3  # relative error
P3_CODES = codes(srgb_encoded(in_space(LINEAR, P3)))
PLAIN = codes(srgb_encoded(LINEAR))
P3_ICC = icc(P3, SRGB_PARA)
TABLES = icc(SRGB, SRGB_PARA, A2B0=b"mft2" + bytes(60), rXYZ=b"", rTRC=b"")
HALVES = np.random.default_rng(7).integers(128, 255, (6, 10, 3)) / 256  # exact in HDR files


def linear(path: Path) -> np.ndarray:
    return np.stack(open_image(path).linear(), axis=-1)


def follows(path: Path, wanted: np.ndarray = LINEAR, within: float = WITHIN) -> None:
    np.testing.assert_allclose(linear(path), wanted, rtol=within)


def reports(path: Path, words: str, wanted: np.ndarray = LINEAR) -> None:
    follows(path, wanted)
    assert any(words in remark for remark in open_image(path).remarks())


def refuses(path: Path, words: str) -> None:
    with pytest.raises(CaptureError, match=rf"{re.escape(path.name)}.*{words}"):
        linear(path)


def saved(path: Path, pixels: np.ndarray, **options: object) -> Path:
    """A file of 8 bits in the format of its suffix, as good as it gets."""
    best = {"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {"quality": 100}
    best |= {"lossless": True} if path.suffix == ".webp" else {}
    best |= {"subsampling": "4:4:4"} if path.suffix == ".avif" else {}
    Image.fromarray(pixels).save(path, **{**best, **options})
    return path


def lossy(path: Path, pixels: np.ndarray, **options: object) -> None:
    """Blocks, of which rounding to 8 bits moves a value by 2 %, are what the file holds."""
    values = linear(saved(path, codes(pixels, 8), **options))
    np.testing.assert_allclose(values[CENTRES], BLOCKS[CENTRES], rtol=0.03, atol=4e-3)


def upright(path: Path, turned: np.ndarray) -> None:
    """Orientation 6 asks for a turn by 90 degrees clockwise."""
    picture = open_image(path)
    assert picture.size == turned.shape[1::-1]
    assert any("turned as the EXIF" in remark for remark in picture.remarks())
    np.testing.assert_allclose(picture.linear()[0], turned[..., 0], rtol=0.05, atol=4e-3)


def heic(path: Path, pixels: np.ndarray, **fields: object) -> Path:
    file = pillow_heif.from_pillow(Image.fromarray(pixels))
    file.info.update({key: value for key, value in fields.items() if key == "icc_profile"})
    options = {key: value for key, value in fields.items() if key != "icc_profile"}
    file.save(path, quality=-1, chroma=444, matrix_coefficients=0, **options)
    return path


def tagged(path: Path, pixels: np.ndarray, tags: dict[int, object]) -> Path:
    entries = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, value in tags.items():
        entries[tag] = value
    Image.fromarray(pixels).save(path, tiffinfo=entries)
    return path


def white_is_zero(path: Path) -> Path:
    Image.fromarray(255 - codes(srgb_encoded(LINEAR[..., 0]), 8)).save(path)
    data = bytearray(path.read_bytes())
    at = data.index(struct.pack("<HHII", 262, 3, 1, 1)) + 8  # PhotometricInterpretation
    data[at] = 0
    path.write_bytes(data)
    return path


def palette(path: Path) -> None:
    image = Image.fromarray(codes(srgb_encoded(LINEAR), 8)).quantize(100)
    image.save(path, transparency=0)
    planes, wanted = open_image(path).planes(), np.array(image.convert("RGB")) / 255
    np.testing.assert_allclose(np.stack(planes[:3], axis=-1), wanted, atol=1e-6)
    np.testing.assert_array_equal(planes[3] == 0, np.array(image) == 0)


def premultiplied(path: Path) -> None:
    alpha = np.full((*LINEAR.shape[:2], 1), 65535)
    alpha[0, 0], alpha[0, 1] = 0, 40_000
    file = with_oiio(path, np.dstack([PLAIN, alpha]).astype(np.uint16))
    assert any("alpha is premultiplied" in remark for remark in open_image(file).remarks())
    assert open_image(file).planes()[3].ravel()[:3].tolist() == [0, 0, 1]


def pfm(path: Path) -> None:
    rows = (HALVES / 2.5).astype("<f4")[::-1]
    path.write_bytes(b"PF\n10 6\n-2.5\n" + rows.tobytes())
    follows(path, HALVES)


def layer(path: Path) -> None:
    planes = {f"View.{c}": np.ascontiguousarray(LINEAR[..., k], "f4") for k, c in enumerate("RGB")}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(path))
    follows(path)


def parts(path: Path, **pictures: np.ndarray) -> Path:
    OpenEXR.File([
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"RGB": pixels.astype("f4")}, name)
        for name, pixels in pictures.items()
    ]).write(str(path))  # fmt: skip
    return path


def cropped(path: Path) -> None:
    file = exr(path, LINEAR, displayWindow=(np.array([0, 0], "i4"), np.array([20, 20], "i4")))
    assert open_image(file).header.cropped


def camera_levels(path: Path) -> None:
    """Black is 0, and white is saturated; the levels of LibRaw's fixed 16 bits would be others."""
    image = np.kron(np.array([[0.0, 0.25, 1.0]]), np.ones((32, 16)))[..., None] * np.ones(3)
    values = linear(dng(path, image))[8, 8::16]
    np.testing.assert_allclose(values, [[0] * 3, [0.25] * 3, [1] * 3], rtol=WITHIN, atol=1e-4)


def avif_points(path: Path) -> None:
    file = saved(path, codes(srgb_encoded(in_space(BLOCKS, P3)), 8))
    data = file.read_bytes()
    at = data.index(b"colrnclx") + 8
    file.write_bytes(data[:at] + struct.pack(">HH", 12, 13) + data[at + 4 :])
    np.testing.assert_allclose(linear(file)[CENTRES], BLOCKS[CENTRES], rtol=0.03, atol=4e-3)


def later_pictures(path: Path) -> None:
    lossy(path, srgb_encoded(BLOCKS))
    data = path.read_bytes()
    path.write_bytes(data + data)
    np.testing.assert_allclose(linear(path)[CENTRES], BLOCKS[CENTRES], rtol=0.03, atol=4e-3)


P3_8 = srgb_encoded(in_space(BLOCKS, P3))
SRGB_8 = codes(srgb_encoded(BLOCKS), 8)
ADOBE_8 = gamma_encoded(563 / 256)(in_space(BLOCKS, ADOBE))
TURNED = np.rot90(BLOCKS, -1)
FLOATS = LINEAR.astype(np.float32)
GREY = LINEAR[..., :1] * np.ones(3)
P3_NUMBERS = " ".join(map(str, P3))
FROM_P3 = HALVES @ (np.linalg.inv(to_pcs(SRGB)) @ to_pcs(P3)).T
GAINS = np.array([1.0, 2.0, 4.0])

CASES: dict[tuple[str, str], Callable[[Path], None]] = {
    ("JPEG", "ICC profile with a matrix"): lambda d: lossy(d / "a.jpg", P3_8, icc_profile=P3_ICC),
    ("JPEG", "ICC profile of tables"): lambda d: reports(
        saved(d / "a.jpg", SRGB_8, icc_profile=TABLES), "not followed, because it has tables",
        linear(saved(d / "b.jpg", SRGB_8))),
    ("JPEG", "EXIF Orientation"): lambda d: upright(
        saved(d / "a.jpg", SRGB_8, exif=exif(orientation=6)), TURNED),
    ("JPEG", "EXIF InteroperabilityIndex R03 (Adobe RGB)"): lambda d: lossy(
        d / "a.jpg", ADOBE_8, exif=exif(interoperability="R03")),
    ("JPEG", "one component"): lambda d: np.testing.assert_array_equal(
        *linear(saved(d / "a.jpg", SRGB_8[..., 0])).T[:2]),
    ("JPEG", "CMYK"): lambda d: refuses(_inks(d / "a.jpg"), "CMYK"),
    ("JPEG", "later pictures, gain map"): lambda d: later_pictures(d / "a.jpg"),
    ("PNG", "16 bits"): lambda d: follows(png(d / "a.png", PLAIN)),
    ("PNG", "PLTE, tRNS"): lambda d: palette(d / "a.png"),
    ("PNG", "cICP"): lambda d: follows(png(d / "a.png", P3_CODES, cICP=bytes([12, 13, 0, 1]))),
    ("PNG", "cICP for HDR screens"): lambda d: refuses(
        png(d / "a.png", PLAIN, cICP=bytes([9, 16, 0, 1])), r"HDR screens \(PQ\)"),
    ("PNG", "iCCP"): lambda d: follows(png(d / "a.png", P3_CODES, iCCP=iccp(P3_ICC))),
    ("PNG", "sRGB"): lambda d: follows(
        png(d / "a.png", PLAIN, sRGB=b"\0", gAMA=struct.pack(">I", 100_000), cHRM=chrm(P3))),
    ("PNG", "gAMA"): lambda d: (
        follows(png(d / "a.png", codes(LINEAR), gAMA=struct.pack(">I", 100_000))),
        follows(png(d / "a.png", PLAIN, gAMA=struct.pack(">I", 45_455)))),
    ("PNG", "gAMA and cHRM"): lambda d: follows(png(
        d / "a.png", codes(gamma_encoded(1.8)(in_space(LINEAR, P3))),
        gAMA=struct.pack(">I", 55_556), cHRM=chrm(P3))),
    ("PNG", "damaged iCCP"): lambda d: reports(
        png(d / "a.png", PLAIN, iCCP=iccp(P3_ICC)[:-40]), "is not followed, because it is damaged"),
    ("PNG", "eXIf Orientation"): lambda d: upright(
        saved(d / "a.png", SRGB_8, exif=exif(orientation=6)), TURNED),
    ("PNG", "sBIT, bKGD, pHYs, tEXt"): lambda d: follows(png(
        d / "a.png", PLAIN, sBIT=b"\5\5\5", pHYs=struct.pack(">IIB", 1, 2, 0), bKGD=bytes(6),
        tEXt=b"Gamma\x001.0")),
    ("TIFF", "16 bits"): lambda d: follows(with_oiio(d / "a.tif", PLAIN)),
    ("TIFF", "floating point"): lambda d: follows(with_oiio(d / "a.tif", FLOATS * 9), LINEAR * 9),
    ("TIFF", "floating point with a tone curve"): lambda d: refuses(
        with_oiio(d / "a.tif", FLOATS, profile=icc(P3, curv(461))), "export linear values"),
    ("TIFF", "ICC profile with a matrix"): lambda d: follows(
        with_oiio(d / "a.tif", P3_CODES, profile=P3_ICC)),
    ("TIFF", "WhitePoint, PrimaryChromaticities"): lambda d: np.testing.assert_allclose(
        linear(tagged(d / "a.tif", codes(P3_8, 8), {318: P3[6:], 319: P3[:6]})),
        BLOCKS, rtol=0.03, atol=4e-3),
    ("TIFF", "TransferFunction"): lambda d: reports(
        tagged(d / "a.tif", SRGB_8, {301: tuple(range(256)) * 3}), "TransferFunction tag",
        linear(saved(d / "b.png", SRGB_8))),
    ("TIFF", "PhotometricInterpretation WhiteIsZero"): lambda d: np.testing.assert_allclose(
        linear(white_is_zero(d / "a.tif"))[..., 2], LINEAR[..., 0], rtol=0.05),
    ("TIFF", "PhotometricInterpretation CMYK"): lambda d: refuses(_inks(d / "a.tif"), "CMYK"),
    ("TIFF", "Orientation"): lambda d: upright(
        with_oiio(d / "a.tif", SRGB_8, Orientation=6), TURNED),
    ("TIFF", "ExtraSamples premultiplied alpha"): lambda d: premultiplied(d / "a.tif"),
    ("TIFF", "several pages"): lambda d: reports(
        saved(d / "a.tif", SRGB_8, save_all=True, append_images=[Image.fromarray(255 - SRGB_8)]),
        "several pages", linear(saved(d / "b.png", SRGB_8))),
    ("WebP", "ICCP"): lambda d: lossy(d / "a.webp", P3_8, icc_profile=P3_ICC),
    ("WebP", "EXIF Orientation"): lambda d: upright(
        saved(d / "a.webp", SRGB_8, exif=exif(orientation=6)), TURNED),
    ("WebP", "ANIM"): lambda d: reports(
        saved(d / "a.webp", SRGB_8, save_all=True, append_images=[Image.fromarray(255 - SRGB_8)]),
        "animated", linear(saved(d / "b.png", SRGB_8))),
    ("JPEG XL", "ICC profile with a matrix"): lambda d: follows(
        with_oiio(d / "a.jxl", P3_CODES, profile=P3_ICC)),
    ("JPEG XL", "floating point"): lambda d: follows(with_oiio(d / "a.jxl", FLOATS)),
    ("AVIF", "ICC profile with a matrix"): lambda d: lossy(d / "a.avif", P3_8, icc_profile=P3_ICC),
    ("AVIF", "nclx"): lambda d: avif_points(d / "a.avif"),
    ("AVIF", "irot"): lambda d: upright(
        saved(d / "a.avif", SRGB_8, exif=exif(orientation=6)), TURNED),
    ("HEIC", "ICC profile with a matrix"): lambda d: np.testing.assert_allclose(
        linear(heic(d / "a.heic", codes(P3_8, 8), icc_profile=P3_ICC))[CENTRES], BLOCKS[CENTRES],
        rtol=0.03, atol=4e-3),
    ("HEIC", "nclx"): lambda d: np.testing.assert_allclose(
        linear(heic(d / "a.heic", codes(P3_8, 8), color_primaries=12, transfer_characteristics=13)
               )[CENTRES], BLOCKS[CENTRES], rtol=0.03, atol=4e-3),
    ("RAW", "black and white level"): lambda d: camera_levels(d / "a.dng"),
    ("RAW", "colour matrix"): lambda d: np.testing.assert_allclose(
        linear(dng(d / "a.dng", in_space(BLOCKS, P3), primaries=P3))[CENTRES], BLOCKS[CENTRES],
        rtol=WITHIN),
    ("RAW", "flip"): lambda d: upright(dng(d / "a.dng", BLOCKS, 6), linear(
        dng(d / "b.dng", BLOCKS)).swapaxes(0, 1)[:, ::-1]),
    ("HDR", "EXPOSURE, COLORCORR"): lambda d: follows(
        hdr(d / "a.hdr", HALVES, "EXPOSURE=2\nCOLORCORR= 1 2 4\nEXPOSURE=.5e1\n"),
        HALVES / GAINS / 10),
    ("HDR", "PRIMARIES"): lambda d: follows(
        hdr(d / "a.hdr", HALVES, f"PRIMARIES={P3_NUMBERS}\n"), FROM_P3),
    ("HDR", "FORMAT XYZE"): lambda d: refuses(
        hdr(d / "a.hdr", HALVES, "FORMAT=32-bit_rle_xyze\n"), "CIE XYZ"),
    ("HDR", "PIXASPECT"): lambda d: reports(
        hdr(d / "a.hdr", HALVES, "PIXASPECT=2\n"), "PIXASPECT in the header is ignored", HALVES),
    ("HDR", "order of rows and columns"): lambda d: follows(
        hdr(d / "a.hdr", HALVES, axes="+Y {} +X {}"), HALVES[::-1]),
    ("HDR", "VIEW, SOFTWARE"): lambda d: follows(
        hdr(d / "a.hdr", HALVES, "VIEW= -vp 1 2 3\nSOFTWARE=mine\n"), HALVES),
    ("PFM", "scale"): lambda d: pfm(d / "a.pfm"),
    ("EXR", "chromaticities"): lambda d: follows(
        exr(d / "a.exr", in_space(LINEAR, ACESCG), chromaticities=ACESCG)),
    ("EXR", "whiteLuminance, exposure"): lambda d: (
        reports(exr(d / "a.exr", LINEAR, whiteLuminance=80.0), "whiteLuminance = 80.0 in the"),
        reports(exr(d / "a.exr", LINEAR, exposure=-1.5), "exposure = -1.5 in the header")),
    ("EXR", "pixelAspectRatio"): lambda d: reports(
        exr(d / "a.exr", LINEAR, pixelAspectRatio=2.0), "pixelAspectRatio = 2.0 in the header"),
    ("EXR", "display window"): lambda d: cropped(d / "a.exr"),
    ("EXR", "XYZ, luminance and chroma"): lambda d: refuses(
        exr(d / "a.exr", LINEAR, "XYZ"), "contains CIE XYZ"),
    ("EXR", "one layer"): lambda d: layer(d / "a.exr"),
    ("EXR", "several parts"): lambda d: reports(
        parts(d / "a.exr", beauty=LINEAR, albedo=LINEAR / 2), "the first (beauty) is used"),
    ("EXR", "owner, comments, expTime"): lambda d: follows(
        exr(d / "a.exr", LINEAR, owner="me", comments="dark", expTime=0.25)),
    ("any", "suffix of another format"): lambda d: reports(
        png(d / "a.jpg", PLAIN), "PNG, despite the suffix"),
}  # fmt: skip


def _inks(path: Path) -> Path:
    Image.fromarray(SRGB_8).convert("CMYK").save(path)
    return path


def _table() -> list[tuple[str, str]]:
    page = Path(__file__).parents[2] / "notebooks" / "capture.md"
    section = page.read_text().partition("## Fields of image formats")[2].partition("\n## ")[0]
    row = r"^\| ([^|]+) \| ([^|]+) \| (?:followed|reported|refused|harmless: )[^|]*\|$"
    return re.findall(row, section, re.MULTILINE)


@pytest.mark.parametrize("field", _table(), ids="-".join)
def test_field_of_the_table(field, tmp_path):
    CASES[field](tmp_path)


def test_every_case_is_in_the_table():
    assert set(_table()) == set(CASES) and len(_table()) == len(CASES)


@pytest.mark.parametrize("name, primaries, curve, encode", [
    ("Adobe RGB", ADOBE, curv(563), gamma_encoded(563 / 256)),
    ("ProPhoto", PROPHOTO, curv(461), gamma_encoded(461 / 256)),
    ("linear", SRGB, curv(), gamma_encoded(1)),
    ("Rec. 2020", REC_2020, para(1, 2.0, 1.0, 0.0), gamma_encoded(2)),
    ("seven numbers", P3, para(4, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045, 0, 0),
     srgb_encoded),
    ("samples", P3, curv(*codes((np.arange(1024) / 1023) ** 2)), gamma_encoded(2)),
])  # fmt: skip
def test_profiles_follow_their_numbers(name, primaries, curve, encode, tmp_path):
    profile = icc(primaries, curve, name)
    follows(png(tmp_path / "a.png", codes(encode(in_space(LINEAR, primaries))), iCCP=iccp(profile)))
    # Linear 8-bit codes of dark colours are coarse.
    dark = codes(encode(in_space(BLOCKS, primaries)), 8)
    file = saved(tmp_path / "a.webp", dark, icc_profile=profile)
    np.testing.assert_allclose(linear(file), BLOCKS, rtol=0.03, atol=4e-3)


def test_channels_may_have_curves_of_their_own_and_grey_one(tmp_path):
    powers = np.array([461, 563, 461]) / 256
    profile = icc(SRGB, curv(461), gTRC=curv(563))
    follows(png(tmp_path / "a.png", codes(LINEAR ** (1 / powers)), iCCP=iccp(profile)))
    grey = icc(SRGB, curv(461), kTRC=curv(461)).replace(b"mntrRGB ", b"mntrGRAY")
    path = png(tmp_path / "b.png", codes(LINEAR[..., 0] ** (256 / 461)), iCCP=iccp(grey))
    follows(path, LINEAR[..., :1] * np.ones(3))


@pytest.mark.parametrize("damage", [
    {"rTRC": curv(3, 2, 1)}, {"gTRC": b"para\0\0\0\0\0\x09\0\0"}, {"bXYZ": bytes(20)},
    {"rTRC": para(0, -1.0)}, {"rTRC": b"curv\0\0\0\0\xff\xff\xff\xff"},
    {f"t{number:03}": b"any" for number in range(200)},
])  # fmt: skip
def test_damaged_profiles_are_reported(damage, tmp_path):
    profile = icc(P3, SRGB_PARA, **damage)
    reports(png(tmp_path / "a.png", PLAIN, iCCP=iccp(profile)), "taken as sRGB")


def frame(path: Path, size: tuple[int, int], **fields: object) -> Frame:
    return Frame(label="frame 0", image=path, to_world=np.eye(4), focal=(20.0, 20.0),
                 center=(size[0] / 2, size[1] / 2), size=size, **fields)  # fmt: skip


def loaded(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and clipped channels of a photograph that is used without an import."""
    pictures = open_photographs([path], [open_image(path).size])
    (photograph,), buffer = read_photographs(pictures, [Window.whole(pictures[0].size)], [1.0])
    return photograph.pixels, buffer.channels[0]


def test_large_chunks_are_not_read(tmp_path):
    path = png(tmp_path / "a.png", PLAIN, tEXt=bytes(2**24 + 1))
    assert peak_memory(lambda: open_image(path)) < 2**20


def test_import_and_direct_use_convert_alike(tmp_path):
    """Pixels with some clipped channels are unusable, those with all are bounds."""
    pixels = P3_CODES.copy()
    pixels[0, 0], pixels[0, 1, 0] = 65535, 65535
    path = png(tmp_path / "a.png", pixels, iCCP=iccp(P3_ICC))
    view = convert_photograph(frame(path, (10, 6)), tmp_path / "b.exr", (1.0, 1.0))
    made = np.stack([read_exr(tmp_path / "b.exr")[c] for c in "RGB"], axis=-1)
    direct, channels = loaded(path)
    assert made[0, 0].tolist() == [-2] * 3 and made[0, 1].tolist() == [-1] * 3
    assert channels[0, :3].tolist() == [7, 0, 0] and np.isnan(direct[0, :2]).all()
    for values in (made, direct):
        np.testing.assert_allclose(values[1:], LINEAR[1:], rtol=WITHIN)
    assert view.saturated == 2 and view.invalid == 0
    notes = photograph_notes([frame(path, (10, 6))], [view])
    assert any("converted to linear sRGB from Mine; colours outside" in n for n in notes)


def test_colours_outside_of_srgb_become_zero(tmp_path):
    file = exr(tmp_path / "a.exr", np.full((3, 4, 3), [0.0, 1.0, 0.0]), chromaticities=P3)
    red, green, blue = (plane[0, 0] for plane in open_image(file).planes())
    wanted = (np.linalg.inv(to_pcs(SRGB)) @ to_pcs(P3))[:, 1]
    assert red == 0 == blue and wanted[0] < 0 and green == pytest.approx(wanted[1], rel=1e-3)


@pytest.mark.parametrize("size, upright_sizes", [
    ((10, 6), False), ((6, 10), True), ((20, 12), False), ((5, 5), True),
])  # fmt: skip
def test_orientation_is_compared_with_the_camera(size, upright_sizes, tmp_path):
    path = saved(tmp_path / "a.png", codes(LINEAR, 8), exif=exif(orientation=6))
    half = saved(tmp_path / "b.png", codes(LINEAR, 8), exif=exif(orientation=3))
    both = _fitted_pictures([frame(path, size), frame(half, size)])
    assert [picture.upright for picture in both] == [upright_sizes] * 2
    made = frame(path, both[0].size, upright=upright_sizes)
    convert_photograph(made, tmp_path / "c.exr", (1.0, 1.0))
    assert read_exr(tmp_path / "c.exr")["R"].shape == ((10, 6) if upright_sizes else (6, 10))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientations_are_those_of_another_library(orientation, tmp_path):
    path = saved(tmp_path / "a.png", codes(LINEAR, 8), exif=exif(orientation=orientation))
    with Image.open(path) as image:
        wanted = np.array(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(np.stack(open_image(path).stored(), axis=-1), wanted)


def test_pictures_of_gltf_ignore_profiles_but_exr_textures_of_obj_are_read(tmp_path):
    uvs = np.array([[0.0, 0], [1, 0], [0, 1]])
    image = Image.fromarray(codes(P3_8, 8))
    image.info["icc_profile"] = P3_ICC
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    triangle = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False)
    triangle.visual = trimesh.visual.TextureVisuals(uvs, material=material)
    triangle.export(tmp_path / "mesh.glb")
    texture = read_textured_mesh(tmp_path / "mesh.glb").textures["base_color"]
    np.testing.assert_array_equal(texture, codes(P3_8, 8))
    exr(tmp_path / "base.exr", in_space(LINEAR, P3), chromaticities=P3)
    (tmp_path / "mesh.mtl").write_text("newmtl m\nmap_Kd base.exr\n")
    (tmp_path / "mesh.obj").write_text(
        "mtllib mesh.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\n"
        "f 1/1 2/2 3/3\n"
    )
    texture = read_textured_mesh(tmp_path / "mesh.obj").textures["base_color"]
    np.testing.assert_array_equal(texture, codes(srgb_encoded(LINEAR), 8))


def test_exposures_of_every_format_that_records_them(tmp_path):
    data = Image.Exif()
    data[0x8769] = {0x829A: 0.5, 0x829D: 2.0, 0x8827: 200}
    paths = [
        exr(tmp_path / "a.exr", LINEAR, expTime=0.25, aperture=2.0, isoSpeed=200.0),
        saved(tmp_path / "b.jpg", SRGB_8, exif=data), tmp_path / "c.heic",
    ]  # fmt: skip
    pillow_heif.from_pillow(Image.fromarray(SRGB_8)).save(paths[2], exif=data.tobytes())
    gains = [f.exposure for f in with_exif_gains([frame(path, (10, 6)) for path in paths])]
    assert gains == pytest.approx([0.5, 1.0, 1.0])  # relative to the median


def test_raw_photographs_beside_their_developed_copies_are_left_out(tmp_path):
    for name in ("b.nef", "b.JPG", "a.dng"):
        (tmp_path / name).touch()
    assert [p.name for p in match_photographs(tmp_path, ["x", "y"]).paths] == ["a.dng", "b.JPG"]


def test_missing_extras_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(image_header.importlib, "import_module", _absent)
    path = tmp_path / "a.heic"
    path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(12))
    with pytest.raises(CaptureError, match=r"a.heic: .* pillow-heif; .*svu_mi\[camera\]"):
        open_image(path)


def _absent(name: str) -> None:
    raise ImportError(name)


@pytest.mark.parametrize("start, name", [
    (b"\0\0\0\x1cftypmif1\0\0\0\0mif1avifmiaf", "AVIF"),
    (b"\0\0\0\x18ftypmif1\0\0\0\0mif1heic", "HEIC"), (b"\0\0\0\x18ftypisom\0\0\0\0mp41", None),
    (b"RIFF\0\0\0\0WAVE", None), (b"II+\0\x08\0\0\0", "TIFF"), (b"", None),
])  # fmt: skip
def test_formats_are_recognised_by_content(start, name, tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(start)
    assert recognition.format_of(path) == name


def test_values_for_hdr_screens_are_refused_in_every_format(tmp_path):
    file = saved(tmp_path / "a.avif", SRGB_8)
    data = file.read_bytes()
    at = data.index(b"colrnclx") + 8
    file.write_bytes(data[:at] + struct.pack(">HH", 9, 18) + data[at + 4 :])
    refuses(file, r"is encoded for HDR screens \(HLG\); export it as EXR")
