"""AVIF images, read by Pillow, and HEIC images, read by pillow-heif."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from svu_mi.capture.image_formats.color_space import ColorSpace, from_cicp
from svu_mi.capture.image_formats.icc_profile import not_followed, read_profile
from svu_mi.capture.image_formats.image_header import (
    ORIENTATION,
    ImageHeader,
    required,
    without_warnings,
)

HEADER = 2**16  # bytes at the start that contain the properties


def open_avif(path: Path) -> ImageHeader:
    """Read the header of an AVIF image, of which Pillow returns 8 bits."""
    with _avif(path) as image:
        info, size, channels = image.info, image.size, len(image.getbands())
        orientation = int(image.getexif().get(ORIENTATION, 1))
    with path.open("rb") as stream:
        start = stream.read(HEADER)
    at = start.find(b"colrnclx")  # the property that Pillow does not return
    points = struct.unpack_from(">HH", start, at + 8) if at > 0 else None
    return _header(size, 8, channels, orientation, info.get("icc_profile"), points)


def read_avif(path: Path, _: ImageHeader) -> np.ndarray:
    """Return (H, W) or (H, W, C) uint8."""
    with _avif(path) as image:
        return np.array(image)


def open_heic(path: Path) -> ImageHeader:
    """Read the header of a HEIC image; libheif turns its pixels upright."""
    image = _heic(path)
    points = image.info.get("nclx_profile")
    return _header(
        image.size, 16 if ";16" in image.mode else 8, 4, 1, image.info.get("icc_profile"),
        points and (points["color_primaries"], points["transfer_characteristics"]),
    )  # fmt: skip


def read_heic(path: Path, _: ImageHeader) -> np.ndarray:
    """Return (H, W) or (H, W, C) uint8 or uint16."""
    return np.array(_heic(path))


def _header(
    size: tuple[int, int], bits: int, channels: int, orientation: int, profile: bytes | None,
    points: tuple[int, int] | None,
) -> ImageHeader:  # fmt: skip
    color, remarks = ColorSpace(), []
    try:
        if profile:
            color = read_profile(profile)
        elif points is not None:
            color = from_cicp(*points)
    except ValueError as error:
        remarks.append(not_followed(error, profile))
    return ImageHeader(
        size=size, bits=bits, channels=channels, color=color, orientation=orientation,
        remarks=tuple(remarks),
    )  # fmt: skip


def _avif(path: Path) -> Any:
    with without_warnings():
        return Image.open(path, formats=["AVIF"])


def _heic(path: Path) -> Any:
    heif = required("pillow_heif", path)
    return heif.open_heif(path, convert_hdr_to_8bit=False)
