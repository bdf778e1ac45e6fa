"""Words of the command line as values, and back."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal

from svu_mi.errors import OptionError
from svu_mi.parameters import NAMES

UNITS = {"K": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}  # bytes
SPECULAR = "specular"  # Ks, of the paper's power spectra


def pair(size: tuple[int, ...], option: str) -> tuple[int, int]:
    """Return (width, height) from one or two numbers.

    Raises:
        OptionError: another count of numbers, or one below 1.
    """
    if len(size) not in (1, 2) or min(size) < 1:
        found = " ".join(map(str, size))
        raise OptionError(f"{option} takes one or two positive numbers, got {found}.")
    return size[0], size[-1]


def bytes_of(text: str, option: str) -> float | None:
    """Return how many bytes "4G" or "800M" are; None for an empty text.

    Raises:
        OptionError: it is no such size.
    """
    if not text:
        return None
    number, unit = (text[:-1], text[-1].upper()) if text[-1].upper() in UNITS else (text, "")
    try:
        size = float(number) * UNITS.get(unit, 1)
    except ValueError:
        size = -1
    if not 0 <= size < math.inf:
        raise OptionError(f"{option} takes a size such as 4G or 800M, got {text!r}.")
    return size


def with_known_repeated(words: Sequence[str]) -> list[str]:
    """Return the words of a command with ``--known a=0 b=1`` as ``--known a=0 --known b=1``.

    An option that takes any number of words would take the scene after it, too.
    """
    spread: list[str] = []
    for word in words:
        name, is_value, _ = word.partition("=")
        if spread[-2:-1] == ["--known"] and is_value and name in (*NAMES, SPECULAR):
            spread.append("--known")
        spread.append(word)
    return spread


def parse_known(words: tuple[str, ...]) -> dict[str, float] | Literal["scene"] | None:
    """Return ``--known`` words as values by parameter, or as ``"scene"``.

    Raises:
        OptionError: a word is not NAME=NUMBER, or "scene" among others.
    """
    if words == ("scene",):
        return "scene"
    known = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            known[name] = float(value)
        except ValueError:
            raise OptionError(
                f"--known takes NAME=NUMBER, such as metallic=0, or the single word scene; got "
                f"{word!r}."
            ) from None
    if len(known) < len(words):
        raise OptionError(f"--known must name each parameter once, got {', '.join(words)}.")
    for name in known:
        if name not in (*NAMES, SPECULAR):
            raise OptionError(
                f"--known: there is no parameter {name!r}; use {', '.join(NAMES[:-1])} or "
                f"{NAMES[-1]}."
            )
    return known or None


def given(options: Any) -> dict[str, Any]:
    """Return the options of a command by name, those of its groups too, for ``run.json``."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        found |= given(value) if dataclasses.is_dataclass(value) else {field.name: value}
    return found
