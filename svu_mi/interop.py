"""NumPy arrays as Dr.Jit arrays and tensors, evenly spaced indices and directions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import ShapeError

LARGE = 2**20  # bytes, from which a second copy costs more than waiting for Dr.Jit


def owned(kind: Any, values: np.ndarray) -> Any:
    """Copy a NumPy array into a Dr.Jit array.

    ``mi.Float(array)`` and ``dr.copy`` of it go on using NumPy's memory. Later writes then
    show through, and, worse, Dr.Jit compiles another kernel for every combination of inputs
    that happen to be aligned to its packets: the same code compiles again on other data.

    Args:
        kind: a Dr.Jit type, such as ``mi.Float`` or ``mi.Point3f``.
        values: (N,) or, for a vector type, (dimension, N); converted to the type's precision.
    """
    if not values.size:
        return kind()
    if dr.depth_v(kind) > 1:
        return kind(*(owned(dr.value_t(kind), component) for component in values))
    plain = np.ascontiguousarray(values)
    # Dr.Jit makes its copy when its queue gets there, which may be after we have returned: give
    # it an array that nobody else writes to, or wait.
    if plain.nbytes < LARGE:
        return dr.opaque(kind(plain.copy()))
    found = dr.opaque(kind(plain))
    dr.sync_thread()
    return found


def tensor(
    values: Any, caller: str, name: str, axes: Sequence[str | int], *, copy: bool = False
) -> Any:
    """Return ``values`` as a detached single precision TensorXf.

    Args:
        values: a Dr.Jit tensor, or anything NumPy turns into numbers (any precision, any
            memory layout).
        caller: function named in the error, such as ``"fit_sh()"``.
        name: argument named in the error.
        axes: one entry per axis: the required length, or a name for "any".
        copy: never alias NumPy memory. Without it, single precision in C order is aliased, and
            the caller must evaluate what it builds on that before it returns.

    Raises:
        ShapeError: another number of axes, another length, or no numbers at all.
    """
    if dr.is_tensor_v(values):
        out = dr.detach(mi.TensorXf(values))
    else:
        try:
            plain = np.array(values, dtype=np.float32, order="C", copy=copy or None)
        except (TypeError, ValueError) as error:
            raise ShapeError(f"{caller}: {name} is not an array of numbers ({error}).") from error
        # Dr.Jit tensors do not take NumPy arrays without elements.
        out = mi.TensorXf(plain) if plain.size else dr.zeros(mi.TensorXf, plain.shape)
    wanted = ", ".join(str(axis) for axis in axes)
    fits = len(out.shape) == len(axes) and all(
        isinstance(axis, str) or axis == length
        for axis, length in zip(axes, out.shape, strict=True)
    )
    if not fits:
        raise ShapeError(f"{caller}: {name} must have shape ({wanted}), got {tuple(out.shape)}.")
    return out


def evenly_spaced(count: int, most: int) -> np.ndarray:
    """Return at most ``most`` of the indices 0 to ``count - 1``, in order and evenly spaced.

    Includes the first and the last, unless ``most`` is 1.
    """
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def fibonacci(count: int, lowest: float = -1.0, start: float = 0.0) -> np.ndarray:
    """Return (count, 3) unit directions, evenly spread over the sphere above y = ``lowest``.

    A Fibonacci spiral around +Y from the top; ``start`` turns it, in golden angles.
    """
    index = np.arange(count)
    y = 1 - (1 - lowest) * (index + 0.5) / count
    azimuth = (index + start) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=-1)
