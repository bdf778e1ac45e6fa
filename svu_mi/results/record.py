"""What the record of a folder says about its results: which run wrote which file.

A record is a JSON file such as ``run.json``. Its ``written`` is the last run; ``beside`` are those
of other commands that still lie in the folder. Files are known by a digest: one that somebody has
changed since is no longer the run's own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from svu_mi.errors import CaptureError
from svu_mi.files import read_json

RESULT, BESIDE = "written", "beside"
RUN, CAPTURE = "svu:run", "svu:capture"  # marks in every EXR, PLY and scene file of a result
LIGHT, LIGHT_RECORD = "light", "light.json"  # command whose result may lie below a capture
RECORDS = (
    "run.json", "asset.json", "check.json", "compare.json", LIGHT_RECORD, "capture.json"
)  # fmt: skip
LONGEST = 1024  # letters of a name
MAX_BYTES = 2**26  # of a record


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One result.

    Attributes:
        run: id of the run, as in the header of each of its EXR files (``svu:run``).
        command: that wrote it: render, entropy, ...
        capture: key of the capture that it is about, empty where that is not known.
        files: digest by name, relative to the folder, with slashes.
    """

    run: str
    command: str
    capture: str
    files: Mapping[str, str]

    @classmethod
    def parse(cls, value: Any) -> Entry | None:
        """Return what a record says; None for anything but an entry that can be trusted."""
        try:
            files = {name: digest for name, digest in value["files"].items() if is_inside(name)}
            words = value["run"], value["command"], value["capture"], *files.values()
        except (TypeError, KeyError, AttributeError):
            return None
        if len(files) < len(value["files"]) or not all(isinstance(word, str) for word in words):
            return None
        return cls(run=words[0], command=words[1], capture=words[2], files=files)

    def owns(self, folder: Path, name: str) -> bool:
        """Return whether a file is still the one that the run wrote."""
        path = folder / name
        try:
            return (
                name in self.files
                and link_above(folder, name) is None
                and path.is_file()
                and not path.is_symlink()
                and digest_of(path) == self.files[name]
            )
        except OSError:
            return False


def entries(record: Path) -> list[Entry]:
    """Return the results that a record names, the last one first; none if it cannot be read."""
    try:
        short = record.is_file() and record.stat().st_size <= MAX_BYTES
        found = read_json(record) if short else {}
    except (CaptureError, OSError):
        return []
    if not isinstance(found, dict):
        return []
    beside = found.get(BESIDE)
    values = [found.get(RESULT), *(beside if isinstance(beside, list) else [])]
    return [entry for entry in map(Entry.parse, values) if entry is not None]


def entries_in(folder: Path) -> list[Entry]:
    """Return the results that any record of a folder names."""
    return [entry for record in RECORDS for entry in entries(folder / record)]


def is_as_written(folder: Path, record: str) -> bool:
    """Return whether a folder has all files of its last result, unchanged."""
    found = entries(folder / record)
    return bool(found) and all(found[0].owns(folder, name) for name in found[0].files)


def is_inside(name: Any) -> bool:
    """Return whether a text names a file below a folder, and nothing above or beside it."""
    if not isinstance(name, str) or not 0 < len(name) <= LONGEST or not name.isprintable():
        return False
    path = PurePosixPath(name)
    plain = "\\" not in name and ":" not in name and name == path.as_posix()
    return plain and not path.is_absolute() and ".." not in path.parts and name != "."


def link_above(folder: Path, name: str) -> Path | None:
    """Return what stands in the way to a file: a link, or anything but a folder, if any does."""
    here = folder
    for part in PurePosixPath(name).parts[:-1]:
        here = here / part
        if here.is_symlink() or (here.exists() and not here.is_dir()):
            return here
    return None


def digest_of(path: Path) -> str:
    """Return 32 hexadecimal digits that tell the contents of a file.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
