"""Picture files: their size without reading them, and their channels as linear values."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import mitsuba as mi
import numpy as np

from svu_mi.errors import CaptureError
from svu_mi.exr import exr_size, read_exr

SUFFIXES = (".exr", ".hdr", ".pfm", ".png", ".jpg", ".jpeg")
MAX_PIXELS = 2**28  # 16384 x 16384; a damaged header may promise any number
ORIENTATION = 0x0112  # tag of EXIF
LONGEST = 200  # letters of a list of channels, in a message
HEADER = 4096  # bytes of an HDR or PFM file that its size must stand in

Transfer = Literal["srgb", "gamma 2.2", "linear"]


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a picture from its header.

    Raises:
        CaptureError: the file is missing, no picture of a known kind, or absurdly large.
    """
    if not path.is_file():
        raise CaptureError(f"{path}: no such photograph.")
    suffix = path.suffix.lower()
    if suffix == ".exr":
        size = exr_size(path)
    elif suffix in (".hdr", ".pfm"):
        size = _float_size(path)
    elif suffix in SUFFIXES:
        size = _integer_size(path)
    else:
        raise CaptureError(f"{path}: not a kind of picture known here ({', '.join(SUFFIXES)}).")
    if min(size) < 1 or size[0] * size[1] > MAX_PIXELS:
        raise CaptureError(
            f"{path}: {size[0]} x {size[1]} pixels are too many, or the file is damaged."
        )
    return size


def is_turned(path: Path) -> bool:
    """Return whether EXIF data say that a picture is to be shown turned or mirrored.

    Nothing here does that: pixels are those that are stored.

    Raises:
        CaptureError: the file is damaged.
    """
    from PIL import Image

    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        return False
    try:
        with Image.open(path) as image:
            return int(image.getexif().get(ORIENTATION, 1)) > 1
    except Exception as error:  # whatever its parsers meet
        raise CaptureError(f"{path}: not a readable image; write it again as EXR.") from error


def read_planes(path: Path) -> tuple[list[np.ndarray], bool]:
    """Read a picture as stored.

    Returns:
        Three or four float32 planes (H, W), red, green, blue and, if there is one, alpha; and
        whether the file holds integers, which are scaled to [0, 1] and still encoded.

    Raises:
        CaptureError: as ``image_size``, or the file is damaged or lacks a channel.
    """
    image_size(path)
    if path.suffix.lower() == ".exr":
        return _exr_planes(path), False
    try:
        values = np.array(mi.Bitmap(str(path)))
    except Exception as error:  # Mitsuba raises RuntimeError for everything
        raise CaptureError(f"{path}: not a readable image; write it again as EXR.") from error
    values = values[..., None] if values.ndim == 2 else values
    low_range = np.issubdtype(values.dtype, np.integer)
    scale = np.float32(np.iinfo(values.dtype).max if low_range else 1)
    planes = [values[..., k].astype(np.float32) / scale for k in range(values.shape[2])]
    return planes if len(planes) >= 3 else planes[:1] * 3 + planes[1:], low_range


def decoded(encoded: np.ndarray, transfer: Transfer = "srgb") -> np.ndarray:
    """Return linear values (float32) of encoded ones in [0, 1].

    Args:
        encoded: any shape.
        transfer: ``srgb`` (IEC 61966-2-1), ``gamma 2.2`` or ``linear``.
    """
    if transfer == "linear":
        return np.asarray(encoded, np.float32)
    if transfer == "gamma 2.2":
        return np.asarray(encoded ** np.float32(2.2), np.float32)
    low = encoded / 12.92
    high = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in [0, 1] with the sRGB transfer function (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _exr_planes(path: Path) -> list[np.ndarray]:
    channels = _of_one_layer(read_exr(path))
    grey = channels.get("Y")
    found = [channels.get(name, grey) for name in "RGB"]
    planes = [plane for plane in found if plane is not None]
    if len(planes) < 3:
        raise CaptureError(
            f"{path}: expected the channels R, G, B (or Y), found "
            f"{', '.join(channels)[:LONGEST]}; export it as plain RGB or RGBA."
        )
    return planes + ([channels["A"]] if "A" in channels else [])


def _of_one_layer(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return channels without a layer; else those of the only layer of colours, or Blender's."""
    if "R" in channels or "Y" in channels:
        return channels
    layers = [name.removesuffix("R") for name in channels if name.endswith(".R")]
    whole = [layer for layer in layers if layer.endswith("Combined.")]  # of all its passes
    for found in (layers, whole):
        if len(found) == 1:
            return {
                name.removeprefix(found[0]): plane
                for name, plane in channels.items() if name.startswith(found[0])
            }  # fmt: skip
    return channels


def _integer_size(path: Path) -> tuple[int, int]:
    from PIL import Image

    try:
        with Image.open(path) as image:  # reads the header only
            return image.size
    except Exception as error:  # whatever its parsers meet
        raise CaptureError(f"{path}: not a readable image; write it again as EXR.") from error


def _float_size(path: Path) -> tuple[int, int]:
    with path.open("rb") as stream:
        start = stream.read(HEADER)
    found = re.search(rb"-Y (\d{1,6}) \+X (\d{1,6})\s", start)
    if found is not None:
        return int(found[2]), int(found[1])
    found = re.match(rb"P[Ff]\s(\d{1,6})\s(\d{1,6})\s", start)
    if found is None:
        raise CaptureError(f"{path}: not a readable image; write it again as EXR.")
    return int(found[1]), int(found[2])
