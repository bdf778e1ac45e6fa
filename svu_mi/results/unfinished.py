"""Drafts that outlive their run: what an interrupted command has done, for another to go on with.

Such a draft has a key in its name, which says what is being made; its files are whole, and those
that are there need not be made again.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from svu_mi.errors import OutputError
from svu_mi.files import clear_temporaries
from svu_mi.results.settling import is_folder, names_in

KEY = 16  # letters of a key, hexadecimal
NAME = ".svu-draft-kept-"
PATTERN = re.compile(rf"{re.escape(NAME)}([0-9a-f]{{16}})-([0-9a-f]{{{KEY}}})")


@dataclass(frozen=True)
class Unfinished:
    """A draft that was kept.

    Attributes:
        folder: where it lies.
        run: id of the run that has begun it, which its files are marked with.
        key: what is being made.
    """

    folder: Path
    run: str
    key: str

    @property
    def files(self) -> int:
        """How many there are."""
        return len(names_in(self.folder))


def unfinished(target: str | Path) -> list[Unfinished]:
    """Return what interrupted runs have left in a folder."""
    target = Path(target)
    found = []
    for path in sorted(target.glob(f"{NAME}*")) if target.is_dir() else ():
        if (match := PATTERN.fullmatch(path.name)) and is_folder(path):
            found.append(Unfinished(path, match[1], match[2]))
    return found


def begun(target: Path, run: str, key: str) -> tuple[str, Path]:
    """Return the run and the folder of a draft that is to be kept, or was.

    Args:
        target: a folder that is locked.
        run: id of the run, if no earlier one has begun it.
        key: what is being made.
    """
    for one in unfinished(target):
        if one.key == key:
            return one.run, one.folder
    return run, target / f"{NAME}{run}-{key}"


def prepare(target: Path, key: str, resume: bool) -> None:
    """Keep what can be gone on with, and nothing else.

    Args:
        target: a folder that is locked.
        key: what is going to be made.
        resume: whether to go on.

    Raises:
        OutputError: ``resume``, and there is nothing, or only something else.
    """
    left = unfinished(target)
    if resume and not left:
        raise OutputError(
            f"{target}: there is nothing of an interrupted run to resume; omit --resume."
        )
    if resume and key not in {one.key for one in left}:
        raise OutputError(
            f"{target}: what an interrupted run has left was made with other options, or of "
            "something else; restore these, or omit --resume to start again."
        )
    for one in left:
        if resume and one.key == key:
            clear_temporaries(one.folder)
        else:
            shutil.rmtree(one.folder, ignore_errors=True)
