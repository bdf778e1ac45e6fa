"""Declared fields of JSON records and NPZ files: type, shape, range and unit, in a table per file.

    CAMERA = {"x_fov": Field(NUMBER, (), 1e-6, 179.9, "degrees"), "name": Field(TEXT, default="")}
    checked({"x_fov": 35}, CAMERA)["name"]

Messages lack the file and the remedy, which the caller adds.
"""

import reprlib
from collections.abc import Mapping, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from svu_mi.core.io.files import read_json, refusing
from svu_mi.errors import excerpt

NUMBER, WHOLE, TEXT, FLAG, OBJECT = "if", "i", "U", "b", "V"  # letters of ``dtype.kind``
SIMPLE = NUMBER + TEXT + FLAG
NOUNS = {SIMPLE: "a number or text", WHOLE: "a whole number", TEXT: "a text", OBJECT: "an object",
         FLAG: "true or false"}  # fmt: skip
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
        kind: accepted letters of ``dtype.kind``, one type such as ``f4``, or a schema of an object.
        shape: length or ``Axis`` of each axis of an array, or of nested lists.
        low, high: range of the numbers, which excludes NaN; without ``low``, any are accepted.
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
    """Return the declared fields of a JSON value, or of arrays by name, with defaults.

    Raises:
        ValueError: a value does not match, or the record has other fields although ``closed``.
    """
    if not isinstance(record, Mapping):
        raise ValueError(f"expected an object with {', '.join(schema)}")
    if closed and (other := sorted(set(record) - set(schema))):
        raise ValueError(f"{excerpt(other[0], 40)} is unknown")
    lengths: dict[str, int] = {}
    values = {}
    for name, field in schema.items():
        value = record.get(name)
        if value is None and field.default is REQUIRED:
            raise ValueError(f"{name} is missing")
        values[name] = field.default if value is None else _value(name, value, field, lengths)
    return values


def read_record(path: Path, schema: Schema, remedy: str) -> dict[str, Any]:
    """Read a JSON file with a schema; raise a CaptureError that ends with ``remedy``."""
    with refusing(path, remedy):
        return checked(read_json(path), schema)


def _value(
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
            return [_value(name, item, inner, lengths, whole or field) for item in value]
        items = value.items() if axis is NAMES else enumerate(value)
        made = {
            key: _value(f"{name}[{excerpt(repr(key), 40)}]", item, inner, lengths)
            for key, item in items
        }
        return made if axis is NAMES else list(made.values())
    if problem := _problem(value, field, lengths):
        wanted = _expected(whole or field, lengths)
        raise ValueError(f"{name} must be {wanted}, got {excerpt(problem, 60)}")
    return value


def _problem(value: Any, field: Field, lengths: dict[str, int]) -> str:
    """Return a text about a number, text or array that does not match; empty if it does."""
    is_array = isinstance(value, np.ndarray | np.generic)
    dtype = value.dtype if is_array else np.dtype(TYPES.get(type(value), object))
    shape, kind = np.shape(value) if is_array else (), field.kind
    letters = isinstance(kind, str) and kind.isalpha()
    fits = dtype.kind in kind if letters else dtype.str[1:] == kind
    same = len(shape) == len(field.shape) and all(map(_fits, shape, field.shape, repeat(lengths)))
    if not (fits and same):
        if isinstance(value, list | tuple):
            return f"a list of {len(value)}"
        shown = value.tolist() if is_array and not shape else value
        return f"{dtype} of shape {shape}" if shape else reprlib.repr(shown)
    if field.low is None or dtype.kind in TEXT + OBJECT:
        return ""
    limit = np.float64 if is_array else float  # half floats would overflow
    inside = np.asarray((value >= limit(field.low)) & (value <= limit(field.high)))
    return "" if inside.all() else str(np.asarray(value)[~inside].flat[0])


def _fits(length: int, axis: int | Axis, lengths: dict[str, int]) -> bool:
    if isinstance(axis, int):
        return length == axis
    inside = axis.low <= length <= axis.high
    return inside and (axis in (NAMES, ITEMS) or lengths.setdefault(axis.name, length) == length)


def _expected(field: Field, lengths: Mapping[str, int]) -> str:
    """Return a description of a field, such as ``3 numbers in [0, 1]``."""
    noun = NOUNS.get(OBJECT if isinstance(field.kind, Mapping) else field.kind, "a number")
    sizes = " x ".join(
        str(axis) if isinstance(axis, int)
        else axis.name if axis in (NAMES, ITEMS)
        else f"{lengths.get(axis.name, f'{axis.low} to {axis.high}')} {axis.name}"
        for axis in field.shape
    )  # fmt: skip
    if sizes:
        nouns, fixed = f"{noun.split(' ', 1)[1]}s", all(isinstance(n, int) for n in field.shape)
        noun = f"{sizes} {nouns}" if fixed else f"{nouns} for {sizes}"
    limits = "" if field.low is None else f" in [{field.low:g}, {field.high:g}]"
    return f"{noun}{limits} {field.unit}".rstrip()
