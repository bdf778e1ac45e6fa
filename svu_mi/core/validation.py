"""Checks of settings: what frozen options refuse when they are made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from numbers import Integral, Real
from typing import Any, Literal, get_args, get_origin, get_type_hints

from svu_mi.errors import OptionError

WORDS: dict[Any, tuple[type, str]] = {
    int: (Integral, "a whole number"), float: (Real, "a number"), bool: (bool, "True or False"),
}  # fmt: skip


def require(options: Any, condition: bool, name: str, expected: str) -> None:
    """Refuse a setting; NaN meets no condition.

    Raises:
        OptionError: the condition is not met.
    """
    if not condition:
        raise OptionError(
            f"{type(options).__name__}: {name} must be {expected}, got {getattr(options, name)!r}."
        )


def require_known(names: Iterable[str], known: Iterable[str], what: str) -> None:
    """Refuse names that nothing has.

    Args:
        names: as they were given.
        known: all that there are.
        what: they name, such as ``fix``.

    Raises:
        OptionError: there is nothing of a name.
    """
    there = tuple(known)
    for name in names:
        if name not in there:
            raise OptionError(f"There is no {what} {name!r}; use one of {', '.join(there)}.")


def require_types(options: Any) -> None:
    """Refuse fields that are not of their type: numbers, truth values, words of a ``Literal``.

    Raises:
        OptionError: a field of another type.
    """
    hints = get_type_hints(type(options))
    for name in (each.name for each in fields(options) if each.init):
        kind, value = hints[name], getattr(options, name)
        if get_origin(kind) is Literal:
            allowed = get_args(kind)
            require(options, value in allowed, name, f"one of {', '.join(allowed)}")
        elif kind in WORDS:
            number, words = WORDS[kind]
            fits = isinstance(value, number) and (kind is bool or not isinstance(value, bool))
            require(options, fits, name, words)


def require_ranges(options: Any, **ranges: tuple[float, float]) -> None:
    """Refuse settings, by name, that are not in [low, high].

    Raises:
        OptionError: one is not.
    """
    for name, (low, high) in ranges.items():
        require(options, low <= getattr(options, name) <= high, name, f"in [{low:g}, {high:g}]")
