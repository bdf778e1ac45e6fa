"""Textures as values per texel, and derivatives per texel on their way back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.parameters import CHANNELS
from svu_mi.statistics.gather import Values, flat


def look_up(textures: Mapping[str, Any], place: Any) -> Values:
    """Take the parameters of texels out of their textures.

    Args:
        textures: (H, W, C) TensorXf by name.
        place: (S,) UInt32, flat row-major, every texel once: derivatives are added without
            atomic operations.
    """

    def take(name: str, index: Any) -> Any:
        flat = textures[name].array
        return dr.gather(mi.Float, flat, index, mode=dr.ReduceMode.NoConflicts)

    return {name: [take(name, n * place + k) for k in range(n)] for name, n in CHANNELS.items()}


def carry(loss: Any, slopes: Values, values: Values, factor: Any) -> Any:
    """Return a scalar with known value and known derivatives.

    Args:
        loss: (S,) Float, evaluated: its sum times ``factor`` is the value.
        slopes: evaluated: derivatives of it for ``values``.
        values: what derivatives are passed on to.
        factor: opaque Float.
    """
    return carried(loss, flat(slopes), flat(values)) * factor


def carried(loss: Any, slopes: Sequence[Any], values: Sequence[Any]) -> Any:
    """The same of Floats that stand in order, without a factor."""
    nothing = dr.zeros(mi.Float, dr.width(loss))  # of what is passed on, only derivatives count
    inner = [slope * dr.replace_grad(nothing, value)
             for slope, value in zip(slopes, values, strict=True)]  # fmt: skip
    return dr.replace_grad(dr.sum(loss), dr.sum(sum(inner)))
