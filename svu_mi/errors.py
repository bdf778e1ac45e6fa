"""Exceptions and warnings, whose messages contain the location and the remedy.

The command line prints the message and exits with status 2. Python callers catch ``SvuError`` or
one of its subclasses. Warnings derive from ``SvuWarning`` and use the ``warnings`` module.
"""

import re
import sys
import warnings
from collections.abc import Sequence
from unicodedata import category

CALLED = re.compile(r"^[\w.]+\(\): ")  # function name at the start of a message: "estimate(): "


class SvuError(Exception):
    """Base class of all errors that a user can fix.

    Args:
        sentence: message for Python callers.
        shell: message for the command line; default: ``sentence`` without a leading function name.

    Example:
        >>> try:
        ...     svu.preset("best")
        ... except svu.SvuError as error:
        ...     print(type(error).__name__)
        OptionError
    """

    def __init__(self, sentence: str = "", *, shell: str | None = None) -> None:
        super().__init__(sentence)
        self._shell = shell

    @property
    def shell(self) -> str:
        """Message that the command line prints."""
        return CALLED.sub("", str(self)) if self._shell is None else self._shell


class SvuEnvironmentError(SvuError):
    """The installation lacks a usable LLVM, or the Mitsuba variant is not supported."""


class CaptureError(SvuError):
    """Photographs, masks, exposures or poses are missing or inconsistent."""


class SceneError(SvuError):
    """The Mitsuba scene cannot be loaded or rendered, or contains unsupported elements."""


class MeshError(SvuError):
    """The mesh has no faces, no UV coordinates, or charts that overlap."""


class OptionError(SvuError):
    """An option is out of range, or a name is unknown."""


class ShapeError(SvuError):
    """An array has the wrong shape."""


class OutputError(SvuError):
    """A result cannot be written."""


class SvuWarning(UserWarning):
    """Problem that does not stop the run.

    Example:
        >>> import warnings
        >>> with warnings.catch_warnings(action="error", category=svu.SvuWarning):
        ...     estimate = svu.estimate(capture, texels)  # raises instead of printing a warning
    """


def warn(sentence: str) -> None:
    """Emit an ``SvuWarning`` at the line of the user's program that called this package."""
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals["__name__"].startswith("svu_mi"):
        level, frame = level + 1, frame.f_back
    warnings.warn(sentence, SvuWarning, stacklevel=level)


def counted(number: float, noun: str) -> str:
    """Return a number with its noun: ``1 photograph``, ``3 photographs``."""
    return f"{number:g} {noun}{'' if number == 1 else 's'}"


def are(number: int) -> str:
    """Return the verb of a number of things: ``is`` or ``are``."""
    return "is" if number == 1 else "are"


def listed(words: Sequence[str]) -> str:
    """Return words as text: ``a, b and c``."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def first_of(words: Sequence[str], most: int) -> str:
    """Return at most ``most`` words as text, and the number of the others: ``a, b and 4 more``."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + more


def printable(value: object) -> str:
    """Return text that is safe to print in one line of a terminal, such as a file name.

    Line breaks become spaces. Escape sequences, bidirectional controls, lone surrogates and other
    unprintable characters become question marks.
    """
    return "".join(map(_printable, str(value)))


def _printable(letter: str) -> str:
    if letter.isprintable() or category(letter) == "Zs":  # Zs: all kinds of spaces
        return letter
    return " " if letter.isspace() else "?"


def excerpt(value: object, longest: int = 160) -> str:
    """Return foreign text for use in a message: printable, at most ``longest`` characters."""
    text = printable(" ".join(str(value)[: longest + 1].split()))
    return text if len(text) <= longest else text[:longest] + "..."
