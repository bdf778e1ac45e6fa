"""Reader and writer of EXR files.

OpenEXR-python 3.5 writes arrays that are not C-contiguous (slices, flips, transposes) as garbage
without an error, and prints on stdout and stderr before it raises. Every file is therefore written
from contiguous copies, read back and compared before it gets its final name.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from svu_mi.core.io.files import may_hold, refusing, replacing, stamp
from svu_mi.core.silence_openexr import quiet
from svu_mi.core.validation import require_memory
from svu_mi.errors import CaptureError, OutputError, ShapeError

MAGIC = b"\x76\x2f\x31\x01"
GROUPS = ("RGBA", "RGB")  # last parts of channel names that stand for several channels
INT_LIMIT = 2**31
MAX_SIDE = 2**17  # pixels
MAX_CHANNELS = 1024  # per part; Blender with all passes writes about 100
READ_BYTES = 8  # per value: as stored, and as float32
DEEP = (OpenEXR.deepscanline, OpenEXR.deeptile)
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x, y of red, green, blue, white


def write_exr(
    path: str | Path,
    channels: Mapping[str, Any],
    attributes: Mapping[str, str | int | float] | None = None,
    *,
    half: bool = False,
) -> None:
    """Write a single-part scanline EXR atomically, and verify it bit by bit.

    Args:
        path: path of the file. An existing file is replaced when the new one is complete.
        channels: real arrays of one size by channel name: (H, W) or (H, W, 1) for ``R``,
            ``Y``, ``layer.R``, ...; (H, W, 3) for ``RGB`` and (H, W, 4) for ``RGBA`` (also
            ``layer.RGB``), stored as single channels. Any memory layout, any real type.
        attributes: header entries in addition to the marks of ``files.stamped``; numbers are
            stored as 32-bit int or float.
        half: True for half floats (magnitudes up to 65504), False for float32.

    Raises:
        ShapeError: no channel, or channels that are not images of one size.
        OutputError: values that are not finite numbers or too large; attributes of an invalid
            type; or a failed write, which keeps an older file.
    """
    path = Path(path)
    planes = _planes(path, channels, np.float16 if half else np.float32)
    header = {
        **_attributes(path, {**stamp(), **(attributes or {})}),
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    with replacing(path) as temporary:
        try:
            with quiet, OpenEXR.File(header, dict(planes)) as file:
                file.write(str(temporary))
            written, _ = _read_channels(temporary)
        except CaptureError as error:
            raise OutputError(f"{path}: is damaged after writing; is the disk full?") from error
        except (RuntimeError, ValueError, TypeError) as error:
            raise OutputError(f"{path}: cannot be written ({error}).") from error
        for name, plane in planes.items():
            if written[name].dtype != plane.dtype or written[name].tobytes() != plane.tobytes():
                raise OutputError(
                    f"{path}: channel {name} differs after read-back; the file was discarded."
                )


@dataclass(frozen=True)
class Header:
    """Header of the first part of an EXR.

    Attributes:
        size: (width, height) of the data window, the stored pixels.
        cropped: True if the data window differs from the display window.
        chromaticities: x, y of red, green, blue and white; those of Rec. 709 by default.
        attributes: entries of the header, text or numbers, by name.
        parts: number of parts of the file.
    """

    size: tuple[int, int]
    cropped: bool = False
    chromaticities: tuple[float, ...] = REC_709
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    parts: int = 1


def read_header(path: str | Path) -> Header:
    """Read the header of an EXR; compare its image sizes with file size and free memory.

    Raises:
        CaptureError: the file is missing, not an EXR, damaged or deep; or the header declares more
            pixels than the file or the memory can contain.
    """
    path = Path(path)
    _check_magic(path)
    try:
        with OpenEXR.File(str(path), header_only=True) as file:  # prints nothing
            parts = [dict(part.header) for part in file.parts]
        first = parts[0]
        windows = [np.array(part["dataWindow"], np.int64) for part in parts]
        sizes = [(int(w), int(h)) for w, h in (high - low + 1 for low, high in windows)]
        counts = [len(part["channels"]) for part in parts]
        colors = np.array(first.get("chromaticities", REC_709), np.float64)
        cropped = not np.array_equal(windows[0], first["displayWindow"])
    except Exception as error:  # the binding raises RuntimeError, ValueError, IndexError, ...
        raise CaptureError(f"{path}: a damaged EXR file; export it again.") from error
    if any(part.get("type") in DEEP for part in parts):
        raise CaptureError(f"{path}: a deep EXR file; export it as a flat image.")
    _check_sizes(path, sizes, counts)
    return Header(sizes[0], cropped, tuple(map(float, colors.ravel())), _plain(first), len(parts))


def _check_sizes(path: Path, sizes: Sequence[tuple[int, int]], counts: Sequence[int]) -> None:
    """Check channel counts and sizes of all parts, since the binding reads all of them."""
    if max(counts) > MAX_CHANNELS:
        raise CaptureError(
            f"{path}: has {max(counts)} channels, more than {MAX_CHANNELS}; export only "
            "its colours."
        )
    values = sum(w * h * count for (w, h), count in zip(sizes, counts, strict=True))
    is_size = all(0 < side <= MAX_SIDE for size in sizes for side in size)
    if not (is_size and may_hold(path, values * 2)):
        raise CaptureError(
            f"{path}: the header declares {sizes[0][0]} x {sizes[0][1]} pixels, too many for a "
            f"file of {path.stat().st_size} bytes; export it again."
        )
    require_memory(
        values * READ_BYTES, f"{path}: {values} values", "export only its colours, or fewer pixels",
        CaptureError,
    )  # fmt: skip


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """Read the first part of an EXR; thread-safe.

    Returns:
        (H, W) float32 arrays by channel name, such as ``R``, ``G``, ``B``, ``A``, ``Y``, in
        the data window. NaN and infinite values are kept.

    Raises:
        CaptureError: an error of ``read_header``, or damaged or subsampled pixels.
    """
    return read_pixels(Path(path), read_header(path).attributes)


def read_pixels(path: Path, given: Mapping[str, str | int | float]) -> dict[str, np.ndarray]:
    """Read the first part of an EXR whose header has the given attributes (see ``read_exr``).

    Raises:
        CaptureError: an error of ``read_exr``, or a file that changed after its header was read.
    """
    channels, attributes = _read_channels(path)
    if repr(attributes) != repr(given):  # repr, because NaN != NaN
        raise CaptureError(f"{path}: changed while it was being read; read it again.")
    return {name: np.ascontiguousarray(plane, np.float32) for name, plane in channels.items()}


def _planes(
    path: Path, channels: Mapping[str, Any], dtype: type[np.floating]
) -> dict[str, np.ndarray]:
    """Return contiguous (H, W) copies, one per stored channel."""
    images = {}
    for name, values in channels.items():
        images.update(_split(path, name, np.asarray(values)))
    sizes = {image.shape for image in images.values()}
    if len(sizes) != 1 or 0 in next(iter(sizes)):
        shapes = ", ".join(f"{name} {np.shape(v)}" for name, v in channels.items())
        raise ShapeError(
            f"{path}: channels must be (H, W) arrays of one size, got {shapes or 'none'}."
        )
    planes = {}
    for name, image in images.items():
        with np.errstate(over="ignore"):
            planes[name] = np.array(image, dtype, order="C")
        bad = int((~np.isfinite(planes[name])).sum())
        if bad:
            raise OutputError(
                f"{path}: channel {name} has {bad} values that are NaN, infinite or too large "
                f"for {dtype.__name__}; replace them first."
            )
    return planes


def _split(path: Path, name: str, image: np.ndarray) -> dict[str, np.ndarray]:
    if image.dtype.kind not in "fiub":
        raise OutputError(f"{path}: channel {name} has type {image.dtype}; expected real numbers.")
    layer, dot, last = name.rpartition(".")
    names = [layer + dot + letter for letter in last] if last in GROUPS else [name]
    planes = image[..., None] if image.ndim == 2 else image
    if planes.ndim != 3 or planes.shape[2] != len(names) or (last in GROUPS and image.ndim == 2):
        expected = f"(H, W, {len(names)})" if last in GROUPS else "(H, W) or (H, W, 1)"
        raise ShapeError(f"{path}: channel {name} must be {expected}, got {image.shape}.")
    return dict(zip(names, np.moveaxis(planes, 2, 0), strict=True))


def _attributes(path: Path, given: Mapping[str, Any]) -> dict[str, str | int | float]:
    """Return attributes as Python values; refuse those on which the binding aborts."""
    kept: dict[str, str | int | float] = {}
    for name, value in given.items():
        plain = value.item() if isinstance(value, np.generic) else value
        plain = int(plain) if isinstance(plain, bool) else plain
        if not isinstance(plain, str | int | float):
            raise OutputError(
                f"{path}: attribute {name} is a {type(value).__name__}; expected text or a "
                "number (store anything else as JSON text)."
            )
        if isinstance(plain, int) and not -INT_LIMIT <= plain < INT_LIMIT:
            raise OutputError(f"{path}: attribute {name} = {plain} does not fit in 32 bits.")
        kept[name] = plain
    return kept


def _check_magic(path: Path) -> None:
    with refusing(path, "give an EXR file"), path.open("rb") as stream:
        magic = stream.read(len(MAGIC))
    if magic != MAGIC:
        what = "an empty file" if not magic else "not an EXR file, despite its name"
        raise CaptureError(f"{path}: {what}; export it again.")


def _read_channels(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str | int | float]]:
    """Return the channels (H, W) of the first part, in their stored types, and its attributes."""
    try:
        with quiet, OpenEXR.File(str(path), separate_channels=True) as file:
            # Damaged pixels may yield a file without parts or channels instead of an exception.
            channels = dict(file.parts[0].channels)
            pixels = {name: np.asarray(channel.pixels) for name, channel in channels.items()}
            attributes = _plain(file.parts[0].header)
    except Exception as error:  # the binding raises RuntimeError, ValueError, IndexError, ...
        raise CaptureError(f"{path}: a damaged EXR file; export it again.") from error
    if not pixels or any(plane.ndim != 2 for plane in pixels.values()):
        raise CaptureError(f"{path}: a damaged or deep EXR file; export it as a flat image.")
    if any(c.xSampling != 1 or c.ySampling != 1 for c in channels.values()):
        raise CaptureError(f"{path}: channels are subsampled; export the EXR as plain RGB.")
    return pixels, attributes


def _plain(header: Mapping[str, Any]) -> dict[str, str | int | float]:
    return {name: value for name, value in header.items() if isinstance(value, str | int | float)}
