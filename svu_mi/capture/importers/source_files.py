"""Files of a capture: safe paths, folders of photographs and masks, lines of text."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from svu_mi.capture.image_formats.recognition import SUFFIXES, without_raw_doubles
from svu_mi.core.identifiers import fits_file_name
from svu_mi.core.io.files import refusing
from svu_mi.errors import CaptureError, excerpt

LONGEST_PATH = 2048  # bytes
CONTROL = re.compile(r"[\0-\x1f\x7f-\x9f]")  # invalid in names, and executed by terminals
SHOWN = 60  # characters of a name in a message
LARGEST_TEXT = 2**24  # bytes


def safe_path(root: Path, name: Any, label: str) -> Path:
    r"""Return the path of a file from its name relative to a folder; it need not exist.

    ``\`` also separates folders, as on Windows. Links are allowed: the owner of the folder made
    them. Other paths outside of the folder raise CaptureError. ``label`` (file and frame) begins
    its message.
    """
    if not isinstance(name, str):
        raise CaptureError(f"{label}: a file's name must be text, got a {type(name).__name__}.")
    shown = excerpt(ascii(name), SHOWN)
    parts = PurePosixPath(os.path.normpath(name.replace("\\", "/"))).parts
    if PureWindowsPath(name).drive or name.startswith(("/", "\\")) or ".." in parts[:1]:
        raise CaptureError(
            f"{label}: {shown} lies outside {root}; move the file into it and give its "
            "path relative to that folder."
        )
    path = root.joinpath(*parts)
    is_short = all(map(fits_file_name, parts)) and len(os.fsencode(path)) <= LONGEST_PATH
    if not name or not parts or not is_short or CONTROL.search("".join(parts)):
        raise CaptureError(f"{label}: {shown} is not a valid file name; rename the file.")
    return path


def relative_name(root: Path, file: Path) -> str:
    """Return the path of a file relative to a folder; its name if it is elsewhere."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def find_folder(kind: str, asked: Path | None, places: Iterable[Path]) -> Path | None:
    """Return the folder of ``images`` or ``masks``: ``asked``, or the first that exists."""
    if asked is None:
        return next((place for place in places if place.is_dir()), None)
    if not asked.is_dir():
        raise missing_folder(kind, asked)
    return asked


def missing_folder(kind: str, folder: Path) -> CaptureError:
    """Return the error for a missing folder of ``images`` or ``masks``."""
    what = "photographs" if kind == "images" else kind
    return CaptureError(f"{folder}: no such folder; give the folder of the {what} with --{kind}.")


def find_photographs(
    root: Path, asked: Path | None, names: Sequence[str], poses: Path, count: int
) -> list[Path]:
    """Return the photographs for poses without file names, sorted by name.

    They are in the folder ``asked``, or in the first existing one of ``names`` below ``root``.
    """
    folder = find_folder("images", asked, (root / name for name in names))
    if folder is None:
        raise missing_folder("images", root / names[0])
    files = list_pictures(folder)
    if len(files) != count:
        raise CaptureError(
            f"{folder}: has {len(files)} photographs, but {poses} has {count} poses; give a "
            "folder with only the posed photographs with --images."
        )
    return files


def list_pictures(folder: Path) -> list[Path]:
    """Return the pictures in a folder sorted by name, without hidden files."""
    with refusing(folder, "change its permissions"):
        files = sorted(folder.iterdir())
    known = [file for file in files if file.suffix.lower() in SUFFIXES]
    known = [file for file in known if not file.name.startswith(".") and file.is_file()]
    return without_raw_doubles(known)


def find_mask(folder: Path, name: Path) -> Path | None:
    """Return the mask of the photograph ``name`` (a relative path) in a folder, or None.

    The mask of ``a.jpg`` is ``a.jpg.png``, ``a.jpg``, or ``a`` with any suffix.
    """
    stems = [folder / name.with_suffix(suffix) for suffix in SUFFIXES]
    names = (folder / f"{name}.png", folder / name, *stems)
    return next((file for file in names if file.is_file()), None)


def read_lines(path: Path, what: str, fix: str) -> Iterator[tuple[int, str]]:
    """Yield each non-empty line of a file without comments (``#``): its number and its text.

    Files that are missing, larger than 16 MiB or not text raise CaptureError; its message contains
    ``what``, such as ``a list of exposures``, and the remedy ``fix``.
    """
    with refusing(f"{path}: not {what} that can be read", fix):
        if path.stat().st_size > LARGEST_TEXT:
            raise ValueError("more than 16 MiB")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if text:
            yield number, text
