"""Photographs: find the files, read them as linear radiance, mark what must not be used."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.block import allocate
from svu_mi.errors import CaptureError
from svu_mi.exr import read_exr

Missing = Literal["refuse", "leave out"]

SUFFIXES = (".exr", ".hdr", ".pfm", ".png", ".jpg", ".jpeg")
SATURATED = 0.98  # of an 8-bit photograph's encoded range; a clipped highlight is no measurement
ON_OBJECT = 0.999  # alpha from which a pixel shows nothing but the object
IN_MASK = 0.5  # the same for 8-bit masks, which say inside or outside, with noise if JPEG


@dataclass(frozen=True)
class Photograph:
    """One photograph as read.

    Attributes:
        pixels: (H, W, 3) float32 linear radiance, exposure divided out; NaN = not usable.
        mask: (H, W) bool, True on the object, or None.
        invalid: number of pixels that were NaN, infinite or negative.
        saturated: number of clipped pixels of an 8-bit photograph.
        low_range: True for an 8-bit photograph.
        black: True where no usable pixel holds any light.
    """

    pixels: np.ndarray
    mask: np.ndarray | None
    invalid: int
    saturated: int
    low_range: bool
    black: bool


def not_taken(size: tuple[int, int]) -> Photograph:
    """Return what stands for a photograph that nobody has taken: NaN, in no memory.

    Args:
        size: (width, height) that it would have.
    """
    pixels = np.broadcast_to(np.float32(np.nan), (size[1], size[0], 3))
    return Photograph(pixels, None, 0, 0, False, True)


def find_images(folder: Path, count: int, missing: Missing = "refuse") -> list[Path | None]:
    """Return the files ``view_0000.*`` ... in the order of the sensors.

    Args:
        folder: where they are.
        count: number of sensors.
        missing: ``refuse``, or ``leave out``: None for each that is not there.

    Raises:
        CaptureError: the folder is missing, an image is missing (all are, if those may be left
            out), or there are more.
    """
    if not folder.is_dir():
        raise CaptureError(
            f"{folder}: no such folder; --images takes the folder with view_0000.exr, ..."
        )
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.stem.startswith("view_") and path.suffix.lower() in SUFFIXES:
            if path.stem in found:
                raise CaptureError(
                    f"{folder}: {found[path.stem].name} and {path.name} are the same view; "
                    "keep one of them."
                )
            found[path.stem] = path
    expected = [f"view_{index:04d}" for index in range(count)]
    absent = [name for name in expected if name not in found]
    if absent and (missing == "refuse" or len(absent) == count):
        raise CaptureError(
            f"{folder}: {len(absent)} of {count} photographs are missing, first "
            f"{absent[0]}.exr; there must be one view_NNNN image per sensor, in their order."
        )
    extra = [name for name in found if name not in expected]
    if extra:
        raise CaptureError(
            f"{found[extra[0]]}: there are {len(found)} photographs but only {count} sensors; "
            "remove the extra images or add their sensors to the scene."
        )
    return [found.get(name) for name in expected]


def read_photographs(
    paths: Sequence[Path], sizes: Sequence[tuple[int, int]], exposures: Sequence[float]
) -> list[Photograph]:
    """Read photographs and their masks, on as many threads as Dr.Jit has.

    A mask is the image's alpha channel, or ``mask_NNNN.*`` beside it. All pixels lie in one
    block of memory, one photograph after the other, where kernels can look them up.

    Args:
        paths: V EXR, HDR, PFM (linear), PNG or JPEG (8-bit sRGB) files.
        sizes: V (width, height) of the sensors' films (their crop windows).
        exposures: V gains of the photographs; pixels are divided by them.

    Raises:
        CaptureError: one is unreadable or of another size than its film; the first in order.
    """
    with ThreadPoolExecutor(max(1, dr.thread_count())) as threads:
        return list(threads.map(_read_photograph, paths, allocate(sizes), exposures))


def _read_photograph(path: Path, room: np.ndarray, exposure: float) -> Photograph:
    """Read one photograph into ``room`` (H, W, 3)."""
    planes, low_range = _read(path)
    shape = planes[0].shape
    if shape != room.shape[:2]:
        raise CaptureError(
            f"{path}: the photograph has {shape[1]} x {shape[0]} pixels but its sensor's film has "
            f"{room.shape[1]} x {room.shape[0]}; resample it, or set the film's size (or crop "
            "window)."
        )
    for channel in range(3):
        room[..., channel] = planes[channel]
    saturated = _linearise(room) if low_range else 0
    invalid, black = _mark(room, exposure)
    mask = _mask_beside(path, shape)
    if len(planes) > 3:
        mask = planes[3] >= (IN_MASK if low_range else ON_OBJECT)
    return Photograph(room, mask, invalid - saturated, saturated, low_range, black)


def _linearise(color: np.ndarray) -> int:
    """Decode sRGB in place, clipped pixels as NaN; return how many those are."""
    clipped = (color > SATURATED).any(axis=-1)
    color[:] = linear_from_srgb(color)
    color[clipped] = np.nan
    return int(clipped.sum())


def _mark(color: np.ndarray, exposure: float) -> tuple[int, bool]:
    """Divide by the exposure and set pixels that hold no radiance to NaN, in place.

    Returns:
        The number of those pixels, and whether all others are black.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        if exposure != 1:
            color /= np.float32(exposure)
        # Two fast passes say that nearly every photograph is sound; NaN fails both tests.
        low, high = color.min(initial=0), color.max(initial=0)
        sound = bool(low >= 0 and high < np.inf)
        bad = None if sound else ~(np.isfinite(color) & (color >= 0)).all(axis=-1)
    if bad is None:
        return 0, not high > 0
    color[bad] = np.nan
    return int(bad.sum()), not np.fmax.reduce(color, axis=None, initial=0) > 0


def _read(path: Path) -> tuple[list[np.ndarray], bool]:
    """Return three or four planes (H, W) as stored and whether they are 8-bit sRGB."""
    if path.suffix.lower() == ".exr":
        channels = read_exr(path)
        grey = channels.get("Y")
        found = [channels.get(name, grey) for name in "RGB"]
        planes = [plane for plane in found if plane is not None]
        if len(planes) < 3:
            raise CaptureError(
                f"{path}: expected the channels R, G, B (or Y), found {', '.join(channels)}."
            )
        return planes + ([channels["A"]] if "A" in channels else []), False
    try:
        bitmap = mi.Bitmap(str(path))
    except Exception as error:  # Mitsuba raises RuntimeError for everything
        raise CaptureError(f"{path}: not a readable image; write it again as EXR.") from error
    values = np.array(bitmap)
    values = values[..., None] if values.ndim == 2 else values
    low_range = np.issubdtype(values.dtype, np.integer)
    scale = np.float32(np.iinfo(values.dtype).max if low_range else 1)
    planes = [values[..., k].astype(np.float32) / scale for k in range(values.shape[2])]
    return planes if len(planes) >= 3 else planes[:1] * 3 + planes[1:], low_range


def _mask_beside(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    for suffix in SUFFIXES:
        candidate = path.with_name(path.stem.replace("view_", "mask_") + suffix)
        if candidate.is_file():
            planes, low_range = _read(candidate)
            values = planes[0]
            if values.shape != shape:
                raise CaptureError(
                    f"{candidate}: the mask has {values.shape[1]} x {values.shape[0]} pixels but "
                    f"its photograph has {shape[1]} x {shape[0]}."
                )
            return values >= (IN_MASK if low_range else ON_OBJECT)
    return None


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """Invert the sRGB transfer function (IEC 61966-2-1)."""
    low = encoded / 12.92
    high = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)
