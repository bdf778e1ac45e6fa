"""Recognition of image formats by content, and their readers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from svu_mi.capture.image_formats.exr_images import open_exr, read_exr_image
from svu_mi.capture.image_formats.heif_images import open_avif, open_heic, read_avif, read_heic
from svu_mi.capture.image_formats.image_header import ImageHeader
from svu_mi.capture.image_formats.oiio_images import open_with_oiio, read_with_oiio
from svu_mi.capture.image_formats.png_images import SIGNATURE, open_png, read_png
from svu_mi.capture.image_formats.raw_images import open_raw, read_raw


@dataclass(frozen=True)
class ImageFormat:
    """One format.

    Attributes:
        suffixes: usual suffixes, in lower case.
        open: reads the header.
        read: reads the pixels as stored: (H, W), (H, W, C), or C planes (H, W).
    """

    suffixes: tuple[str, ...]
    open: Callable[[Path], ImageHeader]
    read: Callable[[Path, ImageHeader], np.ndarray | list[np.ndarray]]


FORMATS: Mapping[str, ImageFormat] = {
    "EXR": ImageFormat((".exr",), open_exr, read_exr_image),
    "HDR": ImageFormat((".hdr",), open_with_oiio, read_with_oiio),
    "PFM": ImageFormat((".pfm",), open_with_oiio, read_with_oiio),
    "PNG": ImageFormat((".png",), open_png, read_png),
    "JPEG": ImageFormat((".jpg", ".jpeg"), open_with_oiio, read_with_oiio),
    "TIFF": ImageFormat((".tif", ".tiff"), open_with_oiio, read_with_oiio),
    "WebP": ImageFormat((".webp",), open_with_oiio, read_with_oiio),
    "JPEG XL": ImageFormat((".jxl",), open_with_oiio, read_with_oiio),
    "AVIF": ImageFormat((".avif",), open_avif, read_avif),
    "HEIC": ImageFormat((".heic", ".heif", ".hif"), open_heic, read_heic),
    "RAW": ImageFormat((
        ".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".3fr",
        ".crw",
    ), open_raw, read_raw),
}  # fmt: skip
SUFFIXES = tuple(suffix for kind in FORMATS.values() for suffix in kind.suffixes)

RAW = FORMATS["RAW"].suffixes

STARTS = {
    b"\x76\x2f\x31\x01": "EXR", b"#?": "HDR", b"PF\n": "PFM", b"Pf\n": "PFM", b"PF ": "PFM",
    b"Pf ": "PFM", SIGNATURE: "PNG", b"\xff\xd8\xff": "JPEG", b"II*\0": "TIFF", b"MM\0*": "TIFF",
    b"II+\0": "TIFF", b"MM\0+": "TIFF", b"\xff\x0a": "JPEG XL",
    b"\0\0\0\x0cJXL \r\n\x87\n": "JPEG XL",
}  # fmt: skip
# Brands of ISO media files; AVIF first, because both may also have general brands.
BRANDS = {"AVIF": {b"avif", b"avis"}, "HEIC": {b"heic", b"heix", b"hevc", b"mif1"}}


def format_of(path: Path) -> str | None:
    """Return the name of a file's format by its content; None if it is none of these.

    RAW files are recognised by their suffix, because many are TIFF inside.
    """
    if path.suffix.lower() in RAW:
        return "RAW"
    with path.open("rb") as stream:
        start = stream.read(64)
    for magic, name in STARTS.items():
        if start.startswith(magic):
            return name
    if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
        return "WebP"
    if start[4:8] == b"ftyp":
        brands = {start[k : k + 4] for k in range(8, min(start[3], len(start)), 4)}
        return next((name for name, known in BRANDS.items() if known & brands), None)
    return None


def without_raw_doubles(paths: Sequence[Path]) -> list[Path]:
    """Return the files without RAW photographs that are there in another format, too.

    Cameras store both, and poses were computed from the other.
    """
    developed = {path.stem for path in paths if path.suffix.lower() not in RAW}
    return [p for p in paths if p.suffix.lower() not in RAW or p.stem not in developed]
