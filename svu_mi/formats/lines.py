"""Text files of one thing per line, as people write them: with comments and empty lines."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from svu_mi.errors import CaptureError, excerpt

MAX_BYTES = 2**24


def lines_of(path: Path, what: str, fix: str) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line that has any, without what follows a ``#``.

    Args:
        path: the file.
        what: what it should be, such as ``a list of exposures``.
        fix: what to do if it is none.

    Raises:
        CaptureError: it is missing, larger than 16 MiB, or no text.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CaptureError(f"{path}: too large for {what}, more than 16 MiB; {fix}.")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise CaptureError(
            f"{path}: not {what} that can be read ({excerpt(error)}); {fix}."
        ) from error
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if text:
            yield number, text
