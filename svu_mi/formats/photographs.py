"""Photographs of any kind as those of a capture: linear EXR with the mask as alpha."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from svu_mi.capture.images import IN_MASK, ON_OBJECT, SATURATED, UNUSABLE
from svu_mi.capture.picture import decoded, read_planes
from svu_mi.errors import CaptureError
from svu_mi.exr import write_exr
from svu_mi.formats.resampling import resampled
from svu_mi.formats.source import Frame


@dataclass(frozen=True, kw_only=True)
class Converted:
    """What was found in a photograph.

    Attributes:
        low_range: it holds 8- or 16-bit integers.
        saturated: number of its pixels that are clipped.
        invalid: number of its pixels that are NaN, infinite or negative.
        masked: whether it has a mask.
    """

    low_range: bool
    saturated: int
    invalid: int
    masked: bool


def convert(frame: Frame, path: Path, scale: tuple[float, float]) -> Converted:
    """Write a photograph as EXR: R, G, B linear, and A = 1 on the object if there is a mask.

    Pixels that are clipped or hold no radiance become -1, also where a new pixel takes part in
    one.

    Args:
        frame: the photograph with its mask; its size is that of the file.
        path: the EXR file.
        scale: of width and height, as ``squared`` returns it.

    Raises:
        CaptureError: the photograph or the mask cannot be read, or differ in size.
        OutputError: the file cannot be written.
    """
    planes, low_range = read_planes(frame.image)
    color = np.stack(planes[:3], axis=-1)
    with np.errstate(invalid="ignore"):
        clipped = (color > SATURATED).any(axis=-1) if low_range else np.zeros(color.shape[:2], bool)
        color = decoded(color, frame.transfer) if low_range else color
        invalid = ~(np.isfinite(color) & (color >= 0)).all(axis=-1)
    mask = _mask(frame, planes, low_range)
    bad = clipped | invalid
    color[bad] = 0
    layers = [color, bad[..., None], *([] if mask is None else [mask[..., None]])]
    image = resampled(np.concatenate(layers, axis=-1, dtype=np.float32), scale)
    image[image[..., 3] > 1e-6, :3] = UNUSABLE
    channels = {"R": image[..., 0], "G": image[..., 1], "B": image[..., 2]}
    if mask is not None:
        channels["A"] = image[..., 4]
    write_exr(path, channels, half=low_range)  # eight bits lose nothing there
    return Converted(
        low_range=low_range,
        saturated=int(clipped.sum()),
        invalid=int(invalid.sum()),
        masked=mask is not None,
    )


def _mask(frame: Frame, planes: list[np.ndarray], low_range: bool) -> np.ndarray | None:
    """Return (H, W) bool from the alpha channel, the mask's file, or both; None without any."""
    found = None
    if len(planes) > 3:
        found = planes[3] >= (IN_MASK if low_range else ON_OBJECT)
    if frame.mask is None:
        return found
    given, integers = read_planes(frame.mask)
    if given[0].shape != planes[0].shape:
        size, wanted = given[0].shape[::-1], planes[0].shape[::-1]
        raise CaptureError(
            f"{frame.mask}: the mask has {size[0]} x {size[1]} pixels but its photograph "
            f"{wanted[0]} x {wanted[1]}; resize it."
        )
    inside = given[0] >= (IN_MASK if integers else ON_OBJECT)
    return inside if found is None else inside & found
