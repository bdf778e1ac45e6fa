"""Frames that occur twice in a source: the same photograph, or the same pose."""

import filecmp
import os
from collections.abc import Callable, Hashable, Iterator, Sequence
from pathlib import Path

from svu_mi.capture.importers.source import Frame
from svu_mi.errors import are

SAMPLE = 2**12  # bytes in the middle of files of the same size, before they are compared
DIGITS = 9  # of the numbers of equal poses


def duplicate_notes(frames: Sequence[Frame], root: str) -> Iterator[str]:
    """Yield a sentence about photographs that occur twice, and one about poses that do."""
    if pair := _first(frames, lambda frame: _signature(frame.image), _same_photograph):
        yield (
            f"{root}: {pair[2]} of {len(frames)} photographs {are(pair[2])} there twice, first "
            f"{pair[0].image.name} ({pair[0].label} and {pair[1].label}), so the "
            "uncertainty is too small. Remove one of each."
        )
    if pair := _first(
        frames, lambda frame: (frame.to_world.round(DIGITS) + 0.0).tobytes(),
        lambda one, other: not _same_photograph(one, other),
    ):  # fmt: skip
        yield (
            f"{root}: {pair[2]} of {len(frames)} photographs {are(pair[2])} posed like another, "
            f"first {pair[0].image.name} and {pair[1].image.name}; if the camera moved between "
            "them, correct the poses."
        )


def _first(
    frames: Sequence[Frame], key: Callable[[Frame], Hashable], same: Callable[[Frame, Frame], bool]
) -> tuple[Frame, Frame, int] | None:
    """Return the first two frames that are the same, and the number of repetitions."""
    seen: dict[Hashable, Frame] = {}
    pairs = [(seen.setdefault(key(frame), frame), frame) for frame in frames]
    found = [(one, other) for one, other in pairs if one is not other and same(one, other)]
    return (*found[0], len(found)) if found else None


def _signature(path: Path) -> Hashable:
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(size - SAMPLE, 0) // 2)
        return size, file.read(SAMPLE)


def _same_photograph(one: Frame, other: Frame) -> bool:
    same = os.path.samefile(one.image, other.image)
    return same or filecmp.cmp(one.image, other.image, shallow=False)
