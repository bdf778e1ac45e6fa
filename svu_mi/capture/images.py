"""Photographs: read them as linear radiance, mark what must not be used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import numpy as np

from svu_mi.capture.block import allocate
from svu_mi.capture.clipped import Clipped
from svu_mi.capture.matching import masks_of
from svu_mi.capture.picture import SUFFIXES, Picture, decoded, open_picture, read_planes
from svu_mi.capture.rounding import Rounding
from svu_mi.errors import CaptureError
from svu_mi.limits import require_photographs
from svu_mi.needs import Size
from svu_mi.results.record import RUN

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
        remarks: what the file says about itself that is not followed (``Picture.remarks``).
        run: id of the run that wrote the file; empty = it is not known.
    """

    pixels: np.ndarray
    mask: np.ndarray | None
    invalid: int
    marked: int
    saturated: int
    bits: int
    black: bool
    remarks: tuple[str, ...] = ()
    run: str = ""
    clipped: Clipped | None = None
    rounding: Rounding | None = None


def not_taken(size: tuple[int, int]) -> Photograph:
    """Return what stands for a photograph that nobody has taken: NaN, in no memory.

    Args:
        size: (width, height) that it would have.
    """
    pixels = np.broadcast_to(np.float32(np.nan), (size[1], size[0], 3))
    return Photograph(pixels, None, 0, 0, 0, 0, True)


def read_photographs(
    paths: Sequence[Path | None], sizes: Sequence[Size], exposures: Sequence[float],
    opened: Callable[[Sequence[Size]], None] | None = None,
) -> list[Photograph]:  # fmt: skip
    """Read photographs and their masks, on as many threads as Dr.Jit has.

    A mask is the image's alpha channel, or a file beside it (``masks_of``). All pixels lie in one
    block of memory, one photograph after the other, where kernels can look them up.

    Args:
        paths: V EXR, HDR, PFM (linear), PNG or JPEG (sRGB of 8 or 16 bits) files; None for a
            photograph that nobody has taken (``not_taken``).
        sizes: V (width, height) of the sensors' films (their crop windows).
        exposures: V gains of the photographs; pixels are divided by them.
        opened: called with the sizes of those that there are, when all headers have been read and
            no pixel has.

    Raises:
        CaptureError: one is unreadable or of another size than its film, the first in order; or
            there is not enough memory for all.
    """
    pictures: dict[int, Picture] = {}
    for view, (path, size) in enumerate(zip(paths, sizes, strict=True)):
        if path is not None:
            pictures[view] = open_picture(path)
            _require_size(path, pictures[view].size, size)  # films may promise any size
    if not pictures:
        return [not_taken(size) for size in sizes]
    films = [sizes[view] for view in pictures]
    if opened is not None:
        opened(films)
    require_photographs(films, str(next(iter(pictures.values())).path.parent))
    gains = [exposures[view] for view in pictures]
    with ThreadPoolExecutor(max(1, dr.thread_count())) as threads:
        read = threads.map(_read_photograph, pictures.values(), allocate(films), gains)
        found = dict(zip(pictures, read, strict=True))
    return [found.get(view) or not_taken(size) for view, size in enumerate(sizes)]


def _read_photograph(picture: Picture, room: np.ndarray, exposure: float) -> Photograph:
    """Read one photograph into ``room`` (H, W, 3)."""
    path, bits, planes = picture.path, picture.bits, picture.planes()
    shape = planes[0].shape
    _require_size(path, shape[::-1], room.shape[1::-1])
    for channel in range(3):
        room[..., channel] = planes[channel]
    clipped = _linearise(room, SATURATED[bits]) if bits else _marked_as_clipped(picture, room)
    invalid, marked, black = _mark(room, exposure, clipped)
    saturated = 0 if clipped is None else int((clipped.channels > 0).sum())
    if clipped is not None:
        clipped = clipped.divided(np.float32(exposure)) if saturated else None
    mask = _mask_beside(path, shape)
    if len(planes) > 3:
        mask = planes[3] >= (IN_MASK if bits else ON_OBJECT)
    invalid -= marked
    found, run = tuple(picture.remarks()), str(picture.header.attributes.get(RUN, ""))
    rounding = Rounding.of(bits) if bits else _steps(picture)
    if rounding is not None:
        rounding = rounding.divided(exposure)
    return Photograph(
        room, mask, invalid, marked, saturated, bits, black, found, run, clipped, rounding
    )


def _require_size(path: Path, found: Sequence[int], film: Sequence[int]) -> None:
    """Refuse a photograph of another (width, height) than its film."""
    if tuple(found) != tuple(film):
        raise CaptureError(
            f"{path}: the photograph has {found[0]} x {found[1]} pixels but its sensor's film has "
            f"{film[0]} x {film[1]}; resample it, or set the film's size (or crop window)."
        )


def _linearise(color: np.ndarray, most: float) -> Clipped:
    """Decode sRGB in place, channels above ``most`` as NaN; return which those are."""
    over = color > most
    color[:] = decoded(color)
    color[over] = np.nan
    return Clipped.of(over, float(decoded(np.array(most, np.float32))))


def _steps(picture: Picture) -> Rounding | None:
    """Return the steps of the integers that an import has made a photograph of; None of floats."""
    first, last = (_positive(picture, name) for name in (FIRST_STEP, LAST_STEP))
    return None if first is None or last is None else Rounding.between(first, last)


def _positive(picture: Picture, name: str) -> float | None:
    """Return an attribute that is a positive number; None if it is not there, or something else."""
    try:
        found = float(picture.header.attributes.get(name, np.nan))
    except (TypeError, ValueError):
        return None
    return found if 0 < found < np.inf else None


def _marked_as_clipped(picture: Picture, color: np.ndarray) -> Clipped | None:
    """Find the channels that an import has marked as clipped, and set them to NaN in place."""
    least = _positive(picture, SATURATION)
    if least is None:
        return None
    over = color == np.float32(CLIPPED)
    color[over] = np.nan
    return Clipped.of(over, least)


def _mark(color: np.ndarray, exposure: float, clipped: Clipped | None) -> tuple[int, int, bool]:
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

    Args:
        path: the file.
        shape: (H, W) of the photograph.

    Returns:
        (H, W) bool, True on the object.

    Raises:
        CaptureError: it cannot be read, or has another size.
    """
    planes, low_range = read_planes(path)
    values = planes[0]
    if values.shape != tuple(shape):
        raise CaptureError(
            f"{path}: the mask has {values.shape[1]} x {values.shape[0]} pixels but its photograph "
            f"has {shape[1]} x {shape[0]}; resize it."
        )
    if planes[3:] and planes[3].min() < 1:
        values = planes[3]
    else:
        values = np.maximum(np.maximum(values, planes[1]), planes[2])
    if low_range and 0 < values.max() < IN_MASK:
        return values > 0
    return values >= (IN_MASK if low_range else ON_OBJECT)


def _mask_beside(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    for stem in masks_of(path.stem):
        for suffix in SUFFIXES:
            candidate = path.with_name(stem + suffix)
            if candidate.is_file():
                return read_mask(candidate, shape)
    return None
