"""What an import has found in photographs, as sentences."""

from __future__ import annotations

from collections.abc import Sequence

from svu_mi.capture.picture import is_turned
from svu_mi.formats.photographs import Converted
from svu_mi.formats.source import Frame


def about(frames: Sequence[Frame], found: Sequence[Converted]) -> list[str]:
    """Say what the photographs are not good for.

    Args:
        frames: V photographs.
        found: V times what was found in them.
    """
    notes = []
    count, low = len(found), sum(c.low_range for c in found)
    if low:
        saturated = sum(c.saturated for c in found)
        notes.append(
            f"{low} of {count} photographs are not HDR: decoded as {frames[0].transfer}, "
            f"{saturated} clipped pixels left out. Clipped highlights hide what gloss says."
        )
    turned = [frame.image.name for frame in frames if is_turned(frame.image)]
    if turned:
        notes.append(
            f"{len(turned)} of {count} photographs, {turned[0]} first, are stored turned, and "
            "upright by their EXIF data alone, which are left out: poses must be of the pixels as "
            "stored. If svu check shows them turned, write them upright and import again."
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
