"""Whether files belong together: those of one run have its id, those of one capture its key."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from svu_mi.errors import CaptureError, excerpt
from svu_mi.exr import read_header
from svu_mi.files import read_json
from svu_mi.results.record import CAPTURE, RUN, entries, entries_in
from svu_mi.results.unfinished import unfinished

CAPTURES = ("render", "import")  # commands whose results are captures
RUN_RECORD = "run.json"
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


def mesh_of(record: Path, run: str) -> str:
    """Return the digest of the mesh that files of a run are over, as the record beside them says.

    Args:
        record: which need not be there.
        run: id of the run, as in the files' marks; empty in those of others.

    Returns:
        Empty, where it is not known: the record is missing, or that of another run.
    """
    known = entries(record)
    if not (run and known and known[0].run == run):
        return ""
    return _said(record, "inputs", "mesh")


def scene_of(record: Path) -> Path | None:
    """Return the scene or the capture that ``svu`` was given; None where a record does not say."""
    scene = _said(record, "settings", "given", "scene")
    return Path(scene) if scene else None


def _said(record: Path, *names: str) -> str:
    """Return a text that a record holds under names, one in the other; empty if it has none."""
    return text_in(read_json(record) if entries(record) else None, *names)


def text_in(record: Any, *names: str) -> str:
    """Return a text that what was read of JSON holds under names; empty if it has none."""
    for name in names:
        record = record.get(name) if isinstance(record, dict) else None
    return record if isinstance(record, str) else ""


def require_no_result(folder: Path) -> None:
    """Refuse a folder that was given as a capture, if it is what a command has made of one.

    Raises:
        CaptureError: it is, or holds what an interrupted run has left.
    """
    if unfinished(folder):
        raise CaptureError(
            f"{folder}: holds an interrupted svu render; finish it with the same command and "
            "--resume."
        )
    found = next((e.command for e in entries_in(folder) if e.command not in CAPTURES), None)
    if found is not None:
        source = _said(folder / RUN_RECORD, "inputs", "source")
        raise CaptureError(
            f"{folder}: is a result of svu {excerpt(found, 40)}; give the capture it was made of"
            + (f" ({excerpt(source, 300)})." if source else ".")
        )


def require_recovery(folder: Path, names: Sequence[str], record: str, other: str) -> None:
    """Refuse a folder without what ``svu recover`` writes, and say what it is instead.

    Args:
        folder: that is read.
        names: of the files that are needed.
        record: name of the record beside them, which need not be there.
        other: name of a file by which a result of ``svu entropy`` is known.

    Raises:
        CaptureError: one is missing.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; give one that svu recover wrote.")
    missing = [name for name in names if not (folder / name).is_file()]
    if not missing:
        return
    words = f"{folder}: has no {', '.join(missing)}"
    if any(entry.command == "recover" for entry in entries(folder / record)):
        raise CaptureError(f"{words}, which svu recover wrote; run it again.")
    words += ", so it is not a result of svu recover"
    if (folder / other).is_file():
        raise CaptureError(
            f"{words} but of svu entropy; run svu recover on the same capture, and give what it "
            "writes."
        )
    raise CaptureError(f"{words}; run that first, or give the folder that it wrote.")
