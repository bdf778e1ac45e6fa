"""Small image files of colours that are known in linear sRGB, written byte by byte where needed."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
from PIL import Image

# x, y of red, green, blue and white, as published.
SRGB = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
P3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290)
ADOBE = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
PROPHOTO = (0.7347, 0.2653, 0.1596, 0.8404, 0.0366, 0.0001, 0.3457, 0.3585)
REC_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
ACESCG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
D50 = np.array([0.9642, 1.0, 0.8249])
CONE = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

Encode = Callable[[np.ndarray], np.ndarray]


def linear_colors(height: int = 6, width: int = 10) -> np.ndarray:
    """Colours in linear sRGB that fit every space above, without clipped ones; not square."""
    return np.random.default_rng(40817).uniform(0.04, 0.6, (height, width, 3))


def to_pcs(xy: Sequence[float]) -> np.ndarray:
    """Matrix from linear RGB to XYZ that is adapted to D50 (Bradford)."""
    columns = [np.array([x, y, 1 - x - y]) / y for x, y in zip(xy[::2], xy[1::2], strict=True)]
    *rgb, white = columns
    primaries = np.stack(rgb, axis=1)
    matrix = primaries * np.linalg.solve(primaries, white)
    return np.linalg.inv(CONE) @ np.diag((CONE @ D50) / (CONE @ white)) @ CONE @ matrix


def in_space(linear: np.ndarray, xy: Sequence[float]) -> np.ndarray:
    """Convert linear sRGB to linear values of other primaries."""
    return linear @ (np.linalg.inv(to_pcs(xy)) @ to_pcs(SRGB)).T


def srgb_encoded(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def gamma_encoded(power: float) -> Encode:
    return lambda x: np.maximum(x, 0) ** (1 / power)


def codes(encoded: np.ndarray, bits: int = 16) -> np.ndarray:
    return np.round(encoded * (2**bits - 1)).astype(f"u{bits // 8}")


def _fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))


def para(kind: int, *values: float) -> bytes:
    """A parametric curve of an ICC profile."""
    return b"para\0\0\0\0" + struct.pack(">HH", kind, 0) + _fixed(*values)


SRGB_PARA = para(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


def curv(*values: int) -> bytes:
    """A curve of an ICC profile: none (linear), a gamma times 256, or samples."""
    return b"curv\0\0\0\0" + struct.pack(f">I{len(values)}H", len(values), *values)


def icc(xy: Sequence[float], curve: bytes, name: str = "Mine", **changes: bytes) -> bytes:
    """An ICC profile with a matrix; ``changes`` replace or add tags, empty ones remove."""
    xyz = to_pcs(xy)
    tags = {
        "desc": b"desc\0\0\0\0" + struct.pack(">I", len(name) + 1) + name.encode() + bytes(79),
        "wtpt": b"XYZ \0\0\0\0" + _fixed(*D50),
        **{f"{c}XYZ": b"XYZ \0\0\0\0" + _fixed(*xyz[:, k]) for k, c in enumerate("rgb")},
        **{f"{c}TRC": curve for c in "rgb"}, **changes,
    }  # fmt: skip
    tags = {key: body for key, body in tags.items() if body}
    table, data, start = struct.pack(">I", len(tags)), b"", 132 + 12 * len(tags)
    for key, body in tags.items():
        body += bytes(-len(body) % 4)
        table += key.encode() + struct.pack(">II", start + len(data), len(body))
        data += body
    head = struct.pack(">I", start + len(data)) + b"test\2\x10\0\0mntrRGB XYZ " + bytes(12)
    head += b"acsp" + bytes(28) + _fixed(*D50)
    return head + bytes(128 - len(head)) + table + data


def png(path: Path, pixels: np.ndarray, **chunks: bytes) -> Path:
    """A PNG of 16 bits (8 for bytes) with chunks between IHDR and IDAT."""
    height, width = pixels.shape[:2]
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[1 if pixels.ndim == 2 else pixels.shape[2]]
    bits = 8 * pixels.dtype.itemsize
    rows = pixels.astype(f">u{bits // 8}").reshape(height, -1)
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    parts = {
        "IHDR": struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0), **chunks,
        "IDAT": zlib.compress(raw), "IEND": b"",
    }  # fmt: skip
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name.encode() + body
        + struct.pack(">I", zlib.crc32(name.encode() + body)) for name, body in parts.items()
    ))  # fmt: skip
    return path


def iccp(profile: bytes) -> bytes:
    return b"mine\0\0" + zlib.compress(profile)


def chrm(xy: Sequence[float]) -> bytes:
    return struct.pack(">8I", *(round(1e5 * value) for value in (*xy[6:], *xy[:6])))


def with_oiio(path: Path, pixels: np.ndarray, **attributes: object) -> Path:
    """An image in the format of its suffix, with attributes such as ``tiff__half``."""
    kinds = {"uint8": "uint8", "uint16": "uint16", "float32": "float"}
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kinds[str(pixels.dtype)])
    profile = attributes.pop("profile", None)
    if isinstance(profile, bytes):
        kind = oiio.TypeDesc(f"uint8[{len(profile)}]")
        spec.attribute("ICCProfile", kind, np.frombuffer(profile, np.uint8))
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec), file.geterror()
    assert file.write_image(np.ascontiguousarray(pixels)), file.geterror()
    file.close()
    return path


def exr(path: Path, pixels: np.ndarray, names: str = "RGB", **header: object) -> Path:
    planes = {c: np.ascontiguousarray(pixels[..., k], np.float32) for k, c in enumerate(names)}
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, planes).write(str(path))
    return path


def hdr(path: Path, pixels: np.ndarray, lines: str = "", axes: str = "-Y {} +X {}") -> Path:
    """A Radiance picture without compression, of multiples of 1 / 256 in [1 / 2, 1)."""
    rgbe = np.dstack([pixels * 256, np.full(pixels.shape[:2], 128)]).astype(np.uint8)
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n{lines}\n{axes.format(*pixels.shape[:2])}\n"
    path.write_bytes(head.encode() + rgbe.tobytes())
    return path


def exif(**tags: object) -> Image.Exif:
    """EXIF data: ``orientation``, and ``interoperability`` of uncalibrated colours."""
    data = Image.Exif()
    if "orientation" in tags:
        data[0x0112] = tags["orientation"]
    if "interoperability" in tags:
        data[0x8769] = {0xA001: 65535, 0xA005: {1: tags["interoperability"]}}
    return data


def dng(
    path: Path, camera: np.ndarray, orientation: int = 1, primaries: Sequence[float] = SRGB
) -> Path:
    """A RAW photograph (DNG 1.4) with a Bayer pattern, black level 256 and white level 4095.

    Args:
        path: the file.
        camera: (H, W, 3) linear colours; black is 0 and white 1. H and W are even.
        orientation: EXIF orientation.
        primaries: x, y of the camera's red, green, blue and white.
    """
    height, width = camera.shape[:2]
    raw = np.empty((height, width))
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        raw[row::2, column::2] = camera[row::2, column::2, channel]
    pixels = np.round(256 + raw * (4095 - 256)).clip(0, 4095).astype("<u2")
    columns = [
        np.array([x, y, 1 - x - y]) / y
        for x, y in zip(primaries[::2], primaries[1::2], strict=True)
    ]
    rgb = np.stack(columns[:3], axis=1)
    matrix = np.linalg.inv(rgb * np.linalg.solve(rgb, columns[3]))
    fractions = [v for number in matrix.ravel() for v in (round(number * 10000), 10000)]
    text = b"Mine\0"
    entries = [  # tag, type, values
        (254, 4, [0]), (256, 4, [width]), (257, 4, [height]), (258, 3, [16]), (259, 3, [1]),
        (262, 3, [32803]), (271, 2, list(text)), (272, 2, list(text)), (273, 4, [0]),
        (274, 3, [orientation]), (277, 3, [1]), (278, 4, [height]), (279, 4, [pixels.nbytes]),
        (33421, 3, [2, 2]), (33422, 1, [0, 1, 1, 2]), (50706, 1, [1, 4, 0, 0]),
        (50708, 2, list(text)), (50714, 3, [256]), (50717, 4, [4095]), (50721, 10, fractions),
        (50728, 5, [1, 1, 1, 1, 1, 1]), (50778, 3, [21]),
    ]  # fmt: skip
    form = {1: "B", 2: "B", 3: "H", 4: "I", 5: "I", 10: "i"}
    start = 8 + 2 + 12 * len(entries) + 4
    extra, table = b"", b""
    sizes = [len(values) * struct.calcsize(form[kind]) for _, kind, values in entries]
    offset = start + sum(size + size % 2 for size in sizes if size > 4)
    for (tag, kind, values), size in zip(entries, sizes, strict=True):
        values = [offset] if tag == 273 else values
        body = struct.pack(f"<{len(values)}{form[kind]}", *values)
        if size > 4:
            place = struct.pack("<I", start + len(extra))
            extra += body + bytes(size % 2)
        else:
            place = body.ljust(4, b"\0")
        count = len(values) // 2 if kind in (5, 10) else len(values)
        table += struct.pack("<HHI", tag, kind, count) + place
    head = struct.pack("<2sHIH", b"II", 42, 8, len(entries))
    path.write_bytes(head + table + bytes(4) + extra + pixels.tobytes())
    return path
