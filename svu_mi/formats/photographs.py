"""Photographs of any kind as linear EXR with the mask as alpha, and what was found in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from svu_mi.capture.images import IN_MASK, ON_OBJECT, SATURATED, UNUSABLE, read_mask
from svu_mi.capture.picture import bits_of, decoded, is_turned, read_planes
from svu_mi.exr import has_foreign_colors, write_exr
from svu_mi.formats.resampling import resampled
from svu_mi.formats.source import Frame

BORDER = 0.9  # part of a photograph's border that no object covers
PART = 1e-6  # of a new pixel that an unusable one may cover, which is rounding


@dataclass(frozen=True, kw_only=True)
class Converted:
    """What was found in a photograph.

    Attributes:
        bits: 8 or 16 if it holds integers; 0 for floats.
        foreign: whether its chromaticities are not those of Rec. 709.
        saturated: number of its pixels that are clipped, on the object if there is a mask.
        invalid: number of its pixels that are NaN, infinite or negative.
        masked: whether it has a mask; an alpha channel that is opaque everywhere is none.
        empty: whether nothing of the object is in its mask.
        inverted: whether its mask has the border of the photograph, and leaves something out.
    """

    bits: int
    foreign: bool
    saturated: int
    invalid: int
    masked: bool
    empty: bool
    inverted: bool


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
    bits = bits_of(frame.image) if low_range else 0
    mask = _mask(frame, planes, low_range)
    del planes[3:]
    clipped, invalid = np.zeros((2, *planes[0].shape), bool)
    for channel, plane in enumerate(planes):  # one at a time: photographs may be huge
        if low_range:
            clipped |= plane > SATURATED[bits]
            planes[channel] = decoded(plane, frame.transfer)
        invalid |= ~(np.isfinite(plane) & (plane >= 0))
    bad = clipped | invalid
    for channel, plane in enumerate(planes):
        plane[bad] = 0
        planes[channel] = _resampled(plane, scale)
    touched = _resampled(bad, scale) > PART
    for plane in planes:
        plane[touched] = UNUSABLE
    channels = dict(zip("RGB", planes, strict=True))
    if mask is not None:
        channels["A"] = _resampled(mask, scale)
        clipped &= mask
    write_exr(path, channels, half=bits == 8)  # eight bits lose nothing there
    return Converted(
        bits=bits,
        foreign=frame.image.suffix.lower() == ".exr" and has_foreign_colors(frame.image),
        saturated=int(clipped.sum()),
        invalid=int(invalid.sum()),
        masked=mask is not None,
        empty=mask is not None and not mask.any(),
        inverted=mask is not None and _is_inverted(mask),
    )


def _is_inverted(mask: np.ndarray) -> bool:
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool(border.mean() > BORDER and not mask.all())


def _resampled(plane: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    return resampled(np.asarray(plane, np.float32)[..., None], scale)[..., 0]


def _mask(frame: Frame, planes: list[np.ndarray], low_range: bool) -> np.ndarray | None:
    """Return (H, W) bool from the alpha channel, the mask's file, or both; None without any."""
    found = None
    if len(planes) > 3 and planes[3].min() < 1:
        found = planes[3] >= (IN_MASK if low_range else ON_OBJECT)
    if frame.mask is None:
        return found
    inside = read_mask(frame.mask, planes[0].shape)
    return inside if found is None else inside & found


def about(frames: Sequence[Frame], found: Sequence[Converted]) -> list[str]:
    """Say what the photographs are not good for.

    Args:
        frames: V photographs.
        found: V times what was found in them.
    """
    notes = []
    count, low = len(found), [c.bits for c in found if c.bits]
    if low:
        saturated = sum(c.saturated for c in found)
        kinds = " and ".join(f"{bits}" for bits in sorted(set(low)))
        notes.append(
            f"{len(low)} of {count} photographs are not HDR: of {kinds} bits, decoded as "
            f"{frames[0].transfer}, "
            f"{saturated} clipped pixels left out. Clipped highlights hide what gloss says."
        )
    turned = [frame.image.name for frame in frames if is_turned(frame.image)]
    if turned:
        notes.append(
            f"{len(turned)} of {count} photographs, {turned[0]} first, are stored turned, and "
            "upright by their EXIF data alone, which are left out: poses must be of the pixels as "
            "stored. If svu check shows them turned, write them upright and import again."
        )
    foreign = [f.image.name for f, c in zip(frames, found, strict=True) if c.foreign]
    if foreign:
        notes.append(
            f"{len(foreign)} of {count} photographs, {foreign[0]} first, have chromaticities other "
            "than those of Rec. 709; their numbers are taken as they are: convert them if colours "
            "matter."
        )
    bad = [f.image.name for f, c in zip(frames, found, strict=True) if c.invalid]
    if bad:
        pixels = sum(c.invalid for c in found)
        notes.append(
            f"{len(bad)} of {count} photographs, {bad[0]} first, have {pixels} pixels that are "
            "NaN, infinite or negative; left out."
        )
    empty = [f.image.name for f, c in zip(frames, found, strict=True) if c.empty]
    if empty:
        notes.append(
            f"{len(empty)} of {count} photographs, {empty[0]} first, have an empty mask: nothing "
            "of them is used."
        )
    inverted = sum(c.inverted for c in found)
    if inverted > count / 2:
        notes.append(
            f"{inverted} of {count} masks have the border of the photograph; if the object is "
            "black in them, invert them: white is the object."
        )
    bare = count - sum(c.masked for c in found)
    if bare:
        notes.append(
            f"{bare} of {count} photographs have no mask: what stands before the object is taken "
            "for it."
        )
    return notes
