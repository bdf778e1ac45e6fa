"""NumPy arrays as Dr.Jit arrays and tensors; evenly spaced indices and directions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import ShapeError

LARGE = 2**20  # bytes, from which a second copy costs more than waiting for Dr.Jit


def to_drjit(kind: Any, values: np.ndarray) -> Any:
    """Copy a NumPy array, (N,) or (dimension, N), into a Dr.Jit array of type ``kind``.

    ``mi.Float(array)`` shares NumPy's memory: later writes show through, and Dr.Jit compiles
    another kernel for every alignment of its inputs.
    """
    if not values.size:
        return kind()
    if dr.depth_v(kind) > 1:
        return kind(*(to_drjit(dr.value_t(kind), component) for component in values))
    plain = np.ascontiguousarray(values)
    # Dr.Jit makes its copy when its queue gets there, which may be after we have returned: give
    # it an array that nobody else writes to, or wait.
    if plain.nbytes < LARGE:
        return dr.opaque(kind(plain.copy()))
    copied = dr.opaque(kind(plain))
    dr.sync_thread()
    return copied


def tensor(
    values: Any, caller: str, name: str, axes: Sequence[str | int], *, copy: bool = False
) -> Any:
    """Return ``values`` as a detached single precision TensorXf; errors name caller and argument.

    ``axes`` has a length, or a name for any, per axis. Unless ``copy``, contiguous float32 input is
    aliased: the caller must evaluate before it returns.
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
    """Return at most ``most`` of the indices below ``count``, evenly spaced, both ends included."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def fibonacci(count: int, lowest: float = -1.0, start: float = 0.0) -> np.ndarray:
    """Return (count, 3) even unit directions above y = ``lowest``; ``start`` in golden angles."""
    index = np.arange(count)
    y = 1 - (1 - lowest) * (index + 0.5) / count
    azimuth = (index + start) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=-1)
