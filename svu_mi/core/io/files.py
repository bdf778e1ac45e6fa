"""Files: folders that can be written, results that are whole or not there, JSON that is read."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import tempfile
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from svu_mi.errors import CaptureError, OutputError, excerpt

try:
    import fcntl
    import resource
except ImportError:  # Windows
    fcntl = resource = None  # type: ignore[assignment]

MAX_RATIO, FREE = 2000, 2**26  # no codec packs more; bytes that are harmless anyway
OURS = ".svu-"  # in the names of temporary files and folders, which are hidden
STEM = 100  # letters of a name that its temporary name has, too: names have an end

_stamp: ContextVar[Mapping[str, str] | None] = ContextVar("stamp", default=None)


def prepare_folder(folder: str | Path) -> Path:
    """Make a folder for results and check that files can be written there.

    Worth calling before a long run: it fails in a millisecond.

    Raises:
        OutputError: it cannot be made, is a file, or is not writable.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise OutputError(f"{folder}: is a file, not a folder; choose another folder.") from error
    except OSError as error:
        raise OutputError(
            f"{folder}: the folder cannot be made ({error.strerror}); choose another folder."
        ) from error
    try:
        # Permissions do not tell: root, read-only mounts and quotas are known by trying.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OutputError(
            f"{folder}: no file can be written there ({error.strerror}); choose another "
            "folder, or change its permissions."
        ) from error
    return folder


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a new, empty temporary file that becomes ``path`` when the block succeeds.

    Every writer of this package goes through here, so a reader never meets half a file: the
    temporary one lies in the same folder, replaces ``path`` in one step, and is removed if
    the block raises.

    Raises:
        OutputError: the folder is missing or not writable, or ``path`` is a folder.
    """
    path = Path(path)
    # The suffix stays last: writers such as matplotlib go by it.
    unique = f"{secrets.token_hex(4)}{OURS}tmp"
    temporary = path.with_name(f".{path.stem[:STEM]}.{unique}{path.suffix[:STEM]}")
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
    """Remove the temporary files that killed processes have left in a folder."""
    for path in folder.glob(f".*{OURS}tmp*"):
        with contextlib.suppress(OSError):
            # A stranger's link is not followed, and a pipe not waited for.
            descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
            with os.fdopen(descriptor):
                if _lock(descriptor):
                    path.unlink(missing_ok=True)


def is_temporary(name: str) -> bool:
    """Return whether a file or folder is a hidden one of svu."""
    return name.startswith(".") and OURS in name


def _lock(descriptor: int) -> bool:
    """Lock an open file until its process ends; return whether no other one holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (OSError, AttributeError):  # or there are no locks
        return False
    return True


@contextlib.contextmanager
def stamped(marks: Mapping[str, str]) -> Iterator[None]:
    """Put marks into the header of every EXR, PLY and scene file that is written in the block.

    Args:
        marks: text by name, such as the id of the run; one line of plain letters each.
    """
    token = _stamp.set(marks)
    try:
        yield
    finally:
        _stamp.reset(token)


def stamp() -> Mapping[str, str]:
    """Return the marks of what is being written; none outside of ``stamped``."""
    return _stamp.get() or {}


def mark_text() -> str:
    """Return the marks as ``name=text name=text``, for formats that have comments only."""
    return " ".join(f"{name}={text}" for name, text in stamp().items())


def write_text(path: str | Path, text: str) -> None:
    """Write a text file with a line break at its end, whole or not at all.

    Raises:
        OutputError: as ``replacing``.
    """
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def write_json(path: str | Path, record: Any) -> None:
    """Write a JSON file (errors as ``write_text``)."""
    write_text(path, json.dumps(record, indent=1))


def _reason(path: Path, error: OSError) -> str:
    if not path.parent.exists():
        return f"there is no folder {path.parent}"
    if not path.parent.is_dir():
        return f"{path.parent} is not a folder"
    return error.strerror or type(error).__name__


def may_hold(path: Path, size: int) -> bool:
    """Whether a packed file can unpack to so many bytes; one that cannot is damaged, or a trap."""
    return size <= max(FREE, MAX_RATIO * path.stat().st_size)


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        CaptureError: it cannot be read, or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))  # Windows' tools write a mark first
    except (OSError, ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: not a readable JSON file ({excerpt(error)}).") from error


def require_files(more: int) -> None:
    """Let this process open so many more files; a system's default is 1024 in all, or 256."""
    if resource is None:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or (count := _open_files(soft) + more) <= soft:
        return
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))
    except (OSError, ValueError) as error:
        raise CaptureError(
            f"Photographs in files need {count} open files, ulimit -n allows {soft}; raise it, or "
            "give --memory more."
        ) from error


def _open_files(most: int) -> int:
    """Return how many files this process has open; ``most`` where there is none left to ask by."""
    try:
        return len(os.listdir("/dev/fd"))
    except OSError:
        return most
