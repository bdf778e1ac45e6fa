"""Photographs: read them as linear radiance, mark what must not be used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np

from svu_mi.capture.crop import Window
from svu_mi.capture.image_io import SUFFIXES, ImageFile, decoded, open_image, read_planes
from svu_mi.capture.match_photographs import masks_of
from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.capture.quantization import Rounding, Saturation
from svu_mi.core.io.provenance import RUN
from svu_mi.core.memory import STORED, Size, decoders
from svu_mi.core.validation import require_photographs
from svu_mi.errors import CaptureError

# Of the encoded range, by bits; a clipped highlight is not a measurement. JPEG blurs it, too.
SATURATED = {8: 0.98, 16: 0.995}
UNUSABLE = -1.0  # radiance of a pixel that is not to be used, in all channels of an EXR
CLIPPED = -2.0  # radiance of a channel that is clipped, in an EXR with the attribute SATURATION
SATURATION = "svu:saturation"  # radiance from which the channels of a photograph were clipped
FIRST_STEP, LAST_STEP = "svu:first_step", "svu:last_step"  # of integers, in radiance (``Rounding``)
ON_OBJECT = 0.999  # alpha from which a pixel shows nothing but the object
IN_MASK = 0.5  # the same for 8-bit masks, which say inside or outside, with noise if JPEG


@dataclass(frozen=True)
class Photograph:
    """One photograph as read.

    Attributes:
        pixels: (H, W, 3) float32 linear radiance, exposure divided out; NaN = not usable. Of a
            pixel that is clipped, only those channels are NaN.
        clipped: which those are, and what they are at least; None without any.
        rounding: steps of what was stored in integers; None of floats.
        mask: (H, W) bool, True on the object, or None.
        invalid: number of pixels that were NaN, infinite or negative.
        marked: number of pixels that whoever wrote the photograph has marked as unusable.
        saturated: number of clipped pixels of a photograph of integers.
        bits: 8 or 16 for a photograph of integers, which is not HDR; 0 for floats.
        black: True where no usable pixel holds any light.
        remarks: what the file says about itself that is not followed (``ImageFile.remarks``).
        run: id of the run that wrote the file; empty = it is not known.
    """

    pixels: np.ndarray
    mask: np.ndarray | None = None
    invalid: int = 0
    marked: int = 0
    saturated: int = 0
    bits: int = 0
    black: bool = True
    remarks: tuple[str, ...] = ()
    run: str = ""
    clipped: Saturation | None = None
    rounding: Rounding | None = None


def open_photographs(paths: Sequence[Path | None], films: Sequence[Size]) -> dict[int, ImageFile]:
    """Read the headers of photographs, by view; views without a path are left out."""
    pictures: dict[int, ImageFile] = {}
    for view, (path, film) in enumerate(zip(paths, films, strict=True)):
        if path is not None:
            pictures[view] = open_image(path)
            _require_size(path, pictures[view].size, film)  # films may promise any size
    return pictures


def read_photographs(
    pictures: Mapping[int, ImageFile], windows: Sequence[Window], exposures: Sequence[float],
    memory: float = inf,
) -> tuple[list[Photograph], PixelBuffer]:  # fmt: skip
    """Read photographs and their masks, on as many threads as Dr.Jit has and memory allows.

    A mask is the image's alpha channel, or a file beside it (``masks_of``).

    Args:
        pictures: files by view (``open_photographs``); other views are black, and NaN.
        windows: what to keep of each of the V photographs.
        exposures: V gains of the photographs; pixels are divided by them.
        memory: bytes that they may take, beyond which they lie in a file.
    """
    sizes = [windows[view].size for view in pictures]
    if pictures and STORED * sum(width * height for width, height in sizes) <= memory:
        require_photographs(sizes, str(next(iter(pictures.values())).path.parent))
    buffer = PixelBuffer.allocate(sizes, memory)
    largest = max((p.size[0] * p.size[1] for p in pictures.values()), default=1)
    with ThreadPoolExecutor(decoders(largest)) as threads:
        read = threads.map(
            _read_photograph, pictures.values(), [windows[view] for view in pictures],
            [exposures[view] for view in pictures], buffer.images, buffer.masks, buffer.channels,
        )  # fmt: skip
        loaded = dict(zip(pictures, read, strict=True))
    return [
        # Of a photograph that nobody has taken: NaN, in no memory.
        loaded.get(k) or Photograph(np.broadcast_to(np.float32(np.nan), (*window.size[::-1], 3)))
        for k, window in enumerate(windows)
    ], buffer


def _read_photograph(
    picture: ImageFile, window: Window, exposure: float,
    pixels: np.ndarray, masked: np.ndarray, channels: np.ndarray,
) -> Photograph:  # fmt: skip
    """Read one photograph into arrays (H, W, ...) of a buffer."""
    bits, stored = picture.bits, picture.stored()
    _require_size(picture.path, stored[0].shape[::-1], picture.size)
    planes = [window.cut(plane) for plane in stored]
    del stored
    read = _read_integers if bits else _read_floats
    invalid, marked, saturated, black, least = read(
        picture, planes, window, exposure, pixels, channels
    )
    mask = _mask_of(picture, planes, window)
    masked[:] = True if mask is None else window.joined(mask, np.logical_and)
    clipped = None
    if channels.any():
        clipped = Saturation(channels, np.full(3, np.float32(least) / np.float32(exposure)))
    rounding = Rounding.of(bits) if bits else _steps(picture)
    return Photograph(
        pixels=pixels, mask=None if mask is None else masked, invalid=invalid,
        marked=marked, saturated=saturated, bits=bits, black=black,
        remarks=tuple(picture.remarks()), run=str(picture.header.attributes.get(RUN, "")),
        clipped=clipped, rounding=None if rounding is None else rounding.divided(exposure),
    )  # fmt: skip


# Counts of pixels: invalid, marked and saturated; whether it is black, and the least radiance of
# saturated channels.
Found = tuple[int, int, int, bool, float]


def _read_integers(
    picture: ImageFile, planes: Sequence[np.ndarray], window: Window, exposure: float,
    pixels: np.ndarray, channels: np.ndarray,
) -> Found:  # fmt: skip
    """Decode sRGB integers by a table. Channels that are clipped become NaN; of a block that is
    made one pixel, all must be to call it clipped, and any leaves it unusable."""
    codes = np.arange(2**picture.bits, dtype=planes[0].dtype)
    encoded = picture.scaled(codes)
    over = encoded > SATURATED[picture.bits]
    table = np.where(over, np.float32(np.nan), decoded(encoded) / np.float32(exposure))
    first, some = codes[over][0], np.zeros(planes[0].shape, bool)
    for channel, plane in enumerate(planes[:3]):
        clipped = plane >= first
        some |= clipped
        pixels[..., channel] = window.averaged(table[plane])
        joined = window.joined(clipped, np.logical_and)
        channels |= joined.astype(np.uint8) << channel
    least = float(decoded(np.array(SATURATED[picture.bits], np.float32)))
    black = not any(plane.any() for plane in planes[:3])
    return 0, 0, int(some.sum()), black, least


def _read_floats(
    picture: ImageFile, planes: Sequence[np.ndarray], window: Window, exposure: float,
    pixels: np.ndarray, channels: np.ndarray,
) -> Found:  # fmt: skip
    """Take linear values. What holds no radiance becomes NaN, and so does what an import has marked
    as clipped."""
    color = pixels if window.shrink == 1 else np.empty((*planes[0].shape, 3), np.float32)
    for channel in range(3):
        color[..., channel] = planes[channel]
    clipped, least = None, _positive(picture, SATURATION)
    if least is not None:
        over = color == np.float32(CLIPPED)
        color[over] = np.nan
        clipped = Saturation.of(over, least)
    invalid, marked, black = _mark(color, exposure, clipped)
    if window.shrink > 1:
        for channel in range(3):
            pixels[..., channel] = window.averaged(color[..., channel])
    saturated = 0
    if clipped is not None:
        channels[:] = window.joined(clipped.channels, np.bitwise_and)
        saturated = int((clipped.channels > 0).sum())
    return invalid - marked, marked, saturated, black, least or 0.0


def _mask_of(picture: ImageFile, planes: Sequence[np.ndarray], window: Window) -> np.ndarray | None:
    """Return the mask of what is kept of a photograph, before it is made smaller."""
    if len(planes) > 3:
        alpha = picture.scaled(planes[3]) if picture.bits else planes[3]
        return np.asarray(alpha >= (IN_MASK if picture.bits else ON_OBJECT))
    path = picture.path
    names = (path.with_name(stem + end) for stem in masks_of(path.stem) for end in SUFFIXES)
    mask = next((name for name in names if name.is_file()), None)
    return None if mask is None else window.cut(read_mask(mask, picture.size[::-1]))


def _require_size(path: Path, size: Sequence[int], film: Sequence[int]) -> None:
    """Refuse a photograph of another (width, height) than its film."""
    if tuple(size) != tuple(film):
        raise CaptureError(
            f"{path}: the photograph has {size[0]} x {size[1]} pixels but its sensor's film has "
            f"{film[0]} x {film[1]}; resample it, or set the film's size (or crop window)."
        )


def _steps(picture: ImageFile) -> Rounding | None:
    """Return the steps of the integers that an import has made a photograph of; None of floats."""
    first, last = (_positive(picture, name) for name in (FIRST_STEP, LAST_STEP))
    return None if first is None or last is None else Rounding.between(first, last)


def _positive(picture: ImageFile, name: str) -> float | None:
    """Return an attribute that is a positive number; None if it is not there, or something else."""
    try:
        value = float(picture.header.attributes.get(name, np.nan))
    except (TypeError, ValueError):
        return None
    return value if 0 < value < np.inf else None


def _mark(color: np.ndarray, exposure: float, clipped: Saturation | None) -> tuple[int, int, bool]:
    """Divide by the exposure and set pixels that hold no radiance to NaN, in place.

    Returns:
        The number of those pixels, that of those among them that were marked, and whether all
        others are black. A clipped pixel is none of them, and not black.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        if exposure != 1:
            color /= np.float32(exposure)
        # Two fast passes say that nearly every photograph is sound; NaN fails both tests.
        low, high = color.min(initial=0), color.max(initial=0)
        sound = bool(low >= 0 and high < np.inf)
        if sound:
            return 0, 0, not high > 0
        good = np.isfinite(color) & (color >= 0)
    if clipped is not None:
        good |= clipped.flags
    bad = ~good.all(axis=-1)
    marked = int((color == np.float32(UNUSABLE) / np.float32(exposure)).all(axis=-1).sum())
    color[bad] = np.nan
    lit = np.fmax.reduce(color, axis=None, initial=0) > 0
    if clipped is not None:
        clipped.channels[bad] = 0
        lit |= bool(clipped.channels.any())
    return int(bad.sum()), marked, not lit


def read_mask(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Read a mask of any kind.

    An alpha channel that is anywhere transparent is the mask, as in a cut-out; otherwise the
    object is white, or of any bright colour. Integers of which none is bright are labels: the
    object is everything but 0.

    Returns:
        (H, W) bool, True on the object.
    """
    planes, low_range = read_planes(path)
    height, width = planes[0].shape
    if (height, width) != tuple(shape):
        raise CaptureError(
            f"{path}: the mask has {width} x {height} pixels but its photograph "
            f"has {shape[1]} x {shape[0]}; resize it."
        )
    transparent = planes[3:] and planes[3].min() < 1
    values = planes[3] if transparent else np.maximum(np.maximum(*planes[:2]), planes[2])
    if low_range and 0 < values.max() < IN_MASK:
        return values > 0
    return values >= (IN_MASK if low_range else ON_OBJECT)
