"""Writable folders, atomic replacement of files, marks in headers, JSON, open-file limits."""

import contextlib
import json
import os
import secrets
import tempfile
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from svu_mi.errors import CaptureError, OutputError, SvuError, excerpt

try:
    import fcntl
    import resource
except ImportError:  # Windows
    fcntl = resource = None  # type: ignore[assignment]

MAX_RATIO, FREE = 2000, 2**26  # largest compression ratio; bytes that are always accepted
OURS = ".svu-"  # part of the names of hidden temporary files and folders
LARGEST_JSON = 2**26  # bytes; ten times a capture.json with the most sensors
SUFFIX = 16  # letters of a suffix in temporary names

_stamp: ContextVar[Mapping[str, str] | None] = ContextVar("stamp", default=None)


def prepare_folder(folder: str | Path) -> Path:
    """Create a result folder and check that files can be written there.

    The check takes a millisecond, so that long runs need not fail at their end.

    Raises:
        OutputError: the folder cannot be created, is a file, or is not writable.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise OutputError(f"{folder}: is a file, not a folder; choose another folder.") from error
    except OSError as error:
        raise OutputError(
            f"{folder}: the folder cannot be created ({error.strerror}); choose another folder."
        ) from error
    try:
        # Try it: permission bits do not cover root, read-only mounts and quotas.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OutputError(
            f"{folder}: no file can be written there ({error.strerror}); choose another "
            "folder, or change its permissions."
        ) from error
    return folder


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a new, empty temporary file that replaces ``path`` if the block succeeds.

    All writers of this package use it, so that no reader sees a partial file. The temporary file
    is in the same folder, replaces ``path`` in one step, and is removed if the block raises.

    Raises:
        OutputError: the folder is missing or not writable, or ``path`` is a folder.
    """
    path = Path(path)
    # The suffix stays last: matplotlib and others infer the format from it.
    temporary = path.with_name(f".{secrets.token_hex(8)}{OURS}tmp{path.suffix[:SUFFIX]}")
    descriptor = None
    try:
        # Opened here because the operating system's reason is clearer than OpenEXR's.
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        _lock(descriptor)
        yield temporary
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; remove it, or choose another name.")
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({_reason(path, error)}).") from error
    finally:
        if descriptor is not None:
            os.close(descriptor)
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def clear_temporaries(folder: Path) -> None:
    """Remove temporary files of killed processes from a folder."""
    for path in folder.glob(f".*{OURS}tmp*"):
        with contextlib.suppress(OSError):
            # The file may be foreign: do not follow links, nor wait for a pipe.
            descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
            with os.fdopen(descriptor):
                if _lock(descriptor):
                    path.unlink(missing_ok=True)


def is_temporary(name: str) -> bool:
    """Return whether a file or folder is a temporary one of svu, by its name."""
    return name.startswith(".") and OURS in name


def _lock(descriptor: int) -> bool:
    """Lock an open file until it is closed; return False if that is not possible."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (OSError, AttributeError):  # locked elsewhere, or no lock support
        return False
    return True


@contextlib.contextmanager
def stamped(marks: Mapping[str, str]) -> Iterator[None]:
    """Add marks to the headers of EXR, PLY and scene files that are written in the block.

    Args:
        marks: text by name, such as the id of the run; one line of plain letters each.
    """
    token = _stamp.set(marks)
    try:
        yield
    finally:
        _stamp.reset(token)


def stamp() -> Mapping[str, str]:
    """Return the marks of the enclosing ``stamped`` block; empty outside of one."""
    return _stamp.get() or {}


def mark_text() -> str:
    """Return the marks as ``name=text name=text``, for formats with comments only."""
    return " ".join(f"{name}={text}" for name, text in stamp().items())


def write_text(path: str | Path, text: str) -> None:
    """Write a text file and a final line break, atomically.

    Raises:
        OutputError: an error of ``replacing``.
    """
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def write_json(path: str | Path, record: Any) -> None:
    """Write a JSON file with ``write_text``."""
    write_text(path, json.dumps(record, indent=1))


def _reason(path: Path, error: OSError) -> str:
    if not path.parent.exists():
        return f"the folder {path.parent} does not exist"
    if not path.parent.is_dir():
        return f"{path.parent} is not a folder"
    return error.strerror or type(error).__name__


def may_hold(path: Path, size: int) -> bool:
    """Return whether a compressed file can expand to ``size`` bytes; if not, it is damaged."""
    return size <= max(FREE, MAX_RATIO * path.stat().st_size)


@contextlib.contextmanager
def refusing(label: object, remedy: str, kind: type[SvuError] = CaptureError) -> Iterator[None]:
    """Turn errors of a reader into a sentence: ``LABEL: REASON; REMEDY.``"""
    try:
        yield
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or excerpt(error, 300)
        raise kind(f"{label}: {reason}; {remedy}.") from error


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        CaptureError: the file cannot be read, is too large, or is not JSON.
    """
    with refusing(f"{path}: not a readable JSON file", "correct or replace it"):
        if path.stat().st_size > LARGEST_JSON:
            raise ValueError(f"it has more than {LARGEST_JSON >> 20} MiB")
        # Windows tools write a byte-order mark.
        return json.loads(path.read_text(encoding="utf-8-sig"))


def require_files(more: int) -> None:
    """Raise the limit of open files (usually 256 or 1024) if ``more`` files exceed it."""
    if resource is None:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or (count := _open_files(soft) + more) <= soft:
        return
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))
    except (OSError, ValueError) as error:
        raise CaptureError(
            f"Photographs in files need {count} open files, but ulimit -n allows {soft}; raise the "
            "limit, or increase --memory."
        ) from error


def _open_files(most: int) -> int:
    """Return the number of open files of this process; ``most`` if it cannot be counted."""
    try:
        return len(os.listdir("/dev/fd"))
    except OSError:
        return most
