"""Photographs as linear radiance, with masks, saturation and unusable pixels."""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np

from svu_mi.capture.crop import Window
from svu_mi.capture.image_formats.color_space import to_linear_srgb
from svu_mi.capture.image_io import SUFFIXES, ImageFile, open_image, read_planes
from svu_mi.capture.match_photographs import masks_of
from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.capture.quantization import (
    SATURATED,
    Rounding,
    Saturation,
    quantization_steps,
    saturation_radiance,
)
from svu_mi.capture.tone_curve import linearize
from svu_mi.core.io.provenance import RUN
from svu_mi.core.memory import STORED, Size, decoders
from svu_mi.core.validation import require_photographs
from svu_mi.errors import CaptureError

UNUSABLE = -1.0  # marks an unusable pixel in all channels of an EXR file
CLIPPED = -2.0  # marks a clipped channel in an EXR file with the attribute SATURATION
SATURATION = "svu:saturation"  # EXR attribute: radiance at which the channels were clipped
FIRST_STEP, LAST_STEP = "svu:first_step", "svu:last_step"  # EXR attributes (see ``Rounding``)
ON_OBJECT = 0.999  # smallest alpha of a pixel without background
IN_MASK = 0.5  # the same for 8-bit masks, which are binary but may have JPEG noise


@dataclass(frozen=True)
class Photograph:
    """One photograph.

    Attributes:
        pixels: (H, W, 3) float32 linear radiance, divided by the exposure. Unusable pixels and
            clipped channels are NaN.
        mask: (H, W) bool, True on the object; None without a mask.
        invalid: Number of NaN, infinite or negative pixels.
        marked: Number of pixels that are marked as unusable in the file.
        saturated: Number of pixels with clipped channels.
        bits: 8 or 16 for integer (low dynamic range) files, 0 for floating point.
        curve: Name of the curve that decoded integers; empty for floating point.
        black: True if all usable pixels are 0.
        remarks: Ignored properties (see ``ImageFile.remarks``).
        run: Id of the run that wrote the file; empty if unknown.
        clipped: Clipped channels and their lower bounds; None without any.
        rounding: Quantisation steps; None for floating-point sources.
    """

    pixels: np.ndarray
    mask: np.ndarray | None = None
    invalid: int = 0
    marked: int = 0
    saturated: int = 0
    bits: int = 0
    curve: str = ""
    black: bool = True
    remarks: tuple[str, ...] = ()
    run: str = ""
    clipped: Saturation | None = None
    rounding: Rounding | None = None


def open_photographs(paths: Sequence[Path | None], films: Sequence[Size]) -> dict[int, ImageFile]:
    """Read the headers of photographs, by view; skip views without a path."""
    pictures: dict[int, ImageFile] = {}
    for view, (path, film) in enumerate(zip(paths, films, strict=True)):
        if path is not None:
            pictures[view] = open_image(path).fitted(film)
            _require_size(path, pictures[view].size, film)  # before memory is allocated
    return pictures


def read_photographs(
    pictures: Mapping[int, ImageFile], windows: Sequence[Window], exposures: Sequence[float],
    memory: float = inf,
) -> tuple[list[Photograph], PixelBuffer]:  # fmt: skip
    """Read photographs and their masks in parallel.

    A mask is the image's alpha channel, unless that is 1 everywhere, or a file in the same folder
    (see ``masks_of``).

    Args:
        pictures: Files by view (see ``open_photographs``); other views get NaN pixels.
        windows: V crop windows.
        exposures: V gains; pixels are divided by them.
        memory: Bytes of memory for pixels; more are mapped from a file.

    Returns:
        V photographs, and the buffer with their pixels.
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
        # A broadcast NaN needs no memory.
        loaded.get(k) or Photograph(np.broadcast_to(np.float32(np.nan), (*window.size[::-1], 3)))
        for k, window in enumerate(windows)
    ], buffer


def _read_photograph(
    picture: ImageFile, window: Window, exposure: float,
    pixels: np.ndarray, masked: np.ndarray, channels: np.ndarray,
) -> Photograph:  # fmt: skip
    """Read one photograph into buffers (H, W, ...)."""
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
    # An import stores the steps of the integers that it has decoded.
    steps = [_positive(picture, name) for name in (FIRST_STEP, LAST_STEP)]
    if bits:
        steps[:] = quantization_steps(picture.transfer(), bits)
    rounding = None if None in steps else Rounding.between(*steps)  # type: ignore[arg-type]
    return Photograph(
        pixels=pixels, mask=None if mask is None else masked, invalid=invalid,
        marked=marked, saturated=saturated, bits=bits, black=black,
        curve=str(picture.transfer()) if bits else "",
        remarks=tuple(picture.remarks()), run=str(picture.header.attributes.get(RUN, "")),
        clipped=clipped, rounding=None if rounding is None else rounding.divided(exposure),
    )  # fmt: skip


# Numbers of invalid, marked and saturated pixels; True if all are black; saturation radiance.
Found = tuple[int, int, int, bool, float]


def _read_integers(
    picture: ImageFile, planes: Sequence[np.ndarray], window: Window, exposure: float,
    pixels: np.ndarray, channels: np.ndarray,
) -> Found:  # fmt: skip
    """Decode integers by a table; clipped channels become NaN.

    A downsampled channel is NaN if any pixel of its block is clipped, but only counts as clipped
    (a lower bound) if all of them are. If channels are mixed by a colour matrix, a pixel with a
    clipped channel is NaN, and only counts as clipped if all its channels are.
    """
    codes = np.arange(2**picture.bits, dtype=planes[0].dtype)
    encoded = picture.scaled(codes)
    first, transfer = codes[encoded > SATURATED[picture.bits]][0], picture.transfer()
    clipped = [plane >= first for plane in planes[:3]]
    some = np.logical_or.reduce(clipped)
    tables = [linearize(encoded, transfer, k) / np.float32(exposure) for k in range(3)]
    for table in tables:
        table[first:] = np.nan
    matrix = picture.header.color.matrix
    linear: Iterable[np.ndarray] = (
        table[plane] for table, plane in zip(tables, planes[:3], strict=True)
    )
    if matrix is not None:
        linear = to_linear_srgb(list(linear), matrix)
        clipped = [np.logical_and.reduce(clipped)] * 3
    for channel, (plane, over) in enumerate(zip(linear, clipped, strict=True)):
        pixels[..., channel] = window.averaged(plane)
        channels |= window.joined(over, np.logical_and).astype(np.uint8) << channel
    least = saturation_radiance(transfer, picture.bits)
    black = not any(plane.any() for plane in planes[:3])
    return 0, 0, int(some.sum()), black, least


def _read_floats(
    picture: ImageFile, planes: Sequence[np.ndarray], window: Window, exposure: float,
    pixels: np.ndarray, channels: np.ndarray,
) -> Found:  # fmt: skip
    """Copy linear values; invalid pixels and clipped channels become NaN."""
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
    """Return the mask of the crop, before downsampling; None without one."""
    if len(planes) > 3:
        alpha = picture.scaled(planes[3]) if picture.bits else planes[3]
        if not (alpha >= 1).all():  # not of a rendering that shows its environment
            return np.asarray(alpha >= (IN_MASK if picture.bits else ON_OBJECT))
    path = picture.path
    names = (path.with_name(stem + end) for stem in masks_of(path.stem) for end in SUFFIXES)
    mask = next((name for name in names if name.is_file()), None)
    return None if mask is None else window.cut(read_mask(mask, picture.size[::-1]))


def _require_size(path: Path, size: Sequence[int], film: Sequence[int]) -> None:
    """Raise if a photograph's (width, height) differs from its film."""
    if tuple(size) != tuple(film):
        raise CaptureError(
            f"{path}: the photograph has {size[0]} x {size[1]} pixels but its sensor's film has "
            f"{film[0]} x {film[1]}; resample it, or set the film's size (or crop window)."
        )


def _positive(picture: ImageFile, name: str) -> float | None:
    """Return an attribute of the header if it is a positive number, otherwise None."""
    try:
        value = float(picture.header.attributes.get(name, np.nan))
    except (TypeError, ValueError):
        return None
    return value if 0 < value < np.inf else None


def _mark(color: np.ndarray, exposure: float, clipped: Saturation | None) -> tuple[int, int, bool]:
    """Divide by the exposure and set invalid pixels to NaN, in place.

    Returns:
        Number of invalid pixels, number of pixels that the file marks as unusable, and True if
        all valid pixels are black. Clipped pixels are neither invalid nor black.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        if exposure != 1:
            color /= np.float32(exposure)
        # Two fast passes accept almost every photograph; NaN fails both comparisons.
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
    """Read a mask from an alpha channel, colours or labels.

    The mask is the alpha channel, if any of its pixels is transparent. Otherwise bright
    pixels are the object. If an integer file has no bright pixels, its values are labels, and 0 is
    the background.

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
