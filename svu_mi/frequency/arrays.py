"""Arrays at the public border: tensors or NumPy in, TensorXf out, the shape checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import ShapeError


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


def scatter_rows(target: Any, rows: list[list[Any]], texel: Any) -> Any:
    """Write lanes to texel-major memory, within the kernel that computes them.

    Args:
        target: flat array, (texel, row, channel).
        rows: per row a list of channels, one value per lane.
        texel: UInt32, where each lane goes.

    Returns:
        ``target``, to be evaluated.
    """
    values = [value for channels in rows for value in channels]
    return scatter_strided(target, values, texel * len(values), 1)


@dr.syntax
def scatter_strided(target: Any, values: list[Any], start: Any, stride: Any) -> Any:
    """Write value k of every lane to ``start + k * stride``, within the kernel that computes it.

    Args:
        target: flat array of Float or Float64.
        values: one number per lane each, converted to that.
        start: UInt32, per lane.
        stride: UInt32.

    Returns:
        ``target``, to be evaluated.
    """
    # Scatters outside a symbolic loop would each become a kernel that computes all over
    # again, and dr.concat one per number of lanes.
    count, kind = len(values), type(target)
    memory = dr.alloc_local(kind, count)
    for k, value in enumerate(values):
        memory[k] = kind(value)
    k = mi.UInt32(0)
    while k < dr.opaque(mi.UInt32, count):
        dr.scatter(target, memory[k], start + k * stride)
        k += 1
    return target
