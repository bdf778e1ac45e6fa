"""The one EXR reader and writer.

Two facts about OpenEXR-python 3.5 make this module necessary: it writes arrays that are
not C-contiguous (a channel slice, a flip, a transpose) as garbage without an error, and it
prints to stderr before it raises. Every file is therefore written from contiguous copies,
read back and compared before it takes its final name.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from svu_mi.errors import CaptureError, OutputError, ShapeError

MAGIC = b"\x76\x2f\x31\x01"


def write_exr(
    path: str | Path,
    channels: Mapping[str, np.ndarray],
    attributes: Mapping[str, str | int | float] | None = None,
    *,
    half: bool = False,
) -> None:
    """Write a single-part scanline EXR, atomically.

    Args:
        path: the file; an existing one is replaced only when the new one is complete.
        channels: (H, W) arrays by channel name, such as ``R``, ``G``, ``B``, ``A``, ``Y``.
        attributes: extra header entries.
        half: store half floats (values up to 65504) instead of float32.

    Raises:
        ShapeError: no channel, or channels that are not (H, W) arrays of one size.
        OutputError: NaN, infinite or (with ``half``) too large values, or a failed write.
    """
    path = Path(path)
    planes = _planes(path, channels, np.float16 if half else np.float32)
    header: dict[str, object] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **(attributes or {}),
    }
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with OpenEXR.File(header, dict(planes)) as file:
            file.write(str(temporary))
        written = read_exr(temporary)
        for name, plane in planes.items():
            if not np.array_equal(written[name], plane.astype(np.float32)):
                raise OutputError(f"{path}: channel {name} did not survive writing; not kept.")
        temporary.replace(path)
    except (OSError, RuntimeError, CaptureError) as error:
        raise OutputError(f"{path}: cannot be written ({_reason(path, error)}).") from error
    finally:
        temporary.unlink(missing_ok=True)


def _planes(
    path: Path, channels: Mapping[str, np.ndarray], dtype: type[np.floating]
) -> dict[str, np.ndarray]:
    if not channels:
        raise ShapeError(f"{path}: an EXR needs at least one channel.")
    sizes = {np.shape(values) for values in channels.values()}
    if len(sizes) != 1 or len(next(iter(sizes))) != 2:
        raise ShapeError(
            f"{path}: channels must be (H, W) arrays of one size, got "
            + ", ".join(f"{name} {np.shape(values)}" for name, values in channels.items())
            + "."
        )
    planes = {}
    for name, values in channels.items():
        with np.errstate(over="ignore"):
            plane = np.ascontiguousarray(values, dtype)
        bad = int((~np.isfinite(plane)).sum())
        if bad:
            raise OutputError(
                f"{path}: channel {name} has {bad} values that are NaN, infinite or too large."
            )
        planes[name] = plane
    return planes


def _reason(path: Path, error: Exception) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent}"
    if not os.access(path.parent, os.W_OK):
        return f"no permission to write in {path.parent}"
    return str(error) or type(error).__name__


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """Read the first part of an EXR.

    Returns:
        (H, W) float32 arrays by channel name, such as ``R``, ``G``, ``B``, ``A``, ``Y``.

    Raises:
        CaptureError: the file is missing, not an EXR, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise CaptureError(f"{path}: no such file.")
    try:
        with path.open("rb") as stream:
            magic = stream.read(4)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}).") from error
    if magic != MAGIC:
        raise CaptureError(f"{path}: not an EXR file, whatever its name says; export it again.")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {
                name: np.array(channel.pixels, np.float32)
                for name, channel in file.parts[0].channels.items()
            }
    except Exception as error:  # the binding raises RuntimeError, ValueError, ...
        raise CaptureError(f"{path}: a damaged EXR file ({error}); export it again.") from error
