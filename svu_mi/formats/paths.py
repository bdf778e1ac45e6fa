"""Names of files as other people's files give them: only those inside the source are followed."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from svu_mi.errors import CaptureError

LONGEST = 240  # bytes of one part of a path; file systems take 255, and suffixes are added
LONGEST_PATH = 2048  # bytes
CONTROL = re.compile(r"[\0-\x1f\x7f-\x9f]")  # what no name has, and a terminal obeys
SHOWN = 60  # characters of a name in a message


def inside(root: Path, name: Any, label: str) -> Path:
    r"""Return the path of a file that is named relative to a folder; it need not exist.

    ``\`` separates folders, too, as Windows' tools write it. Links are followed when the file is
    opened: whoever made the folder has made them.

    Args:
        root: the folder.
        name: what the file says.
        label: the file and frame, for the message.

    Raises:
        CaptureError: the name is not text, absolute, leaves the folder by ``..``, names the folder
            itself, or is not valid in a file system.
    """
    if not isinstance(name, str):
        raise CaptureError(f"{label}: a file's name must be text, got {_shown(name)}.")
    parts = PurePosixPath(os.path.normpath(name.replace("\\", "/"))).parts
    if PureWindowsPath(name).drive or name.startswith(("/", "\\")) or ".." in parts[:1]:
        raise CaptureError(
            f"{label}: {_shown(name)} lies outside {root}; move the file into it and give its "
            "path relative to that folder."
        )
    if not name or not parts or not _is_usable(parts):
        raise CaptureError(f"{label}: {_shown(name)} is not a valid file name; rename the file.")
    return root.joinpath(*parts)


def name_in(root: Path, file: Path) -> str:
    """Return the name of a file relative to a folder; its name alone if it lies elsewhere."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def _is_usable(parts: tuple[str, ...]) -> bool:
    """Whether the operating system can be asked for a file of this name."""
    try:
        sizes = [len(os.fsencode(part)) for part in parts]
    except UnicodeEncodeError:  # half a surrogate pair, which JSON can spell
        return False
    fits = max(sizes) <= LONGEST and sum(sizes) + len(sizes) <= LONGEST_PATH
    return fits and CONTROL.search("".join(parts)) is None


def _shown(name: Any) -> str:
    text = ascii(name) if isinstance(name, str) else f"a {type(name).__name__}"
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."
