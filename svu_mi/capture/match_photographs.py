"""Assignment of the photographs in a folder to sensors."""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from svu_mi.capture.capture_folder import FILE
from svu_mi.capture.image_formats.recognition import SUFFIXES, without_raw_doubles
from svu_mi.core.io.files import refusing
from svu_mi.core.io.folder_exchange import restore
from svu_mi.errors import CaptureError, are, counted, excerpt

Missing = Literal["refuse", "leave-out"]
VIEW, MASK = "view_", "mask_"
LONGEST = 80  # characters of a file name in messages
UNREADABLE = (".bmp", ".gif", ".jp2", ".psd", ".tga")


class NoPhotographsError(CaptureError):
    """Error for a folder without photographs; ``sensors`` is the number of sensors."""

    sensors = 0


@dataclass(frozen=True)
class Match:
    """The photographs of V sensors.

    Attributes:
        paths: V files; None for a sensor without a photograph.
        names: V file names; the expected name for a missing file.
        notes: Warnings about assumptions.
    """

    paths: list[Path | None]
    names: list[str]
    notes: list[str]


def match_photographs(
    folder: Path, ids: Sequence[str], missing: Missing = "refuse", *, any_name: bool = True
) -> Match:
    """Find the photographs of sensors in a folder.

    Files are named by the ids of their sensors, or ``view_0000.*``, ... by their index. Files with
    other names are assigned in natural order, if there are as many files as sensors.
    ``any_name=False`` ignores them, because they may be textures.
    """
    if not folder.is_dir():
        lack = "is a file" if folder.exists() else "no such folder"
        raise CaptureError(f"{folder}: {lack}; give the folder of the photographs with --images.")
    pictures = _image_files(folder)
    numbers = [f"{VIEW}{index:04d}" for index in range(len(ids))]
    stems = {path.stem for path in pictures}
    if not stems.isdisjoint(numbers) and not stems.issuperset(ids):
        views = [path for path in pictures if path.stem.startswith(VIEW)]
        return _by_name(folder, numbers, views, missing)
    if not stems.isdisjoint(ids):
        own = [path for path in pictures if any_name or path.stem in ids]
        return _by_name(folder, ids, own, missing)
    if any_name and pictures:
        return _in_order(folder, ids, pictures, missing)
    named = ids if all(map(_id, ids)) else numbers
    return _by_name(folder, named, [], missing)


def photographs_of(path: Path, ids: Collection[str] = ()) -> Path:
    """Return the default folder of the photographs of a scene or capture.

    The default of a capture is the capture folder. The default of a scene file is ``images`` next
    to the file, or the file's own folder. Many scenes keep textures in ``images``, so that folder
    is used only if it contains a ``view_NNNN``, a ``capture.json``, or a file named after a sensor.
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
    """Return the possible names of a photograph's mask, all without suffix."""
    numbered = (MASK + stem.removeprefix(VIEW),) if stem.startswith(VIEW) else ()
    return (*numbered, f"{MASK}{stem}", f"{stem}_mask")


def list_pictures(folder: Path) -> list[Path]:
    """Return the pictures in a folder sorted by name, without hidden files."""
    with refusing(folder, "change its permissions"):
        files = sorted(folder.iterdir())
    known = [file for file in files if file.suffix.lower() in SUFFIXES and file.is_file()]
    return without_raw_doubles([file for file in known if not file.name.startswith(".")])


def _image_files(folder: Path) -> list[Path]:
    """Return a folder's images in natural order, without masks."""
    paths = list_pictures(folder)
    masks = {name for path in paths for name in masks_of(path.stem)}
    return sorted((path for path in paths if path.stem not in masks), key=_natural)


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Return the sort key of natural order: 2 before 10."""
    parts = re.split("([0-9]+)", path.stem.casefold())
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], path.name


def _by_name(
    folder: Path, expected: Sequence[str], pictures: Iterable[Path], missing: Missing
) -> Match:
    """Assign images to the sensors with the same name."""
    by_name = _by_stem(folder, pictures)
    kind = next(iter(by_name.values())).suffix if by_name else ".exr"
    if absent := [name for name in expected if name not in by_name]:
        lack = (
            f"{folder}: {len(absent)} of {len(expected)} photographs {are(len(absent))} missing, "
            f"first {absent[0]}{kind}"
        )
        if len(absent) == len(expected):
            error = NoPhotographsError(f"{lack}; {_remedy(folder)}.")
            error.sensors = len(expected)
            raise error
        if missing == "refuse":
            raise CaptureError(
                f"{lack}; add them, or continue without them by --missing leave-out."
            )
    if extra := [name for name in by_name if name not in set(expected)]:
        raise CaptureError(
            f"{by_name[extra[0]]}: no sensor has this name; the folder has "
            f"{counted(len(by_name), 'photograph')} for {counted(len(expected), 'sensor')}. "
            "Remove the extra images or add sensors."
        )
    names = [by_name[name].name if name in by_name else f"{name}.exr" for name in expected]
    return Match([by_name.get(name) for name in expected], names, [])


def _remedy(folder: Path) -> str:
    """Return the remedy for a folder without photographs."""
    if _image_files(folder):
        return (
            "no image there has such a name: put the photographs into a separate folder and give "
            "it with --images"
        )
    others = Counter(path.suffix for path in folder.iterdir() if path.suffix.lower() in UNREADABLE)
    for suffix, count in others.most_common(1):
        return (
            f"the folder has no image in a supported format ({count} {suffix}: "
            "convert them to EXR, or to PNG, first)"
        )
    return "the folder has no image: give another one with --images, or save the photographs there"


def _in_order(
    folder: Path, ids: Sequence[str], pictures: Sequence[Path], missing: Missing
) -> Match:
    """Assign images to sensors in order; raise unless there is one per sensor."""
    _by_stem(folder, pictures)
    if len(pictures) != len(ids):
        leaves_out = missing == "leave-out" and len(pictures) < len(ids)
        both = f"{counted(len(pictures), 'photograph')} for {counted(len(ids), 'sensor')}"
        raise CaptureError(
            f"{folder}: {both} cannot be assigned by their names; name them view_0000, ... by the "
            "index of their sensor, or by its id"
            f"{'' if leaves_out else ', or give one per sensor'}."
        )
    ends = [f"{excerpt(pictures[k].name, LONGEST)} is sensor {k}{_id(ids[k])}"
            for k in sorted({0, len(ids) - 1})]  # fmt: skip
    note = (
        f"{folder}: {len(ids)} photographs are assigned to sensors in the order of their names: "
        f"{', ..., '.join(ends)}."
    )
    return Match(list(pictures), [path.name for path in pictures], [note])


def _by_stem(folder: Path, pictures: Iterable[Path]) -> dict[str, Path]:
    """Return the images as a dictionary, by their names without suffix."""
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
    """Return a sensor's id in brackets; "" for an id generated by Mitsuba."""
    return f" ('{name}')" if re.fullmatch(r"[^\W_][\w-]*", name) else ""
