"""Standard streams that ignore write errors, and plain printed lines."""

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
    """Stream that ignores failed writes, and escapes characters outside its encoding."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text if possible; return its length."""
        try:
            self._stream.write(text)
        except UnicodeEncodeError:
            encoding = self._stream.encoding
            plain = text.translate(PLAIN).encode(encoding, "backslashreplace")
            self.write(plain.decode(encoding))
        except (OSError, ValueError):  # ValueError: closed
            self._give_up()
        return len(text)

    def flush(self) -> None:
        """Flush the buffer, if possible."""
        try:
            self._stream.flush()
        except (OSError, ValueError):
            self._give_up()

    def _give_up(self) -> None:
        # Python flushes the buffer again at exit; an error would change the exit status.
        with suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            try:
                os.dup2(null, self._stream.fileno())
            finally:
                os.close(null)
            self._stream.flush()


@contextmanager
def forgiving_streams() -> Iterator[None]:
    """Let ``sys.stdout`` and ``sys.stderr`` ignore write errors within the block."""
    _open_standard_files()
    for descriptor in (1, 2):  # a slow reader of a non-blocking pipe would lose output
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
    """Open closed standard descriptors (``svu >&-``), so that no file gets their numbers."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            with suppress(OSError):
                os.open(os.devnull, os.O_RDWR)  # gets this one, the lowest free


class OneLine(Console):
    """Console that prints strings, also in tables, without line ends or control characters."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a string as rich text; ``options`` are passed to rich."""
        return super().render_str(printable(text), **options)


class LogLines(logging.Handler):
    """Handler that writes each record as one line to the current ``sys.stderr``."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        sys.stderr.write(f"svu: {printable(record.getMessage())}\n")


def print_line(console: Console, text: str) -> None:
    """Print a line without wrapping or markup; names may contain [brackets]."""
    console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


def format_number(value: float | None, digits: int = 2) -> str:
    """Return a number as the cell of a table; a dash if it is missing."""
    return "-" if value is None or isnan(value) else f"{value:.{digits}f}"
