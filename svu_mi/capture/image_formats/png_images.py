"""PNG images: header chunks (https://www.w3.org/TR/png-3/), and pixels by Mitsuba."""

import io
import struct
import zlib
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from svu_mi.capture.image_formats import color_space
from svu_mi.capture.image_formats.icc_profile import LARGEST, not_followed, read_profile
from svu_mi.capture.image_formats.image_header import ORIENTATION, ImageHeader
from svu_mi.capture.tone_curve import SampledCurve, Transfer

SIGNATURE = b"\x89PNG\r\n\x1a\n"
CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type
UNIT = 100_000  # of gamma and chromaticities
# libpng, too, takes 1 / 2.2 for sRGB, which most writers of this value mean.
SRGB_GAMMA = range(45_000, 46_000)
WHITE_FIRST = (2, 3, 4, 5, 6, 7, 0, 1)  # order of cHRM: white, red, green, blue


def open_png(path: Path) -> ImageHeader:
    """Read the chunks of a PNG before its pixels."""
    chunks = _chunks(path)
    width, height, bits, kind = struct.unpack_from(">IIBB", chunks[b"IHDR"])
    color, remarks = color_space.ColorSpace(), []
    try:
        color = _color_space(chunks)
    except (ValueError, struct.error, zlib.error) as error:
        reason = error if isinstance(error, ValueError) else "it is damaged"
        remarks.append(not_followed(reason))
    return ImageHeader(
        size=(width, height), bits=16 if bits == 16 else 8, channels=CHANNELS[kind], color=color,
        orientation=_orientation(chunks.get(b"eXIf")), remarks=tuple(remarks),
    )  # fmt: skip


def read_png(path: Path, _: ImageHeader) -> np.ndarray:
    """Return (H, W) or (H, W, C) uint8 or uint16."""
    return np.array(mi.Bitmap(str(path)))  # Pillow does not support 16-bit colours


def _chunks(path: Path) -> dict[bytes, bytes]:
    """Return the first of each kind of chunk; an image's chunks of pixels are skipped."""
    chunks: dict[bytes, bytes] = {}
    with path.open("rb") as stream:
        stream.seek(len(SIGNATURE))
        while len(head := stream.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            if name in (b"IDAT", b"IEND") or length > LARGEST:
                stream.seek(length + 4, io.SEEK_CUR)
                continue
            chunks.setdefault(name, stream.read(length))
            stream.seek(4, io.SEEK_CUR)
    return chunks


def _color_space(chunks: dict[bytes, bytes]) -> color_space.ColorSpace:
    """Return the colour space by the first of cICP, iCCP, sRGB, gAMA and cHRM."""
    if b"cICP" in chunks:
        primaries, transfer, matrix, whole = chunks[b"cICP"][:4]
        return color_space.from_cicp(primaries, transfer, matrix, whole)
    if b"iCCP" in chunks:
        packed = chunks[b"iCCP"].partition(b"\0")[2][1:]
        return read_profile(zlib.decompressobj().decompress(packed, LARGEST))
    if b"sRGB" in chunks:
        return color_space.ColorSpace()
    curve: Transfer | SampledCurve = "srgb"
    if b"gAMA" in chunks:
        (gamma,) = struct.unpack(">I", chunks[b"gAMA"])
        curve = "srgb" if gamma in SRGB_GAMMA else color_space.gamma_curve(UNIT / max(gamma, 1))
    given = color_space.REC_709
    if b"cHRM" in chunks:
        numbers = struct.unpack(">8I", chunks[b"cHRM"])
        given = tuple(numbers[k] / UNIT for k in WHITE_FIRST)
    return color_space.from_chromaticities(given, curve)


def _orientation(exif: bytes | None) -> int:
    if exif is None:
        return 1
    tags = Image.Exif()
    tags.load(exif)
    return int(tags.get(ORIENTATION, 1))
