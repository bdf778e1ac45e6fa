"""Files of others that are in the way of results: they are kept under another name."""

from __future__ import annotations

import hashlib
import os
import re
import warnings
from pathlib import Path

from svu_mi.errors import OutputError, SvuWarning
from svu_mi.files import replacing

# At the end of a page that lies alone, without a record beside it: a digest of all before it.
MARK = re.compile(rb"<!-- svu:page=([0-9a-f]{32}) -->\n\Z")
MARK_BYTES = len("<!-- svu:page= -->\n") + 32


def unused_name(path: Path) -> Path:
    """Return a name for an older file that nobody has: ``map.before.exr``, ...

    Raises:
        OutputError: there is none.
    """
    for number in range(10**6):
        other = path.with_name(f"{path.stem}.before{number or ''}{path.suffix}")
        if not os.path.lexists(other):
            return other
    raise OutputError(f"{path}: cannot be kept under another name; move it away.")


def say_kept(folder: Path, old: str, other: str, more: int = 0) -> None:
    """Warn that a file has another name now.

    Args:
        folder: that it lies in.
        old: its name.
        other: the one it has got.
        more: how many files have been renamed beside it.
    """
    likewise = f" (and {more} more likewise)" if more else ""
    warnings.warn(
        f"{folder}: {old}, not written by this version of svu or changed since, is kept as "
        f"{other}{likewise}; remove it when you no longer need it.",
        SvuWarning,
        stacklevel=7,
    )


def write_alone(path: str | Path, page: str) -> None:
    """Write an HTML page that has no record beside it, whole or not at all.

    Only an older page that nobody has changed since is replaced; anything else of that name is
    kept under another one, with a warning.

    Args:
        path: the HTML file.
        page: its text, which a comment with a digest is added to.

    Raises:
        OutputError: as ``files.replacing``.
    """
    path, content = Path(path), (page + "\n").encode()
    with replacing(path) as temporary:
        mark = f"<!-- svu:page={_digest(content)} -->\n"
        temporary.write_bytes(content + mark.encode())
        if os.path.lexists(path) and not path.is_dir() and not _is_own(path):
            other = unused_name(path)
            path.rename(other)
            say_kept(path.parent, path.name, other.name)


def _is_own(path: Path) -> bool:
    """Return whether a file is one that ``write_alone`` has written, and unchanged."""
    if path.is_symlink() or not path.is_file():
        return False
    try:
        content = path.read_bytes()
    except OSError:
        return False
    found = MARK.search(content, max(0, len(content) - MARK_BYTES))
    return found is not None and _digest(content[: found.start()]) == found[1].decode()


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=16).hexdigest()
