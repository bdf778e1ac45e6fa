"""JPEG, TIFF, WebP, JPEG XL, HDR and PFM images, read by OpenImageIO."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from PIL import Image, TiffImagePlugin

from svu_mi.capture.image_formats import color_space
from svu_mi.capture.image_formats.icc_profile import not_followed, read_profile
from svu_mi.capture.image_formats.image_header import ImageHeader, without_warnings
from svu_mi.errors import CaptureError

HEADER = 4096  # bytes; the text of an HDR header must be shorter
UNCALIBRATED = (2, 65535)  # EXIF values of "not sRGB"
INTEROPERABILITY, ADOBE_RGB = 0xA005, "R03"  # EXIF 2.32, "DCF optional file"
RGB_OR_GREY = (0, 1, 2, 3, 6)  # photometric interpretations of TIFF that OpenImageIO converts
TRANSFER_FUNCTION, WHITE_POINT, CHROMATICITIES = 301, 318, 319  # tags of TIFF 6.0
BITS = {"uint8": 8, "uint16": 16, "uint": 16}  # by type in the file; others are read as float
TYPE_OF = {8: "uint8", 16: "uint16", 0: "float"}


def open_with_oiio(path: Path) -> ImageHeader:
    """Read the header of an image that OpenImageIO supports, without its pixels."""
    picture, spec = _opened(path)
    picture.close()
    kind = picture.format_name()
    if (
        spec.get_string_attribute(f"{kind}:ColorSpace") == "CMYK"
        or spec.get_int_attribute("tiff:PhotometricInterpretation", 2) not in RGB_OR_GREY
    ):
        raise CaptureError(f"{path}: the image is in CMYK or Lab; export it as sRGB.")
    bits = BITS.get(str(spec.format), 0)
    color, remarks = color_space.ColorSpace(), list(_remarks(path, spec, kind))
    try:
        color = _hdr_color(path) if kind == "hdr" else _color_space(path, spec, bits)
    except ValueError as error:
        remarks.append(not_followed(error, spec.getattribute("ICCProfile")))
    if not bits and color.transfer not in ("srgb", "linear"):
        raise CaptureError(
            f"{path}: has floating-point values with a tone curve; export linear values."
        )
    # libjxl turns pixels itself.
    orientation = 1 if kind == "jpegxl" else spec.get_int_attribute("Orientation", 1)
    return ImageHeader(
        size=(spec.width, spec.height), bits=bits, channels=spec.nchannels, color=color,
        orientation=orientation, remarks=tuple(remarks),
    )  # fmt: skip


def read_with_oiio(path: Path, header: ImageHeader) -> np.ndarray:
    """Return (H, W, C) uint8, uint16 or float32."""
    picture, spec = _opened(path)
    channels = min(spec.nchannels, 4)
    values = picture.read_image(0, 0, 0, channels, TYPE_OF[header.bits])
    # Files that end early have an error and grey pixels.
    reason = picture.geterror()
    picture.close()
    if values is None or (reason and "extraneous bytes" not in reason):
        raise ValueError(reason or "no pixels")
    if _is_premultiplied(spec, picture.format_name()):
        alpha = values[..., -1]
        alpha[alpha < np.iinfo(alpha.dtype).max] = 0
    return values


def _opened(path: Path) -> tuple[Any, Any]:
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # returns values as stored
    picture = oiio.ImageInput.open(str(path), config)
    if picture is None:
        raise ValueError(oiio.geterror())
    spec = picture.spec()
    if spec.depth > 1 or spec.deep:
        raise CaptureError(f"{path}: has several layers of depth; export it as a flat image.")
    return picture, spec


def _is_premultiplied(spec: Any, kind: str) -> bool:
    """Return whether integer colours are multiplied by alpha."""
    straight = spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
    return kind == "tiff" and spec.alpha_channel >= 0 and not straight and str(spec.format) in BITS


def _remarks(path: Path, spec: Any, kind: str) -> Iterator[str]:
    if _is_premultiplied(spec, kind):
        yield "alpha is premultiplied; only opaque pixels count as the object."
    if spec.get_int_attribute("oiio:Movie", 0):
        yield "animated; the first image is used."
    if kind == "hdr" and b"\nPIXASPECT=" in _hdr_text(path):
        yield "PIXASPECT in the header is ignored; resample the image to square pixels."
    if kind == "tiff":
        tags = _tiff_tags(path)
        if tags.next:
            yield "several pages; the first is used."
        if TRANSFER_FUNCTION in tags and spec.getattribute("ICCProfile") is None:
            yield "the TransferFunction tag is ignored; embed an ICC profile instead."


def _color_space(path: Path, spec: Any, bits: int) -> color_space.ColorSpace:
    """Return the colour space of an image by its CICP, ICC profile, TIFF tags or EXIF data."""
    points, profile = spec.getattribute("CICP"), spec.getattribute("ICCProfile")
    if points is not None:
        return color_space.from_cicp(*map(int, points))
    if profile is not None:
        return read_profile(bytes(bytearray(profile)))
    if spec.getattribute("tiff:PhotometricInterpretation") is not None:
        tags = _tiff_tags(path)
        if CHROMATICITIES in tags and WHITE_POINT in tags:
            given = [float(value) for tag in (CHROMATICITIES, WHITE_POINT) for value in tags[tag]]
            return color_space.from_chromaticities(given, "srgb" if bits else "linear")
    elif spec.get_int_attribute("Exif:ColorSpace", 1) in UNCALIBRATED:
        with without_warnings(), Image.open(path) as image:
            named = image.getexif().get_ifd(INTEROPERABILITY).get(1)
        if named == ADOBE_RGB:
            curve = color_space.gamma_curve(563 / 256)
            primaries = color_space.PRIMARIES["Adobe RGB"]
            return color_space.from_primaries(primaries, "Adobe RGB", curve)
    return color_space.ColorSpace()


def _tiff_tags(path: Path) -> Any:
    """Return the tags of the first page; OpenImageIO omits some."""
    with path.open("rb") as stream, without_warnings():
        tags = TiffImagePlugin.ImageFileDirectory_v2(stream.read(8))
        stream.seek(tags.next)
        tags.load(stream)
    return tags


def _hdr_text(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(HEADER).partition(b"\n\n")[0]


def _hdr_color(path: Path) -> color_space.ColorSpace:
    """Return the conversion by EXPOSURE, COLORCORR and PRIMARIES of an HDR header.

    Values were multiplied by all EXPOSURE and COLORCORR
    (https://radsite.lbl.gov/radiance/refer/filefmts.pdf).
    """
    text = _hdr_text(path).decode("latin-1")
    if "_xyze" in text:
        raise CaptureError(f"{path}: contains CIE XYZ instead of RGB; export it as plain RGB.")
    gain = np.ones(3)
    for numbers in re.findall(r"^(?:EXPOSURE|COLORCORR)=(.*)$", text, re.MULTILINE):
        gain = gain * np.array([float(number) for number in numbers.split()])
    if not ((gain > 0) & (gain < np.inf)).all() or gain.shape != (3,):
        raise ValueError("its EXPOSURE or COLORCORR is not a positive number")
    given = re.findall(r"^PRIMARIES=(.*)$", text, re.MULTILINE)
    color = color_space.ColorSpace(transfer="linear")
    if given:
        color = color_space.from_chromaticities([float(number) for number in given[-1].split()])
    if (gain == 1).all():
        return color
    matrix = np.eye(3) if color.matrix is None else color.matrix
    name = " and ".join(filter(None, ["the EXPOSURE in the header", color.name]))
    return color_space.ColorSpace(name, "linear", matrix / gain)
