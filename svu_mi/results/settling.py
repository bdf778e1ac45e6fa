"""Putting a result that is whole in its place: by its writer, or by whoever comes next.

A folder named ``.svu-ready-ID`` holds the files, and a journal of what else is to be done. All of
it may be stopped at any point and begun again. The folder may be a stranger's: nothing outside of
it is touched.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from svu_mi.errors import CaptureError, OutputError, excerpt
from svu_mi.files import read_json
from svu_mi.results.lock import locked
from svu_mi.results.record import is_inside, link_above

READY, JOURNAL = ".svu-ready-", ".journal.json"
PATIENCE = 10.0  # seconds that a reader waits for files that are being moved


def settle(folder: str | Path) -> None:
    """Complete a result that a killed run had finished writing but not moved to its place.

    Every reader of a folder calls this first; it costs one look into the folder.

    Raises:
        OutputError: it cannot be completed, as the folder is read only, or is being written.
    """
    folder = Path(folder)
    if _ready(folder):
        with locked(folder, "svu", wait=PATIENCE):
            complete(folder)


def _ready(folder: Path) -> list[Path]:
    def is_ready(entry: os.DirEntry[str]) -> bool:
        named = re.fullmatch(rf"{READY}[0-9a-f]{{16}}", entry.name)
        return named is not None and entry.is_dir(follow_symlinks=False)

    try:
        with os.scandir(folder) as found:
            return sorted(folder / entry.name for entry in found if is_ready(entry))
    except OSError:
        return []


def complete(folder: Path, *ready: Path) -> None:
    """Move what is ready to its place."""
    for one in ready or _ready(folder):
        try:
            _move(folder, one)
        except OSError as error:
            raise OutputError(
                f"{folder}: the result is complete in {one.name}, but cannot be moved into place "
                f"({error.strerror or type(error).__name__}); the next command that reads or "
                "writes there will try again."
            ) from error


def _move(folder: Path, ready: Path) -> None:
    """Do what is left of the journal; may be stopped and begun again at any point."""
    journal = _journal(ready)
    if journal is not None:
        for name, other in journal["keep"].items():
            if os.path.lexists(ready / name) and not os.path.lexists(_at(folder, other)):
                with contextlib.suppress(FileNotFoundError):
                    _at(folder, name).rename(_at(folder, other))
        for name in journal["remove"]:
            _at(folder, name).unlink(missing_ok=True)
            _remove_if_empty(_at(folder, name).parent, folder)
        names = [name for name in names_in(ready) if name not in (JOURNAL, journal["record"])]
        for name in (*names, journal["record"]):
            _at(folder, name).parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # moved before
                _at(ready, name).replace(_at(folder, name))
    shutil.rmtree(ready, ignore_errors=True)


def _at(folder: Path, name: str) -> Path:
    """Return where a file of a journal is; the folder may be a stranger's.

    Raises:
        OutputError: it would be outside of the folder, at the other end of a link.
    """
    if not is_inside(name) or link_above(folder, name) is not None:
        raise OutputError(
            f"{folder}: {excerpt(name, 80)}, left by an interrupted run, leads out of the "
            f"folder; remove the hidden folders {READY}... there, and compute the result again."
        )
    return folder / name


def _journal(ready: Path) -> dict[str, Any] | None:
    """Return what is to be done; None when nothing is left, as the journal is removed last.

    Raises:
        OutputError: it is not a journal.
    """
    path = ready / JOURNAL
    if not path.is_file():
        return None
    try:
        found = read_json(path)
        lists = [found["record"]], found["remove"], list(found["keep"]), found["keep"].values()
        if all(is_inside(name) for names in lists for name in names):
            return dict(found)
    except (CaptureError, KeyError, TypeError, AttributeError):
        pass
    raise OutputError(
        f"{ready}: its {JOURNAL} was not written by svu; remove this folder, and compute the "
        "result again."
    )


def _remove_if_empty(place: Path, folder: Path) -> None:
    with contextlib.suppress(OSError):
        if place != folder:
            place.rmdir()


def names_in(folder: Path) -> list[str]:
    """Return the files below a folder, with slashes; a link to a folder counts as a file."""
    return sorted(walk(folder))


def walk(folder: Path, *, empty: bool = False) -> Iterator[str]:
    """Yield the files below a folder; with ``empty``, folders without anything in them, too."""
    for root, folders, files in os.walk(folder):
        here = Path(root).relative_to(folder)
        for name in sorted((*files, *folders)):
            if not is_folder(Path(root) / name):
                yield (here / name).as_posix()
        if empty and not (files or folders) and here != Path():
            yield here.as_posix()


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder itself, and no link to one."""
    return path.is_dir() and not path.is_symlink()
