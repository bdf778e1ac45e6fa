"""Textures as values per texel, and derivatives per texel on their way back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.statistics.gather import Values


def look_up(textures: Mapping[str, Any], place: Any) -> Values:
    """Take the parameters of texels out of their textures.

    Args:
        textures: base_color (H, W, 3), roughness and metallic (H, W, 1), TensorXf.
        place: (S,) UInt32, flat row-major, every texel once: derivatives are added without
            atomic operations.
    """

    def take(name: str, index: Any) -> Any:
        flat = textures[name].array
        return dr.gather(mi.Float, flat, index, mode=dr.ReduceMode.NoConflicts)

    red, green, blue = (take("base_color", 3 * place + k) for k in range(3))
    return Values(red, green, blue, take("roughness", place), take("metallic", place))


def carry(loss: Any, slopes: Sequence[Any], values: Values, factor: Any) -> Any:
    """Return a scalar with known value and known derivatives.

    Args:
        loss: (S,) Float, evaluated: its sum times ``factor`` is the value.
        slopes: five (S,) Floats, evaluated: derivatives of it for ``values``.
        values: what derivatives are passed on to.
        factor: opaque Float.
    """
    total = dr.sum(loss) * factor
    inner = [slope * value for slope, value in zip(slopes, values, strict=True)]
    return dr.replace_grad(total, dr.sum(sum(inner)) * factor)
