"""Between levels of roughness: cubic splines through the four nearest [Catmull and Rom 1974]."""

from __future__ import annotations

from typing import Any


def catmull_rom(t: Any) -> list[Any]:
    """Return the weights of four values, between the second and the third of which t lies."""
    return [
        0.5 * t * (-1 + t * (2 - t)),
        0.5 * (2 + t * t * (-5 + 3 * t)),
        0.5 * t * (1 + t * (4 - 3 * t)),
        0.5 * t * t * (t - 1),
    ]
