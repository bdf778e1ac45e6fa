"""Photographs: find the files, read them as linear radiance, mark what must not be used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from svu_mi.errors import CaptureError
from svu_mi.exr import read_exr

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
    """

    pixels: np.ndarray
    mask: np.ndarray | None
    invalid: int
    saturated: int
    low_range: bool

    @property
    def black(self) -> bool:
        """Return whether no usable pixel holds any light."""
        return not np.nanmax(self.pixels, initial=0.0) > 0


def find_images(folder: Path, count: int) -> list[Path]:
    """Return the files ``view_0000.*`` ... in the order of the sensors.

    Raises:
        CaptureError: the folder is missing, an image is missing, or there are more.
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
    missing = [name for name in expected if name not in found]
    if missing:
        raise CaptureError(
            f"{folder}: {len(missing)} of {count} photographs are missing, first "
            f"{missing[0]}.exr; there must be one view_NNNN image per sensor, in their order."
        )
    extra = [name for name in found if name not in expected]
    if extra:
        raise CaptureError(
            f"{found[extra[0]]}: there are {len(found)} photographs but only {count} sensors; "
            "remove the extra images or add their sensors to the scene."
        )
    return [found[name] for name in expected]


def read_photograph(path: Path, size: tuple[int, int], exposure: float) -> Photograph:
    """Read one photograph and its mask.

    The mask is the image's alpha channel, or ``mask_NNNN.*`` beside it.

    Args:
        path: an EXR, HDR, PFM (linear), PNG or JPEG (8-bit sRGB) file.
        size: (width, height) of the sensor's film (its crop window).
        exposure: gain of the photograph; pixels are divided by it.

    Raises:
        CaptureError: unreadable, or of another size than the film.
    """
    rgba, low_range = _read(path)
    height, width = rgba.shape[:2]
    if (width, height) != size:
        raise CaptureError(
            f"{path}: the photograph has {width} x {height} pixels but its sensor's film has "
            f"{size[0]} x {size[1]}; resample it, or set the film's size (or crop window)."
        )
    color, saturated = rgba[..., :3].astype(np.float32), 0
    if low_range:
        clipped = (color > SATURATED).any(axis=-1)
        color = _linear_from_srgb(color)
        color[clipped] = np.nan
        saturated = int(clipped.sum())
    with np.errstate(invalid="ignore"):
        bad = ~(np.isfinite(color) & (color >= 0)).all(axis=-1)
    color /= np.float32(exposure)
    color[bad] = np.nan
    mask = _mask_beside(path, (height, width))
    if rgba.shape[2] > 3:
        mask = rgba[..., 3] >= (IN_MASK if low_range else ON_OBJECT)
    return Photograph(color, mask, int(bad.sum()) - saturated, saturated, low_range)


def _read(path: Path) -> tuple[np.ndarray, bool]:
    """Return (H, W, 3 or 4) values as stored and whether they are 8-bit sRGB."""
    if path.suffix.lower() == ".exr":
        channels = read_exr(path)
        grey = channels.get("Y")
        found = [channels.get(name, grey) for name in "RGB"]
        planes = [plane for plane in found if plane is not None]
        if len(planes) < 3:
            raise CaptureError(
                f"{path}: expected the channels R, G, B (or Y), found {', '.join(channels)}."
            )
        planes += [channels["A"]] if "A" in channels else []
        return np.stack(planes, axis=-1), False
    try:
        bitmap = mi.Bitmap(str(path))
    except Exception as error:  # Mitsuba raises RuntimeError for everything
        raise CaptureError(f"{path}: not a readable image; write it again as EXR.") from error
    values = np.array(bitmap)
    values = values[..., None] if values.ndim == 2 else values
    if values.shape[2] < 3:
        values = np.concatenate([values[..., :1].repeat(3, axis=2), values[..., 1:]], axis=2)
    if np.issubdtype(values.dtype, np.integer):
        return values / np.float32(np.iinfo(values.dtype).max), True
    return values.astype(np.float32), False


def _mask_beside(path: Path, shape: tuple[int, int]) -> np.ndarray | None:
    for suffix in SUFFIXES:
        candidate = path.with_name(path.stem.replace("view_", "mask_") + suffix)
        if candidate.is_file():
            pixels, low_range = _read(candidate)
            values = pixels[..., 0]
            if values.shape != shape:
                raise CaptureError(
                    f"{candidate}: the mask has {values.shape[1]} x {values.shape[0]} pixels but "
                    f"its photograph has {shape[1]} x {shape[0]}."
                )
            return values >= (IN_MASK if low_range else ON_OBJECT)
    return None


def _linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """Invert the sRGB transfer function (IEC 61966-2-1)."""
    low = encoded / 12.92
    high = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)
