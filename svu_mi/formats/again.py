"""The command that imports a capture again, with other corrections, ready to paste."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from svu_mi.capture import folder as capture_folder
from svu_mi.capture.record import Capture
from svu_mi.formats.fixes import FIXES
from svu_mi.formats.options import ImportOptions
from svu_mi.formats.reading import ReadOptions

FIX = "--fix"
# Those of ``svu import`` that its words may have, but for the folder of the result.
NAMES = {field.name for options in (ReadOptions, ImportOptions) for field in fields(options)}
SWITCHES = {"--undistort", "--original-world", "--normalized", "--geometry-only"}
VALUED = {f"--{name.replace('_', '-')}" for name in NAMES} - SWITCHES - {"--fixes"}
VALUED |= {"--environment-axes", "--environment-scale"}


def command(capture: Capture, fixes: Sequence[str]) -> str:
    """Return the command that imports a capture again, with more corrections, ready to paste.

    Args:
        capture: as loaded from its folder.
        fixes: names of corrections beside those that it was imported with.
    """
    found = None if capture.source is None else capture_folder.read(capture.source)
    words = _parsed(found.imported.get("options") if found else None)
    if words is None:  # from Python, or an earlier version; or changed by somebody
        return " ".join(["svu import ...", *_words(fixes)])
    given, known = words
    return shlex.join(
        ["svu", "import", *given, *_words([*known, *fixes]), "-o", str(capture.source)]
    )


def _parsed(words: Any) -> tuple[list[str], list[str]] | None:
    """Return words of ``svu import`` without its corrections, and these; None if they are others.

    A capture may come from a stranger, who could have put another result or source among them.
    """
    is_text = isinstance(words, list) and all(isinstance(word, str) for word in words)
    if not is_text or not words or not _is_value(words[0]):
        return None
    given, known = words[:1], []
    left = iter(words[1:])
    for name in left:
        value = [next(left, "")] if name in {*VALUED, FIX} else []
        if not all(_is_value(word) for word in value):
            return None
        if name == FIX and value[0] in FIXES:
            known += value
        elif name in {*VALUED, *SWITCHES} and name not in given:
            given += [name, *value]
        else:
            return None
    return given, known


def _is_value(word: str) -> bool:
    return word.isprintable() and word != "" and not word.startswith("-")


def _words(fixes: Sequence[str]) -> list[str]:
    """Return options for corrections; one that is taken back by the next needs none."""
    kept: list[str] = []
    for name in fixes:
        matrix = FIXES[name].matrix if name in FIXES else None
        if kept[-1:] == [name] and (matrix is None or np.allclose(matrix @ matrix, np.eye(3))):
            kept.pop()
        else:
            kept.append(name)
    return [word for name in kept for word in (FIX, name)]
