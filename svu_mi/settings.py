"""Checks of settings: what frozen options refuse when they are made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from numbers import Integral, Real
from typing import Any, get_args

from svu_mi.errors import OptionError


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
            raise OptionError(f"There is no {what} {name!r}; there are {', '.join(there)}.")


def require_types(options: Any) -> None:
    """Refuse what is no whole number, number or truth value where one is needed.

    Raises:
        OptionError: a field of another type.
    """
    kinds = {"int": (Integral, "a whole number"), "float": (Real, "a number"),
             "bool": (bool, "True or False")}  # fmt: skip
    for each in fields(options):
        if each.type not in kinds:
            continue
        kind, words = kinds[str(each.type)]
        value = getattr(options, each.name)
        fits = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
        require(options, fits, each.name, words)


def require_one_of(options: Any, name: str, choices: Any) -> None:
    """Refuse a setting that is none of a ``Literal``'s values.

    Raises:
        OptionError: it is none.
    """
    allowed = get_args(choices)
    require(options, getattr(options, name) in allowed, name, f"one of {', '.join(allowed)}")
