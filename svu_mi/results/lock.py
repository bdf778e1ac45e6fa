"""One writer at a time: a lock on a folder, or on a file, that ends with its process."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from svu_mi.errors import OutputError, excerpt

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

LOCK = ".svu-lock"
UNKNOWN = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
PAUSE = 0.05  # seconds between two tries

_held: dict[Path, tuple[int, int]] = {}  # thread, and how often it has locked, by lock file
_guard = threading.Lock()


@contextlib.contextmanager
def locked(place: Path, who: str, wait: float = 0) -> Iterator[None]:
    """Keep other processes, and other threads of this one, from writing to a place.

    The operating system gives the lock up when a process ends, however it ends: no lock is ever
    stale. A thread may lock a place that it has locked already.

    Args:
        place: a folder that exists, or a file, which need not.
        who: what the others are told is at work, such as ``svu recover``.
        wait: seconds to wait for another process.

    Raises:
        OutputError: another one is at work there.
    """
    path = _file_of(place)
    if _enter_again(path, place, who):
        try:
            yield
        finally:
            _leave(path)
        return
    try:
        stream = _acquire(path, place, who, wait)
    except BaseException:
        _leave(path)
        raise
    try:
        yield
    finally:
        if stream is not None:
            # Removed while it is held: whoever has opened it meanwhile sees that it is gone.
            with contextlib.suppress(OSError):
                path.unlink()
            stream.close()
        _leave(path)


def _file_of(place: Path) -> Path:
    place = place.resolve()
    return place / LOCK if place.is_dir() else place.with_name(f".{place.name[:200]}{LOCK}")


def _enter_again(path: Path, place: Path, who: str) -> bool:
    """Note that this thread is in; return whether it was before."""
    mine = threading.get_ident()
    with _guard:
        thread, depth = _held.get(path, (mine, 0))
        if thread != mine:
            raise _occupied(place, f"another thread ({who})")
        _held[path] = (mine, depth + 1)
    return depth > 0


def _leave(path: Path) -> None:
    with _guard:
        thread, depth = _held.pop(path)
        if depth > 1:
            _held[path] = (thread, depth - 1)


def _acquire(path: Path, place: Path, who: str, wait: float) -> IO[str] | None:
    """Return the locked file; None where the file system knows no locks."""
    deadline = time.monotonic() + wait
    while True:
        try:
            stream = path.open("a+", encoding="utf-8", errors="replace")
        except OSError as error:
            raise OutputError(
                f"{place}: cannot be locked for writing ({error.strerror}); choose another folder."
            ) from error
        try:
            _try(stream)
            if _is_at(stream, path):
                stream.truncate(0)
                stream.write(f"{who}, process {os.getpid()} on {socket.gethostname()}")
                stream.flush()
                return stream
            stream.close()  # the one before has removed it in between
        except OSError as error:
            other = _reader(stream)
            stream.close()
            if error.errno in UNKNOWN:
                log.warning("%s: locks are not known there; let no two runs write to it.", place)
                return None
            if error.errno == errno.ENOSPC:
                raise OutputError(f"{place}: cannot be written ({error.strerror}).") from error
            if time.monotonic() >= deadline:
                raise _occupied(place, other) from error
            time.sleep(PAUSE)


def _try(stream: IO[str]) -> None:
    if fcntl is not None:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    import msvcrt

    stream.seek(0)
    msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]


def _is_at(stream: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except OSError:
        return False


def _reader(stream: IO[str]) -> str:
    """Return who holds the lock, as it has said itself."""
    try:
        stream.seek(0)
        return excerpt(stream.read(200))
    except OSError:
        return ""


def _occupied(place: Path, other: str) -> OutputError:
    return OutputError(
        f"{place}: {other or 'another svu'} is writing there; wait for it, or choose another "
        "folder."
    )
