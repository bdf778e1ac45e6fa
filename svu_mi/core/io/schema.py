"""Declared fields of JSON records and NPZ files: type, shape, range and unit, in a table per file.

    CAMERA = {
        "to_world": Field(NUMBER, (4, 4), -1e30, 1e30),
        "x_fov": Field(NUMBER, (), 1e-6, 179.9, "degrees"),
        "name": Field(TEXT, default=""),
    }
    checked({"to_world": [[...], ...], "x_fov": 35}, CAMERA)["name"]

Messages lack the file and the remedy, which the caller adds.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from svu_mi.core.io.files import read_json
from svu_mi.errors import CaptureError, excerpt

NUMBER, WHOLE, TEXT, FLAG, OBJECT = "if", "i", "U", "b", "V"  # letters of ``dtype.kind``
SIMPLE = NUMBER + TEXT + FLAG
NOUNS = {
    SIMPLE: "a number or text", WHOLE: "a whole number", TEXT: "a text",
    FLAG: "true or false", OBJECT: "an object",
}  # fmt: skip
TYPES = {bool: "?", int: "i8", float: "f8", str: "U", dict: "V"}  # of JSON values, as arrays
LARGEST = 3.4e38  # largest single-precision number
REQUIRED: Any = object()


class Axis(NamedTuple):
    """Axis of variable length; axes of the same name have the same length in a record."""

    name: str
    low: int = 0
    high: int = 2**31


NAMES, ITEMS = Axis("each name"), Axis("each entry")  # of any length, of objects and lists in JSON


class Field(NamedTuple):
    """Type, shape and range of a value in a record.

    Attributes:
        kind: accepted letters of ``dtype.kind``, or one type such as ``f4``; or the schema of a
            JSON object.
        shape: length or ``Axis`` of each axis of an array, or of nested lists.
        low, high: range of the numbers, which excludes NaN; if low is None, any are accepted.
        unit: unit in messages.
        default: value of a missing field, and of null in JSON.
    """

    kind: str | Mapping[str, Any]
    shape: Sequence[int | Axis] = ()
    low: float | None = None
    high: float = LARGEST
    unit: str = ""
    default: Any = REQUIRED


Schema = Mapping[str, Field]


def checked(record: Any, schema: Schema, *, closed: bool = False) -> dict[str, Any]:
    """Return the declared fields of a record, with defaults.

    Args:
        record: JSON value, or arrays by name.
        schema: fields by name.
        closed: True to refuse other fields.

    Raises:
        ValueError: the record does not match the schema.
    """
    if not isinstance(record, Mapping):
        raise ValueError(f"expected an object with {', '.join(schema)}")
    if closed and (other := sorted(set(record) - set(schema))):
        raise ValueError(f"{excerpt(other[0], 40)} is unknown")
    lengths: dict[str, int] = {}
    values = {}
    for name, field in schema.items():
        values[name] = field.default if (value := record.get(name)) is None else None
        if value is not None:
            values[name] = _checked_value(name, value, field, lengths)
        elif field.default is REQUIRED:
            raise ValueError(f"{name} is missing")
    return values


def read_record(path: Path, schema: Schema, remedy: str) -> dict[str, Any]:
    """Read a JSON file with a schema (see ``checked``).

    Raises:
        CaptureError: the file cannot be read, or does not match; the message ends with ``remedy``.
    """
    try:
        return checked(read_json(path), schema)
    except ValueError as error:
        raise CaptureError(f"{path}: {error}; {remedy}.") from error


def _checked_value(
    name: str, value: Any, field: Field, lengths: dict[str, int], whole: Field | None = None
) -> Any:
    """Return a value, with the defaults of records in it; note the lengths of its axes.

    ``whole`` is the field in messages, if ``value`` is an entry of a list of fixed length.
    """
    axis, kind = field.shape[0] if field.shape else None, field.kind
    if axis is None and isinstance(kind, Mapping):
        try:
            return checked(value, kind)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    nested = isinstance(value, Mapping if axis is NAMES else list | tuple)
    if nested and axis is not None and _fits(len(value), axis, lengths):
        inner = field._replace(shape=field.shape[1:])
        if isinstance(axis, int):
            return [_checked_value(name, item, inner, lengths, whole or field) for item in value]
        made = {
            key: _checked_value(f"{name}[{excerpt(repr(key), 40)}]", item, inner, lengths)
            for key, item in (value.items() if axis is NAMES else enumerate(value))
        }
        return made if axis is NAMES else list(made.values())
    if problem := _problem(value, field, lengths):
        wanted = _expected(whole or field, lengths)
        raise ValueError(f"{name} must be {wanted}, got {excerpt(problem, 60)}")
    return value


def _problem(value: Any, field: Field, lengths: dict[str, int]) -> str:
    """Return a text about a number, text or array that does not match; empty if it does."""
    has_type = isinstance(value, np.ndarray | np.generic)
    given = value.dtype if has_type else np.dtype(TYPES.get(type(value), object))
    kind, sizes = field.kind, np.shape(value) if has_type else ()
    is_letters = isinstance(kind, str) and kind.isalpha()
    fits = given.kind in kind if is_letters else given.str[1:] == kind
    if (
        not fits
        or len(sizes) != len(field.shape)
        or not all(
            _fits(length, axis, lengths) for length, axis in zip(sizes, field.shape, strict=True)
        )
    ):
        if isinstance(value, list | tuple):
            return f"a list of {len(value)}"
        shown = value.tolist() if has_type and not sizes else value
        return f"{given} of shape {sizes}" if sizes else reprlib.repr(shown)
    if field.low is None or given.kind in TEXT + OBJECT:
        return ""
    as_limit = np.float64 if has_type else float  # half floats would overflow
    inside = np.asarray((value >= as_limit(field.low)) & (value <= as_limit(field.high)))
    return "" if inside.all() else str(np.asarray(value)[~inside].flat[0])


def _fits(length: int, axis: int | Axis, lengths: dict[str, int]) -> bool:
    if isinstance(axis, int):
        return length == axis
    if axis in (NAMES, ITEMS):
        return True
    return axis.low <= length <= axis.high and lengths.setdefault(axis.name, length) == length


def _expected(field: Field, lengths: Mapping[str, int]) -> str:
    """Return a description of a field, such as ``3 numbers in [0, 1]``."""
    kind = OBJECT if isinstance(field.kind, Mapping) else field.kind
    words = NOUNS.get(kind, "a number")
    if field.shape:
        sizes = [
            str(axis) if isinstance(axis, int)
            else axis.name if axis in (NAMES, ITEMS)
            else f"{lengths.get(axis.name, f'{axis.low} to {axis.high}')} {axis.name}"
            for axis in field.shape
        ]  # fmt: skip
        plural, listed = f"{words.split(' ', 1)[1]}s", " x ".join(sizes)
        is_fixed = all(isinstance(axis, int) for axis in field.shape)
        words = f"{listed} {plural}" if is_fixed else f"{plural} for {listed}"
    limits = "" if field.low is None else f" in [{field.low:g}, {field.high:g}]"
    return f"{words}{limits} {field.unit}".rstrip()
