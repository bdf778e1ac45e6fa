"""Between levels of roughness: cubic splines through the four nearest [Catmull and Rom 1974]."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def catmull_rom(t: Any) -> list[Any]:
    """Return the weights of four values, between the second and the third of which t lies.

    Args:
        t: in [0, 1]; numbers, NumPy and Dr.Jit arrays alike.
    """
    return [
        0.5 * t * (-1 + t * (2 - t)),
        0.5 * (2 + t * t * (-5 + 3 * t)),
        0.5 * t * (1 + t * (4 - 3 * t)),
        0.5 * t * t * (t - 1),
    ]


def between_levels(roughness: Any, levels: int) -> tuple[list[Any], list[Any], list[Any]]:
    """Return four levels around a roughness, their weights, and the derivatives of these.

    Args:
        roughness: Float; values outside [0, 1] are those of the end.
        levels: how many there are, uniform on [0, 1]; beyond either end the last repeats.
    """
    last = dr.opaque(mi.Float, levels - 1)
    place = dr.clip(roughness, 0, 1) * last
    first = dr.maximum(dr.minimum(dr.floor(place), last - 1), 0)  # one level is all there is
    t = place - first
    slopes = [
        0.5 * last * (-1 + t * (4 - 3 * t)),
        0.5 * last * t * (-10 + 9 * t),
        0.5 * last * (1 + t * (8 - 9 * t)),
        0.5 * last * t * (3 * t - 2),
    ]
    near = [mi.UInt32(dr.clip(first + step, 0, last)) for step in (-1, 0, 1, 2)]
    return near, catmull_rom(t), slopes
