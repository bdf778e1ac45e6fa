"""Standard streams that ignore write errors, and printing of plain lines."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from math import isnan
from typing import Any, TextIO, cast

from rich.console import Console
from rich.text import Text

from svu_mi.errors import printable

# ASCII replacements of printed characters, for terminals without Unicode.
PLAIN = str.maketrans({"±": "+-", "·": "-", "•": "*", "×": "x", "\u2009": " ", "\u202f": " "})


class ForgivingStream:
    """Stream that ignores failed writes: the reader has ended, or the disk is full.

    Letters that the encoding does not have are spelt out or escaped.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text if possible; return its length in any case."""
        try:
            self._stream.write(text)
        except UnicodeEncodeError:
            encoding = self._stream.encoding
            plain = text.translate(PLAIN).encode(encoding, "backslashreplace")
            self.write(plain.decode(encoding))
        except (OSError, ValueError):  # ValueError: it is closed
            self._give_up()
        return len(text)

    def flush(self) -> None:
        """Flush the buffer, if possible."""
        try:
            self._stream.flush()
        except (OSError, ValueError):
            self._give_up()

    def _give_up(self) -> None:
        # Python flushes the buffer again when it ends, and would change the exit status.
        with suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            try:
                os.dup2(null, self._stream.fileno())
            finally:
                os.close(null)
            self._stream.flush()


@contextmanager
def forgiving_streams() -> Iterator[None]:
    """Make ``sys.stdout`` and ``sys.stderr`` forgiving for a while."""
    _open_standard_files()
    for descriptor in (1, 2):  # of a pipe that does not wait, a slow reader would miss the rest
        with suppress(OSError, AttributeError):  # not on Windows
            os.set_blocking(descriptor, True)
    before = sys.stdout, sys.stderr
    with ExitStack() as opened:
        streams = [
            ForgivingStream(stream or opened.enter_context(open(os.devnull, "w", encoding="utf-8")))
            for stream in before
        ]
        sys.stdout, sys.stderr = cast(list[TextIO], streams)
        try:
            yield
        finally:
            for stream in streams:
                stream.flush()
            sys.stdout, sys.stderr = before


def _open_standard_files() -> None:
    """Fill the places of standard files that are closed (``svu >&-``).

    The next opened file would take the descriptor, and receive output of C++ libraries.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            with suppress(OSError):
                os.open(os.devnull, os.O_RDWR)  # takes the lowest free one: this


class OneLine(Console):
    """A console that prints strings, in tables too, without line ends or control characters."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a string as rich text; ``options`` are rich's."""
        return super().render_str(printable(text), **options)


class LogLines(logging.Handler):
    """Writes records to the ``sys.stderr`` of their time, one line each."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        sys.stderr.write(f"svu: {printable(record.getMessage())}\n")


def print_line(console: Console, text: str) -> None:
    """Print a line without wrapping or markup: a name may hold [brackets]."""
    console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


def format_number(value: float | None, digits: int = 2) -> str:
    """Return a number as the cell of a table; a dash if it is unknown."""
    return "-" if value is None or isnan(value) else f"{value:.{digits}f}"
