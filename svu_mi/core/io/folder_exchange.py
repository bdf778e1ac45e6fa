"""The exchange of two folders in one step, and the lock of the folder that is being written.

The draft of a result is ``.NAME.svu-draft`` beside it; whoever writes the result holds a lock on
the draft. Where the system cannot exchange two folders in one step, the older one is called
``.NAME.svu-older`` between two renames, and the next access restores it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

from svu_mi.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

DRAFT, OLDER = ".svu-draft", ".svu-older"  # ends of hidden names beside a result's folder
PATIENCE = 10.0  # seconds that a reader waits for a folder that is between two renames
PAUSE = 0.05  # seconds between two tries to lock
NO_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP)
RENAME_EXCHANGE, AT_FDCWD = 2, -100  # of Linux


def beside(target: Path, end: str) -> Path:
    """Return a hidden name beside a folder."""
    return target.with_name(f".{target.name}{end}")


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder itself, not a link to one."""
    return path.is_dir() and not path.is_symlink()


@contextlib.contextmanager
def locked(target: Path, wait: float = 0) -> Iterator[Path]:
    """Make the draft of a folder or file, and keep other processes and threads from it.

    The lock ends with the process. An empty draft is removed at the end.

    Args:
        target: a folder or a file, which need not exist; no link.
        wait: seconds to wait for another writer.

    Yields:
        The draft, with what a killed process may have left in it.

    Raises:
        OutputError: another writer is at work, or the draft cannot be made.
    """
    draft = beside(target, DRAFT)
    descriptor = _acquire(draft, target, wait)
    own = draft.lstat()
    try:
        _settle(target)
        yield draft
    finally:
        if is_at(own, draft):  # it may have been exchanged, and another writer at work
            with contextlib.suppress(OSError):
                draft.rmdir()
        os.close(descriptor)


def _acquire(draft: Path, target: Path, wait: float) -> int:
    """Return the descriptor of a draft that is locked and still has its name."""
    deadline = time.monotonic() + wait
    while True:
        try:
            with contextlib.suppress(FileExistsError):
                draft.mkdir()
            descriptor = _open(draft)
        except OSError as error:
            if isinstance(error, FileNotFoundError) and draft.parent.is_dir():
                continue  # another writer has just removed it
            raise OutputError(
                f"{target}: no folder can be made beside it ({error.strerror or error}), where svu "
                "puts a result together; choose a folder further down, or change the permissions "
                f"of {target.parent}."
            ) from error
        taken = not _lock(descriptor, target)
        if not taken and (fcntl is None or is_at(os.fstat(descriptor), draft)):
            return descriptor
        os.close(descriptor)  # locked by another one, or exchanged or removed by it
        if taken and time.monotonic() >= deadline:
            raise OutputError(
                f"{target}: another svu is writing there; wait for it, or choose another folder."
            )
        time.sleep(PAUSE if taken else 0)


def _open(folder: Path) -> int:
    if fcntl is None:
        return os.open(os.devnull, os.O_RDONLY)
    # It may be a stranger's: a link is not followed.
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)


def _lock(descriptor: int, target: Path, *, wait: bool = False) -> bool:
    """Lock a folder; return whether no other process holds it."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:
        log.warning("%s: locks do not work there; let only one run write to it.", target)
    return True


def is_at(status: os.stat_result, path: Path) -> bool:
    """Return whether a path names the file or folder that has this status."""
    try:
        return os.path.samestat(status, path.lstat())
    except OSError:
        return False


@contextlib.contextmanager
def exchanged(new: Path, target: Path) -> Iterator[None]:
    """Exchange two folders in one step, or rename the new one if there is no older one.

    In the block, the older folder has the name of the new one, and is locked.

    Args:
        new: a folder beside the target.
        target: a folder, which need not exist.
    """
    if not os.path.lexists(target):
        new.rename(target)
        yield
        return
    descriptor = _open(target)
    try:
        _lock(descriptor, target, wait=True)
        if not _exchange(new, target):
            older = beside(target, OLDER)
            target.rename(older)
            new.rename(target)
            older.rename(new)
        yield
    finally:
        os.close(descriptor)


def _exchange(first: Path, second: Path) -> bool:
    """Exchange two names in one step; return False where the system cannot."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):  # not Linux, or a libc without it
        return False
    names = os.fsencode(first), os.fsencode(second)
    if rename(AT_FDCWD, names[0], AT_FDCWD, names[1], RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in NO_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(second))


def restore(folder: str | os.PathLike[str]) -> None:
    """Restore a folder if a kill fell between the two renames of its exchange.

    Every reader of a result calls this first; it costs one look at the folder.

    Raises:
        OutputError: the older folder is there, but cannot be renamed.
    """
    target = Path(os.path.realpath(folder))
    if not os.path.lexists(target) and is_folder(beside(target, OLDER)):
        with locked(target, wait=PATIENCE):
            pass


def _settle(target: Path) -> None:
    """Give the older folder its name back, or another one where a new folder has it."""
    older = beside(target, OLDER)
    if is_folder(older):
        older.rename(unused_name(target) if os.path.lexists(target) else target)


def unused_name(path: Path) -> Path:
    """Return a free name for an older folder or file: ``NAME.before``, ``NAME.before1``, ..."""
    names = (path.with_name(f"{path.name}.before{number or ''}") for number in range(10**6))
    return next(name for name in names if not os.path.lexists(name))
