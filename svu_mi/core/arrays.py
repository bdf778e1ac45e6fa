"""Conversion of NumPy arrays to Dr.Jit; loops of kernels; evenly spaced indices and directions."""

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import ShapeError

LARGE = 2**20  # bytes; copying a larger array costs more than waiting for Dr.Jit


def to_drjit(kind: Any, values: np.ndarray) -> Any:
    """Copy a NumPy array, (N,) or (dimension, N), into a Dr.Jit array of type ``kind``.

    ``mi.Float(array)`` would alias NumPy's memory: later writes would change the Dr.Jit array, and
    Dr.Jit would compile another kernel for every alignment of its inputs.
    """
    if not values.size:
        return kind()
    if dr.depth_v(kind) > 1:
        return kind(*(to_drjit(dr.value_t(kind), component) for component in values))
    plain = np.ascontiguousarray(values)
    # Dr.Jit copies asynchronously, possibly after this function has returned. Until then, the
    # source must not change: pass a private copy, or synchronise.
    if plain.nbytes < LARGE:
        return dr.opaque(kind(plain.copy()))
    copied = dr.opaque(kind(plain))
    dr.sync_thread()
    return copied


def tensor(
    values: Any, caller: str, name: str, axes: Sequence[str | int], *, copy: bool = False
) -> Any:
    """Return ``values`` as a detached single-precision TensorXf of a given shape.

    ``axes`` contains the length of each axis, or a name for an axis of any length; a ShapeError
    contains ``caller`` and ``name``. Unless ``copy``, contiguous float32 input is aliased: the
    caller must evaluate before it returns.
    """
    if dr.is_tensor_v(values):
        out = dr.detach(mi.TensorXf(values))
    else:
        try:
            plain = np.array(values, dtype=np.float32, order="C", copy=copy or None)
        except (TypeError, ValueError) as error:
            raise ShapeError(f"{caller}: {name} is not an array of numbers ({error}).") from error
        # Dr.Jit tensors reject empty NumPy arrays.
        out = mi.TensorXf(plain) if plain.size else dr.zeros(mi.TensorXf, plain.shape)
    wanted = ", ".join(str(axis) for axis in axes)
    fits = len(out.shape) == len(axes) and all(
        isinstance(axis, str) or axis == length
        for axis, length in zip(axes, out.shape, strict=True)
    )
    if not fits:
        raise ShapeError(f"{caller}: {name} must have shape ({wanted}), got {tuple(out.shape)}.")
    return out


def fold(start: Any, end: Any, body: Callable[..., Any], *state: Any) -> tuple[Any, ...]:
    """Loop ``number, *state = body(number, *state)`` from ``start`` to ``end``."""
    return dr.while_loop(
        state=(mi.UInt32(start), *state), cond=lambda number, *_: number < end, body=body
    )[1:]


def evenly_spaced(count: int, most: int) -> np.ndarray:
    """Return at most ``most`` evenly spaced indices from 0 to ``count`` - 1."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def fibonacci(count: int, lowest: float = -1.0, start: float = 0.0) -> np.ndarray:
    """Return a Fibonacci lattice of unit directions (count, 3) with y > ``lowest``.

    ``start`` turns the lattice about the y axis by a number of golden angles.
    """
    index = np.arange(count)
    y = 1 - (1 - lowest) * (index + 0.5) / count
    azimuth = (index + start) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=-1)
