"""Readers of Radiance HDR and PFM images that check all bounds.

Mitsuba's HDR reader writes out of bounds on a damaged file.
HDR: Ward, "Real Pixels", Graphics Gems II, and https://radsite.lbl.gov/radiance/refer/filefmts.pdf.
PFM: https://www.pauldebevec.com/Research/HDR/PFM/.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

HEADER = 4096  # bytes; the header must be shorter
RUN = 128  # count bytes above it mean count - 128 repetitions, others a count of literal bytes
PACKED = range(8, 2**15)  # widths for which HDR uses run-length encoding


def hdr_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an HDR image."""
    with path.open("rb") as stream:
        return _hdr_header(stream.read(HEADER))[:2]


def pfm_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a PFM image."""
    with path.open("rb") as stream:
        width, height, channels, _, start = _pfm_header(stream.read(HEADER))
    if path.stat().st_size < start + 4 * width * height * channels:
        raise ValueError("the file ends too early")
    return width, height


def read_hdr(path: Path) -> np.ndarray:
    """Return radiance, (H, W, 3) float32; the header's ``EXPOSURE`` is ignored."""
    data = path.read_bytes()
    width, height, at = _hdr_header(data[:HEADER])
    if width in PACKED and data[at : at + 2] == b"\2\2":
        rows = np.frombuffer(_unpacked(data, at, width, height), np.uint8)
        rgbe = rows.reshape(height, 4, width).transpose(0, 2, 1)
    elif len(data) < at + 4 * width * height:
        raise ValueError("the file ends too early, or uses the old RLE encoding")
    else:
        rgbe = np.frombuffer(data, np.uint8, 4 * width * height, at).reshape(height, width, 4)
    # Exponent 0 means black for any mantissa.
    unit = np.where(rgbe[..., 3] == 0, 0, np.ldexp(np.float32(1), rgbe[..., 3].astype(int) - 136))
    return rgbe[..., :3] * unit[..., None].astype(np.float32)


def read_pfm(path: Path) -> np.ndarray:
    """Return (H, W, 3) or (H, W, 1) float32, multiplied by the header's scale."""
    data = path.read_bytes()
    width, height, channels, scale, start = _pfm_header(data[:HEADER])
    order = "<f4" if scale < 0 else ">f4"
    values = np.frombuffer(data, order, width * height * channels, start).astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite pixels are allowed
        values *= np.float32(abs(scale))
    return values.reshape(height, width, channels)[::-1]


def _hdr_header(start: bytes) -> tuple[int, int, int]:
    """Return width, height, and the offset of the pixels in bytes."""
    head = re.search(rb"\n\n-Y (\d{1,6}) \+X (\d{1,6})\n", start)
    if not start.startswith(b"#?") or head is None or b"_xyze" in start[: head.start()]:
        raise ValueError("not the header of an RGBE (Radiance HDR) image")
    return int(head[2]), int(head[1]), head.end()


def _pfm_header(start: bytes) -> tuple[int, int, int, float, int]:
    """Return width, height, channels, scale, and offset of pixels in bytes."""
    head = re.match(rb"P([Ff])\s+(\d{1,6})\s+(\d{1,6})\s+(-?[\d.]{1,20}(?:e[+-]?\d\d?)?)\s", start)
    if head is None:
        raise ValueError("not the header of a PFM image")
    channels = 3 if head[1] == b"F" else 1
    return int(head[2]), int(head[3]), channels, float(head[4]), head.end()


def _unpacked(data: bytes, at: int, width: int, height: int) -> bytes:
    """Decode a run-length encoded HDR image to bytes (height, 4, width)."""
    head = bytes((2, 2, width >> 8, width & 255))
    rows: list[bytes] = []
    for _ in range(height):
        if data[at : at + 4] != head:
            raise ValueError("a row is damaged")
        row, at = _row(data, at + 4, 4 * width)
        rows.append(row)
    return b"".join(rows)


def _row(data: bytes, at: int, size: int) -> tuple[bytes, int]:
    """Decode one row of ``size`` bytes; return it and the offset of the next row."""
    parts, room = [], size
    while room > 0:
        count = data[at] if at < len(data) else 0
        if count > RUN:
            count -= RUN
            part, at = data[at + 1 : at + 2] * count, at + 2
        else:
            part, at = data[at + 1 : at + 1 + count], at + 1 + count
        room -= count
        if not part or len(part) != count or room < 0:
            raise ValueError("a row is damaged")
        parts.append(part)
    return b"".join(parts), at
