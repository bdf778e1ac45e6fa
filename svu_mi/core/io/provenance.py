"""Provenance of result files: their run and capture, from records and file headers.

A record is a JSON file such as ``run.json``. Its entry ``written`` contains the digests of the
files of the run, which identify edited files. EXR, PLY and scene files contain marks: the id of
their run and the key of their capture.
"""

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from svu_mi.core.io.exr import read_header
from svu_mi.core.io.files import is_temporary, read_json, refusing
from svu_mi.core.io.hashes import digest_of_file
from svu_mi.core.io.schema import NAMES, TEXT, Field, checked
from svu_mi.errors import CaptureError, excerpt

RESULT = "written"  # key of the entry in a record
RUN, CAPTURE = "svu:run", "svu:capture"  # names of marks
LIGHT, LIGHT_RECORD = "light", "light.json"
RUN_RECORD = "run.json"
RECORDS = (RUN_RECORD, "asset.json", "check.json", "compare.json", LIGHT_RECORD, "capture.json")
CAPTURES = ("render", "import")  # commands whose results are captures
LONGEST = 1024  # letters of a file name
ENTRY = {name: Field(TEXT) for name in ("run", "command", "capture")}
ENTRY["files"] = Field(TEXT, (NAMES,))
HEAD = 4096  # bytes at the start of a scene file or mesh that contain its marks


@dataclass(frozen=True)
class Entry:
    """Entry of a record about one result.

    Attributes:
        run: id of the run, as in the marks of its files.
        command: name of the command, such as ``entropy``.
        capture: key of the capture; empty if unknown.
        files: digest of each file, by its path relative to the folder, with slashes.
    """

    run: str
    command: str
    capture: str
    files: Mapping[str, str]

    @classmethod
    def parse(cls, value: Any) -> "Entry | None":
        """Return the entry of a JSON value; None if it is invalid."""
        try:
            entry = cls(**checked(value, ENTRY))
        except ValueError:
            return None
        return entry if all(map(is_inside, entry.files)) else None

    def owns(self, folder: Path, name: str) -> bool:
        """Return whether a file is unchanged since the run."""
        path = folder / name
        try:
            return (
                name in self.files
                and path.is_file()
                and not path.is_symlink()
                and digest_of_file(path) == self.files[name]
            )
        except OSError:
            return False


def entry_of(record: Path, command: str = "") -> Entry | None:
    """Return the entry of a record; None if unreadable, or written by another command."""
    try:
        content = read_json(record) if record.is_file() else {}
    except (CaptureError, OSError):
        return None
    entry = Entry.parse(content.get(RESULT)) if isinstance(content, dict) else None
    return entry if entry is not None and command in ("", entry.command) else None


def entries_in(folder: Path) -> dict[str, Entry]:
    """Return the entries of all records in a folder, by the name of the record."""
    entries = {name: entry_of(folder / name) for name in RECORDS}
    return {name: entry for name, entry in entries.items() if entry is not None}


def is_inside(name: Any) -> bool:
    """Return whether a text is the relative path of a file below a folder."""
    if not isinstance(name, str) or not 0 < len(name) <= LONGEST or not name.isprintable():
        return False
    path = PurePosixPath(name)
    plain = "\\" not in name and ":" not in name and name == path.as_posix()
    return plain and not path.is_absolute() and ".." not in path.parts and name != "."


def files_in(folder: Path) -> list[str]:
    """Return the relative paths of all files below a folder, except svu's temporary ones.

    A link to a folder counts as a file.

    Raises:
        OSError: a folder cannot be read.
    """
    names = []
    for root, folders, files in os.walk(folder, onerror=_refuse):
        paths = (Path(root, name) for name in (*files, *folders))
        names += [p.relative_to(folder) for p in paths if p.is_symlink() or not p.is_dir()]
    return sorted(name.as_posix() for name in names if not any(map(is_temporary, name.parts)))


def _refuse(error: OSError) -> None:
    raise error


def marks_of(path: Path) -> tuple[str, str]:
    """Return the marks of a file: run id and capture key; empty in files of other programs."""
    if path.suffix.lower() == ".exr":
        attributes = read_header(path).attributes
        return str(attributes.get(RUN, "")), str(attributes.get(CAPTURE, ""))
    with refusing(path, "change its permissions"), path.open("rb") as stream:
        head = stream.read(HEAD).decode("ascii", "replace")
    run, capture = (re.search(rf"{mark}=([0-9a-f]+)", head) for mark in (RUN, CAPTURE))
    return run[1] if run else "", capture[1] if capture else ""


def require_one_run(folder: Path, names: Sequence[str], record: str, command: str) -> None:
    """Raise CaptureError if files come from different runs."""
    runs = {name: marks_of(folder / name)[0] for name in names}
    if (entry := entry_of(folder / record, command)) is not None:
        runs[record] = entry.run
    first = next((name for name, run in runs.items() if run), None)
    other = next((n for n, run in runs.items() if run and first and run != runs[first]), None)
    if other is not None:
        raise CaptureError(
            f"{folder}: {first} and {other} come from different runs; take both from one "
            f"run, or run svu {command} again, into an empty folder."
        )


def are_of_one_capture(first: Path, second: Path) -> bool:
    """Return whether the marks of two files have the same capture; True if one has none."""
    keys = [marks_of(path)[1] for path in (first, second)]
    return not all(keys) or keys[0] == keys[1]


def mesh_of(record: Path, run: str) -> str:
    """Return the mesh digest in a record; empty if the record is not of the run ``run``."""
    entry = entry_of(record)
    known = bool(run) and entry is not None and entry.run == run
    return text_in(read_json(record), "inputs", "mesh") if known else ""


def text_in(record: Any, *names: str) -> str:
    """Return ``record[names[0]][names[1]]...``, a text in a JSON object; empty if missing."""
    for name in names:
        record = record.get(name) if isinstance(record, dict) else None
    return record if isinstance(record, str) else ""


def require_no_result(folder: Path) -> None:
    """Raise CaptureError if a folder contains a result other than a capture."""
    entries = entries_in(folder)
    if others := [entry.command for entry in entries.values() if entry.command not in CAPTURES]:
        record = read_json(folder / RUN_RECORD) if RUN_RECORD in entries else None
        given = {name: text_in(record, "settings", "given", name) for name in ("scene", "images")}
        words = [given["scene"], *(["--images", given["images"]] if given["images"] else [])]
        source = shlex.join(words) if words[0] else text_in(record, "inputs", "source")
        raise CaptureError(
            f"{folder}: is a result of svu {excerpt(others[0], 40)}; give the capture it was "
            + (f"computed from ({excerpt(source, 300)})." if source else "computed from.")
        )


def require_recovery(folder: Path, names: Sequence[str], record: str, other: str) -> None:
    """Raise CaptureError if a folder lacks the files ``names`` of ``svu recover``."""
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; give one that svu recover wrote.")
    missing = [name for name in names if not (folder / name).is_file()]
    if not missing:
        return
    if entry_of(folder / record, "recover") is not None:
        what = "which svu recover wrote; run it again."
    elif (folder / other).is_file():
        what = (
            "so it is not a result of svu recover but of svu entropy; run svu recover on the same "
            "capture, and give its output folder."
        )
    else:
        what = "so it is not a result of svu recover; run that first, or give its output folder."
    raise CaptureError(f"{folder}: has no {', '.join(missing)}, {what}")
