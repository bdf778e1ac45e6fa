"""What the description of a sensor may say: each field with its type and its range."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np

from svu_mi.errors import CaptureError

LARGEST = 1e30  # of any number of a sensor; single precision ends soon after
MAX_SIDE = 2**16  # pixels of a film
MAX_PIXELS = 2**30  # of a photograph; kernels count its numbers, three per pixel, in 32 bits

SHAPES: dict[str, tuple[int, ...]] = {
    "to_world": (4, 4), "x_fov": (), "principal_point_offset": (2,), "clip": (2,), "film": (2,),
    "crop_offset": (2,), "crop_size": (2,),
}  # fmt: skip
WHOLE = ("film", "crop_offset", "crop_size")  # pixels
KINDS = {(): "a number", (2,): "two numbers", (4, 4): "four rows of four numbers"}


def check_record(record: Any, label: str) -> None:
    """Refuse a description that is not complete, or of which Mitsuba would see nothing.

    Args:
        record: as ``poses.describe`` returns it, arrays instead of lists are welcome.
        label: names the file and the sensor in messages.

    Raises:
        CaptureError: a field is missing, of another type or out of its range.
    """
    if not isinstance(record, Mapping):
        raise CaptureError(f"{label}: not a JSON object with {', '.join(SHAPES)}.")
    for key, shape in SHAPES.items():
        if key not in record:
            raise CaptureError(f"{label}: has no {key}; render or import the capture again.")
        what = f"{KINDS[shape]}, each finite and at most {LARGEST:g}"
        _require(_has(record[key], shape, Real), label, key, what)
    for key in WHOLE:
        _require(_has(record[key], (2,), Integral), label, key, "two whole numbers")
    last = np.array(record["to_world"], np.float64)[3]
    _require(np.allclose(last, [0, 0, 0, 1]), label, "to_world", "a pose with last row 0 0 0 1")
    _require(0 < record["x_fov"] < 180, label, "x_fov", "between 0 and 180 degrees")
    near, far = record["clip"]
    _require(0 < near < far, label, "clip", "positive and in order, near and far")
    _check_film(record, label)


def _check_film(record: Mapping[str, Any], label: str) -> None:
    film, offset, size = (record[key] for key in WHOLE)
    sides = [*film, *size]
    _require(min(sides) >= 1 and max(sides) <= MAX_SIDE, label, "film", f"1 to {MAX_SIDE} per side")
    _require(math.prod(map(int, size)) <= MAX_PIXELS, label, "film", f"at most {MAX_PIXELS} pixels")
    inside = all(offset[k] >= 0 and offset[k] + size[k] <= film[k] for k in range(2))
    _require(inside, label, "crop_size", "a window inside the film")


def _require(fine: Any, label: str, key: str, what: str) -> None:
    if not fine:
        raise CaptureError(f"{label}: {key} must be {what}; render or import the capture again.")


def _has(value: Any, shape: tuple[int, ...], kind: Any) -> bool:
    """Return whether a value is nested lists, or an array, of finite numbers."""
    if not shape:
        return isinstance(value, kind) and not isinstance(value, bool) and abs(value) < LARGEST
    listed = isinstance(value, list | tuple | np.ndarray) and len(value) == shape[0]
    return listed and all(_has(inner, shape[1:], kind) for inner in value)
