"""Atomic exchange of two folders, and the lock of a result folder.

The draft of a result is the hidden folder ``.NAME.svu-draft`` next to it; its writer holds a lock
on the draft. If the system cannot exchange two folders in one step, the older one is called
``.NAME.svu-older`` between two renames. After a crash between them, the next access restores it.
"""

import contextlib
import ctypes
import errno
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

from svu_mi.core.identifiers import LONGEST, fits_file_name
from svu_mi.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

DRAFT, OLDER = ".svu-draft", ".svu-older"  # suffixes of hidden names next to a result folder
PATIENCE = 10.0  # seconds that a reader waits for a folder between two renames
PAUSE = 0.05  # seconds between two attempts to lock
NO_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP)
RENAME_EXCHANGE, AT_FDCWD = 2, -100  # constants of Linux


def beside(target: Path, end: str) -> Path:
    """Return the hidden path ``.NAME`` + ``end`` next to ``target``."""
    return target.with_name(f".{target.name}{end}")


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder, and not a link."""
    return path.is_dir() and not path.is_symlink()


@contextlib.contextmanager
def locked(target: Path, wait: float = 0) -> Iterator[Path]:
    """Create the draft of a folder or file, and lock it for this thread.

    The lock ends with the process. An empty draft is removed at the end.

    Args:
        target: path of a folder or file, which need not exist; not a link.
        wait: seconds to wait for another writer.

    Yields:
        Path of the draft, which may contain files of a killed process.

    Raises:
        OutputError: another writer holds the lock, or the draft cannot be created.
    """
    if not fits_file_name(target.name):
        raise OutputError(f"{target}: the name has over {LONGEST} bytes; choose a shorter one.")
    draft = beside(target, DRAFT)
    descriptor = _acquire(draft, target, wait)
    own = draft.lstat()
    try:
        older = beside(target, OLDER)
        if is_folder(older):  # with an unused name if there is a new folder
            older.rename(unused_name(target) if os.path.lexists(target) else target)
        yield draft
    finally:
        if is_at(own, draft):  # else exchanged; another writer may use the name
            with contextlib.suppress(OSError):
                draft.rmdir()
        os.close(descriptor)


def _acquire(draft: Path, target: Path, wait: float) -> int:
    """Return the descriptor of a locked draft that still has its name."""
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
                f"{target}: svu cannot create its temporary folder next to it "
                f"({error.strerror or error}); choose a folder further down, or change the "
                f"permissions of {target.parent}."
            ) from error
        taken = not _lock(descriptor, target)
        if not taken and (fcntl is None or is_at(os.fstat(descriptor), draft)):
            return descriptor
        os.close(descriptor)  # locked, exchanged or removed by another writer
        if taken and time.monotonic() >= deadline:
            raise OutputError(
                f"{target}: another svu is writing there; wait for it, or choose another folder."
            )
        time.sleep(PAUSE if taken else 0)


def _open(folder: Path) -> int:
    if fcntl is None:
        return os.open(os.devnull, os.O_RDONLY)
    # The folder may be foreign: do not follow a link.
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)


def _lock(descriptor: int, target: Path, *, wait: bool = False) -> bool:
    """Lock a folder; return False if another process holds the lock."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:
        log.warning(
            "%s: file locks are not supported there; run only one writer at a time.", target
        )
    return True


def is_at(status: os.stat_result, path: Path) -> bool:
    """Return whether ``path`` is the file or folder with this status."""
    try:
        return os.path.samestat(status, path.lstat())
    except OSError:
        return False


@contextlib.contextmanager
def exchanged(new: Path, target: Path) -> Iterator[None]:
    """Exchange two folders in one step, or rename the new one if the target is missing.

    In the block, the older folder has the name of the new one, and is locked.

    Args:
        new: path of a folder next to the target.
        target: path of the final folder, which need not exist.
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
    """Exchange two names in one step; return False if the system cannot."""
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
    """Restore a folder whose writer was killed between the two renames of an exchange.

    Every reader of a result calls this first; it costs one or two file system calls.

    Raises:
        OutputError: the older folder exists, but cannot be renamed.
    """
    target = Path(os.path.realpath(folder))
    if not os.path.lexists(target) and is_folder(beside(target, OLDER)):
        with locked(target, wait=PATIENCE):
            pass


def unused_name(path: Path) -> Path:
    """Return an unused name for an older folder or file: ``NAME.before``, ``NAME.before1``, ..."""
    names = (path.with_name(f"{path.name}.before{number or ''}") for number in range(10**6))
    return next(name for name in names if not os.path.lexists(name))
