"""Whether files belong together: those of one run have its id, those of one capture its key."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from svu_mi.errors import CaptureError
from svu_mi.exr import read_header
from svu_mi.results.record import CAPTURE, RUN, entries

HEAD = 4096  # bytes in which a scene file or a mesh has its marks


def marks_of(path: Path) -> tuple[str, str]:
    """Return the id of the run that wrote a file, and the key of its capture.

    Both are empty in files of others, which may have been put there by hand.

    Args:
        path: an EXR file, or one that has its marks in a comment (XML, PLY).

    Raises:
        CaptureError: it cannot be read.
    """
    if path.suffix.lower() == ".exr":
        found = read_header(path).attributes
        return str(found.get(RUN, "")), str(found.get(CAPTURE, ""))
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD).decode("ascii", "replace")
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}).") from error
    words = (re.search(rf"{mark}=([0-9a-f]+)", head) for mark in (RUN, CAPTURE))
    run, capture = (word.group(1) if word else "" for word in words)
    return run, capture


def require_one_run(folder: Path, names: Sequence[str], record: str, command: str) -> None:
    """Refuse files of different runs.

    Args:
        folder: where they are.
        names: of files that one run of ``command`` writes; some may be others'.
        record: name of the record beside them, which need not be there.
        command: that writes them, for the message.

    Raises:
        CaptureError: two are of different runs, or one is of another than the record.
    """
    runs = {name: marks_of(folder / name)[0] for name in names}
    known = [e for e in entries(folder / record) if e.command == command]
    if known:
        runs[record] = known[0].run
    first = next((name for name, run in runs.items() if run), None)
    other = next((n for n, run in runs.items() if run and first and run != runs[first]), None)
    if other is not None:
        raise CaptureError(
            f"{folder}: {first} and {other} come from different runs; take both from one, or run "
            f"svu {command} again, into an empty folder."
        )


def are_of_one_capture(first: Path, second: Path) -> bool:
    """Return whether two files are about one capture, as far as they say.

    Raises:
        CaptureError: one cannot be read.
    """
    keys = [marks_of(path)[1] for path in (first, second)]
    return not all(keys) or keys[0] == keys[1]
