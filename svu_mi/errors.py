"""Errors of svu_mi: one sentence that names the file, frame or texel, and the fix.

The command line prints the sentence and exits with status 2; Python callers catch
``SvuError`` or one of its subclasses. A warning that is not an error derives from
``SvuWarning`` and goes through the standard ``warnings`` module.
"""

from __future__ import annotations

import re
from unicodedata import category

CALLED = re.compile(r"^[\w.]+\(\): ")  # how sentences about a call begin: "estimate(): "


class SvuError(Exception):
    """Base of every error a user can cause and repair.

    Args:
        sentence: what is wrong, and the fix, to whoever calls Python.
        shell: the same to whoever uses the command line; by default the sentence, without the name
            of the function that it begins with.
    """

    def __init__(self, sentence: str = "", *, shell: str | None = None) -> None:
        super().__init__(sentence)
        self._shell = shell

    @property
    def shell(self) -> str:
        """The sentence that the command line prints."""
        return CALLED.sub("", str(self)) if self._shell is None else self._shell


class SvuEnvironmentError(SvuError):
    """The installation cannot run: no usable LLVM, or a Mitsuba variant that does not fit."""


class CaptureError(SvuError):
    """Photographs, masks, exposures or poses are missing or do not fit each other."""


class SceneError(SvuError):
    """The Mitsuba scene lacks, or has too much of, something that the method needs."""


class MeshError(SvuError):
    """The mesh cannot carry texels: no UVs, overlapping charts, no faces."""


class OptionError(SvuError):
    """An option is outside its range or names something that does not exist."""


class ShapeError(SvuError):
    """An array has the wrong shape."""


class OutputError(SvuError):
    """A result cannot be written."""


class SvuWarning(UserWarning):
    """Something the user should know although the run goes on."""


def printable(value: object) -> str:
    """Return foreign text so that a terminal shows it as it is, in one line.

    A file's name may hold whatever it likes: what would end the line becomes a space; escape
    sequences, bidirectional controls, lone surrogates and the like become question marks.
    """
    return "".join(map(_printable, str(value)))


def _printable(letter: str) -> str:
    if letter.isprintable() or category(letter) == "Zs":  # the spaces, narrow ones too
        return letter
    return " " if letter.isspace() else "?"


def excerpt(value: object, longest: int = 160) -> str:
    """Return what a file or a library says so that it fits in a sentence: printable, and short."""
    text = printable(" ".join(str(value)[: longest + 1].split()))
    return text if len(text) <= longest else text[:longest] + "..."
