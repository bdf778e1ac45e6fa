"""Assign photographs of a folder to sensors."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from svu_mi.capture.capture_folder import FILE
from svu_mi.capture.image_io import SUFFIXES
from svu_mi.core.io.folder_exchange import restore
from svu_mi.errors import CaptureError, excerpt

Missing = Literal["refuse", "leave-out"]
VIEW, MASK = "view_", "mask_"
LONGEST = 80  # letters of a name, in messages
RAW = [
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".nef", ".orf", ".pef", ".raf", ".rw2", ".srw",
]  # fmt: skip
OTHERS = [".avif", ".bmp", ".gif", ".heic", ".heif", ".jxl", ".psd", ".tif", ".tiff", ".webp"]
UNREADABLE = {
    **dict.fromkeys(RAW, "develop them to linear EXR"),
    **dict.fromkeys(OTHERS, "convert them to EXR, or to PNG"),
}  # what to do with pictures of other kinds


class NoPhotographsError(CaptureError):
    """A folder has no photograph of any sensor; ``sensors`` says how many there are."""

    sensors = 0


@dataclass(frozen=True)
class Match:
    """The photographs of V sensors.

    Attributes:
        paths: V files; None for a sensor without a photograph.
        names: V names of those files, also of those that are not there.
        notes: sentences about what was guessed.
    """

    paths: list[Path | None]
    names: list[str]
    notes: list[str]


def match_photographs(
    folder: Path, ids: Sequence[str], missing: Missing = "refuse", *, any_name: bool = True
) -> Match:
    """Find the photographs of sensors in a folder.

    They are called ``view_0000.*``, ... by the number of their sensor, or by its id. Failing that
    there must be one picture for each, which are taken in the natural order of their names.
    """
    if not folder.is_dir():
        raise CaptureError(
            f"{folder}: no such folder; --images needs the one that holds view_0000.exr, ..."
        )
    pictures = _image_files(folder)
    numbers = [f"{VIEW}{index:04d}" for index in range(len(ids))]
    stems = {path.stem for path in pictures}
    if not stems.isdisjoint(numbers):
        views = [path for path in pictures if path.stem.startswith(VIEW)]
        return _by_name(folder, numbers, views, missing)
    if not stems.isdisjoint(ids):
        own = [path for path in pictures if any_name or path.stem in ids]
        return _by_name(folder, ids, own, missing)
    if any_name and pictures:
        return _in_order(folder, ids, pictures, missing)
    return _by_name(folder, numbers, [], missing)


def photographs_of(path: Path, ids: Collection[str] = ()) -> Path:
    """Return where the photographs of a scene or capture are when nobody says.

    A capture folder holds them itself; those of a scene are in ``images`` beside it, or in
    its own folder. Many scenes keep their textures in ``images``: it is taken only if it has a
    ``view_NNNN`` or is a capture, or has the id of a sensor.
    """
    restore(path)
    if path.is_dir():
        return path
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder; give a Mitsuba scene or a capture.")
    beside = path.parent / "images"
    if has_photographs(beside) or (beside / FILE).is_file():
        return beside
    by_id = beside.is_dir() and not {file.stem for file in _image_files(beside)}.isdisjoint(ids)
    return beside if by_id and not has_photographs(path.parent) else path.parent


def has_photographs(folder: Path) -> bool:
    """Return whether a folder has any ``view_NNNN`` image."""
    return next(folder.glob(f"{VIEW}*"), None) is not None


def masks_of(stem: str) -> tuple[str, ...]:
    """Return what the mask of a photograph may be called, both without their suffix."""
    numbered = (MASK + stem.removeprefix(VIEW),) if stem.startswith(VIEW) else ()
    return (*numbered, f"{MASK}{stem}", f"{stem}_mask")


def _image_files(folder: Path) -> list[Path]:
    """Return the pictures of a folder without masks and hidden files, in their natural order."""
    paths = [
        path for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    ]  # fmt: skip
    masks = {name for path in paths for name in masks_of(path.stem)}
    return sorted((path for path in paths if path.stem not in masks), key=_natural)


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Return what sorts names as people do: 2 before 10."""
    parts = re.split("([0-9]+)", path.stem.casefold())
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], path.name


def _by_name(
    folder: Path, expected: Sequence[str], pictures: Iterable[Path], missing: Missing
) -> Match:
    """Give each sensor the picture with its name."""
    by_name = _by_stem(folder, pictures)
    if absent := [name for name in expected if name not in by_name]:
        lack = (
            f"{folder}: {len(absent)} of {len(expected)} photographs are missing, first "
            f"{absent[0]}.exr"
        )
        if len(absent) == len(expected):
            error = NoPhotographsError(f"{lack}; {_remedy(folder)}.")
            error.sensors = len(expected)
            raise error
        if missing == "refuse":
            raise CaptureError(
                f"{lack}; give the others, or --missing leave-out to go on without them."
            )
    if extra := [name for name in by_name if name not in set(expected)]:
        raise CaptureError(
            f"{by_name[extra[0]]}: there are {len(by_name)} photographs but only {len(expected)} "
            "sensors; remove the extra images or add their sensors to the scene."
        )
    names = [by_name[name].name if name in by_name else f"{name}.exr" for name in expected]
    return Match([by_name.get(name) for name in expected], names, [])


def _remedy(folder: Path) -> str:
    """Say what a folder holds that has no photograph, and what to do."""
    if _image_files(folder):
        return (
            "no picture there has such a name: put the photographs into a folder of their own, "
            "and give it with --images"
        )
    others = Counter(path.suffix for path in folder.iterdir() if path.suffix.lower() in UNREADABLE)
    for suffix, count in others.most_common(1):
        return (
            f"the folder holds no picture that svu can read ({count} {suffix}: "
            f"{UNREADABLE[suffix.lower()]} first)"
        )
    return "the folder holds no picture: give that of the photographs with --images"


def _in_order(
    folder: Path, ids: Sequence[str], pictures: Sequence[Path], missing: Missing
) -> Match:
    """Give each sensor one of as many pictures, by their order."""
    _by_stem(folder, pictures)
    if len(pictures) != len(ids):
        leaves_out = missing == "leave-out" and len(pictures) < len(ids)
        raise CaptureError(
            f"{folder}: {len(pictures)} photographs for {len(ids)} sensors, and none has a name "
            f"that says {'which are missing' if leaves_out else 'whose it is'}; call them "
            "view_0000, ... by the number of their sensor, or by its id"
            f"{'' if leaves_out else ', or give one for each'}."
        )
    ends = [f"{excerpt(pictures[k].name, LONGEST)} is sensor {k}{_id(ids[k])}"
            for k in sorted({0, len(ids) - 1})]  # fmt: skip
    note = (
        f"{folder}: {len(ids)} photographs are taken in the order of their names: "
        f"{', ..., '.join(ends)}."
    )
    return Match(list(pictures), [path.name for path in pictures], [note])


def _by_stem(folder: Path, pictures: Iterable[Path]) -> dict[str, Path]:
    """Return pictures by their names without suffix."""
    by_name: dict[str, Path] = {}
    for path in sorted(pictures, key=lambda path: (path.stem, path.name)):
        if path.stem in by_name:
            raise CaptureError(
                f"{folder}: {by_name[path.stem].name} and {path.name} are the same view; "
                "keep one of them."
            )
        by_name[path.stem] = path
    return by_name


def _id(name: str) -> str:
    """Return a sensor's id in brackets if somebody has given it one."""
    return f" ('{name}')" if re.fullmatch(r"[^\W_][\w-]*", name) else ""
