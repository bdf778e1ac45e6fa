"""One writer at a time: a lock on a folder, or on a file, that ends with its process."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
import stat
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from svu_mi.errors import OutputError, excerpt

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

LOCK = ".svu-lock"
UNKNOWN = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
PAUSE = 0.05  # seconds between two tries
LONGEST = 200  # letters of the name of a file that is locked, and of who has locked it
# The file may be a stranger's: a link is not followed, a pipe not waited for.
FLAGS = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


@dataclass
class _Held:
    """What this process has of a lock: which thread is in, how often, and the open file."""

    gate: threading.RLock = field(default_factory=threading.RLock)
    depth: int = 0
    descriptor: int | None = None


_held: dict[Path, _Held] = {}


@contextlib.contextmanager
def locked(place: Path, who: str, wait: float = 0) -> Iterator[bool]:
    """Keep other processes, and other threads of this one, from writing to a place.

    The operating system gives the lock up when a process ends, however it ends: no lock is ever
    stale. A thread may lock a place that it has locked already.

    Args:
        place: a folder that exists, or a file, which need not.
        who: what the others are told is at work, such as ``svu recover``.
        wait: seconds to wait for the others.

    Yields:
        Whether others are kept out; False where the file system knows no locks.

    Raises:
        OutputError: another one is at work there.
    """
    path = _file_of(place)
    held = _held.setdefault(path, _Held())
    if not held.gate.acquire(timeout=max(wait, 0)):
        raise _occupied(place, "another thread of this process")
    try:
        if held.depth == 0:
            held.descriptor = _acquire(path, place, who, wait)
        held.depth += 1
        try:
            yield held.descriptor is not None
        finally:
            held.depth -= 1
            if held.depth == 0 and held.descriptor is not None:
                # Removed while it is held: whoever has opened it meanwhile sees that it is gone.
                with contextlib.suppress(OSError):
                    path.unlink()
                os.close(held.descriptor)
    finally:
        held.gate.release()


def _file_of(place: Path) -> Path:
    place = place.resolve()
    return place / LOCK if place.is_dir() else place.with_name(f".{place.name[:LONGEST]}{LOCK}")


def _acquire(path: Path, place: Path, who: str, wait: float) -> int | None:
    """Return the descriptor of the locked file; None where the file system knows no locks."""
    deadline = time.monotonic() + wait
    while True:
        descriptor = _open(path, place)
        try:
            _try(descriptor)
            if _is_at(descriptor, path):
                _sign(descriptor, f"{who}, process {os.getpid()} on {socket.gethostname()}")
                return descriptor
            os.close(descriptor)  # the one before has removed it in between
        except OSError as error:
            other = _signature(descriptor)
            os.close(descriptor)
            if error.errno in UNKNOWN:
                log.warning("%s: locks do not work there; let only one run write to it.", place)
                return None
            if time.monotonic() >= deadline:
                raise _occupied(place, other) from error
            time.sleep(PAUSE)


def _open(path: Path, place: Path) -> int:
    reason = "it was not made by svu"
    try:
        descriptor = os.open(path, FLAGS, 0o666)
        status = os.fstat(descriptor)
        if stat.S_ISREG(status.st_mode) and status.st_nlink <= 1:
            return descriptor
        os.close(descriptor)
    except OSError as error:
        reason = error.strerror or type(error).__name__
    raise OutputError(
        f"{place}: cannot be locked for writing with {path.name} ({reason}); remove it, or choose "
        "another folder."
    )


def _try(descriptor: int) -> None:
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    import msvcrt

    os.lseek(descriptor, 0, os.SEEK_SET)
    msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except OSError:
        return False


def _sign(descriptor: int, text: str) -> None:
    with contextlib.suppress(OSError):  # a full disk; it is a courtesy
        os.ftruncate(descriptor, 0)
        os.write(descriptor, text.encode(errors="replace"))


def _signature(descriptor: int) -> str:
    """Return who holds the lock, as it has said itself."""
    try:
        os.lseek(descriptor, 0, os.SEEK_SET)
        return excerpt(os.read(descriptor, LONGEST).decode(errors="replace"))
    except OSError:
        return ""


def _occupied(place: Path, other: str) -> OutputError:
    return OutputError(
        f"{place}: {other or 'another svu'} is writing there; wait for it, or choose another "
        "folder."
    )
