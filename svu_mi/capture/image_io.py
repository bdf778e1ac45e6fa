"""Image files: headers, stored channels, and the sRGB transfer function."""

from __future__ import annotations

import contextlib
import struct
import threading
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from svu_mi.capture.hdr_pfm import hdr_size, pfm_size, read_hdr, read_pfm
from svu_mi.core.io.exr import Header, read_header, read_pixels
from svu_mi.core.io.files import may_hold
from svu_mi.errors import CaptureError, SvuError, excerpt

FLOATS = {".hdr": (hdr_size, read_hdr), ".pfm": (pfm_size, read_pfm)}  # in addition to EXR
SUFFIXES = (".exr", ".hdr", ".pfm", ".png", ".jpg", ".jpeg")
MAX_PIXELS = 2**28  # 16384 x 16384; a damaged header may contain any number
LOST = 0.01  # largest tolerated sum of negative pixels, as a fraction of the image's sum
ORIENTATION = 0x0112  # EXIF tag
PNG = b"\x89PNG\r\n\x1a\n"  # signature
HAS_EXIF = (b"eXIf", b"Raw profile type")  # PNG files without either have no EXIF data
PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type

OTHER_COLORS = {("X", "Y", "Z"): "CIE XYZ", ("Y", "RY", "BY"): "luminance and chroma"}

_opening = threading.Lock()  # warnings.catch_warnings is not thread-safe

Transfer = Literal["srgb", "gamma 2.2", "linear"]


@dataclass(frozen=True)
class ImageFile:
    """An image file with its header.

    Attributes:
        path: Path of the file.
        header: Size of the image; for EXR, also the attributes in the file.
        bits: 8 or 16 for integer (low dynamic range) files, 0 for floating point.
    """

    path: Path
    header: Header
    bits: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.header.size

    def planes(self) -> list[np.ndarray]:
        """Read the pixels as stored.

        Returns:
            Float32 planes (H, W): red, green, blue, and alpha if present. Integers are scaled
            to [0, 1] but not decoded.
        """
        return [self.scaled(plane) if self.bits else plane for plane in self.stored()]

    def stored(self) -> list[np.ndarray]:
        """Read the pixels like ``planes``, but without conversion of integers."""
        suffix = self.path.suffix.lower()
        with _readable(self.path):
            if suffix == ".exr":
                return _exr_planes(self.path, read_pixels(self.path, self.header))
            _, read = FLOATS.get(suffix, (None, _integers))
            values = read(self.path)
        planes = [values[..., k] for k in range(values.shape[2])]
        return planes if len(planes) >= 3 else planes[:1] * 3 + planes[1:]

    def scaled(self, codes: np.ndarray) -> np.ndarray:
        """Return integers as float32 in [0, 1]."""
        return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)

    def is_turned(self) -> bool:
        """Return whether EXIF data request a rotation or mirroring for display.

        The orientation is not applied: all functions return pixels as stored.
        """
        if not self.bits:
            return False
        with _readable(self.path):
            if _is_png(self.path) and not any(w in self.path.read_bytes() for w in HAS_EXIF):
                return False  # avoids Pillow, which would decode all pixels
            with Image.open(self.path) as image:
                return int(image.getexif().get(ORIENTATION, 1)) > 1

    def remarks(self) -> list[str]:
        """Return messages about ignored metadata, without the name of the file."""
        clauses = []
        if self.header.foreign:
            clauses.append(
                "its chromaticities are not Rec. 709; values are used without conversion. Convert "
                "the file if colours matter."
            )
        if self.is_turned():
            clauses.append(
                "is stored rotated; the EXIF orientation is ignored, because poses must refer to "
                "the pixels as stored."
            )
        return clauses


def open_image(path: Path) -> ImageFile:
    """Read the header of an image file; raise if it is not readable."""
    if not path.is_file():
        raise CaptureError(f"{path}: no such photograph.")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise CaptureError(f"{path}: not a supported image format ({', '.join(SUFFIXES)}).")
    bits = 0
    with _readable(path):
        if suffix == ".exr":
            header = read_header(path)
        elif suffix in FLOATS:
            header = Header(FLOATS[suffix][0](path))
        else:
            header, bits = _integer_header(path)
    width, height = header.size
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise CaptureError(
            f"{path}: the image is too large ({width} x {height} pixels) or damaged; export it "
            "again."
        )
    return ImageFile(path, header, bits)


def read_planes(path: Path) -> tuple[list[np.ndarray], bool]:
    """Return ``ImageFile.planes``, and True if the file stores integers."""
    picture = open_image(path)
    return picture.planes(), picture.bits > 0


def decoded(encoded: np.ndarray, transfer: Transfer = "srgb") -> np.ndarray:
    """Decode values in [0, 1] to linear float32."""
    if transfer == "srgb":
        low, high = encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4
        return np.where(encoded <= 0.04045, low, high).astype(np.float32)
    power = 1 if transfer == "linear" else np.float32(2.2)
    return np.asarray(encoded**power, np.float32)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in [0, 1] as sRGB (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def quantized(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Round values in [0, 1] to unsigned integers of 8 or 16 bits."""
    most = 2**bits - 1
    return (np.clip(image, 0, 1) * most + 0.5).astype(np.uint8 if bits == 8 else np.uint16)


def _exr_planes(path: Path, channels: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Return R, G, B, and alpha if present, from the channels of an EXR."""
    channels = _layer_channels(channels)
    for names, space in OTHER_COLORS.items():
        if channels.keys() >= set(names) and not channels.keys() >= set("RGB"):
            raise CaptureError(
                f"{path}: contains {space} ({', '.join(names)}) instead of RGB; export it as "
                "plain RGB."
            )
    grey = channels.get("Y")
    colors = [channels.get(name, grey) for name in "RGB"]
    planes = [plane for plane in colors if plane is not None]
    if len(planes) < 3:
        raise CaptureError(
            f"{path}: expected the channels R, G, B (or Y) in its first part, found "
            f"{excerpt(', '.join(channels))}; export it as plain RGB or RGBA."
        )
    return planes + ([channels["A"]] if "A" in channels else [])


def _layer_channels(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the channels without a layer, else those of the only or the "Combined" layer."""
    if "R" in channels or "Y" in channels:
        return channels
    layers = [name.removesuffix("R") for name in channels if name.endswith(".R")]
    whole = [layer for layer in layers if layer.endswith("Combined.")]  # Blender's final image
    for prefixes in (layers, whole):
        if len(prefixes) == 1:
            return {
                name.removeprefix(prefixes[0]): plane
                for name, plane in channels.items() if name.startswith(prefixes[0])
            }  # fmt: skip
    return channels


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn any decoder error into a ``CaptureError`` with the path."""
    try:
        yield
    except CaptureError:
        raise
    except Exception as error:  # decoders raise many types
        raise CaptureError(f"{path}: not a readable image; save it again as EXR.") from error


def _integer_header(path: Path) -> tuple[Header, int]:
    """Return header and bit depth of a PNG or JPEG file; its suffix is ignored."""
    bits = 8
    if _is_png(path):
        with path.open("rb") as stream:
            *size, bits, kind = struct.unpack(">16xIIBB", stream.read(26))
        pixel = PNG_CHANNELS[kind] * max(1, bits // 8)
    else:
        with _jpeg(path) as image:
            size, pixel = list(image.size), len(image.getbands())
    if not may_hold(path, size[0] * size[1] * pixel):
        raise CaptureError(
            f"{path}: the header declares {size[0]} x {size[1]} pixels, more than the file can "
            "hold; export it again."
        )
    return Header((size[0], size[1])), 16 if bits == 16 else 8


def _integers(path: Path) -> np.ndarray:
    """Return (H, W, C) 8- or 16-bit integers."""
    if _is_png(path):
        values = np.array(mi.Bitmap(str(path)))  # Pillow does not support 16-bit colours
    else:
        with _jpeg(path) as image:  # Mitsuba's reader prints to the console on damaged files
            if image.mode == "CMYK":
                raise CaptureError(f"{path}: the image is in CMYK; export it as sRGB.")
            values = np.array(image if image.mode in ("L", "RGB") else image.convert("RGB"))
    return values[..., None] if values.ndim == 2 else values


def _is_png(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(PNG)) == PNG


def _jpeg(path: Path) -> Any:
    """Open a JPEG file without ``Image.open``, which tries other formats."""
    with _opening, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about damaged EXIF data, which is not used
        return JpegImageFile(path)


def clamp_negative(
    pixels: np.ndarray, label: str, error: type[SvuError] = CaptureError
) -> tuple[np.ndarray, list[str]]:
    """Set negative pixels, which filters and colour conversions cause, to 0.

    Returns:
        The pixels, and a list with a warning if some were negative.

    Raises:
        SvuError: Type ``error``, if negative pixels reduce the sum by more than 1 %.
    """
    below = pixels < 0
    if not below.any():
        return pixels, []
    count = int(below.any(axis=-1).sum())
    kept = np.where(below, 0, pixels)
    if np.abs(pixels[below]).sum(dtype=np.float64) > LOST * kept.sum(dtype=np.float64):
        raise error(
            f"{label}: {count} pixels are negative and cancel more than {LOST:.0%} of the light; "
            "export the map again."
        )
    return kept, [f"{label}: {count} negative pixels were set to 0."]
