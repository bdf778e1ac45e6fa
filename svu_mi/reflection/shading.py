"""What one sample reflects, in parts that the material's parameters mix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr

from svu_mi.reflection.principled import columns, mixture

Parts = tuple[Any, Any, Any, Any]
"""(e, p, q, d) of one channel of the light, Floats: radiance (``reflection/principled.py``)."""


def parts_of(
    diffuse: list[tuple[Any, Any]], roughness: Any, reflected: tuple[Any, Any, Any],
    light: list[Any],
) -> list[Parts]:  # fmt: skip
    """Put diffuse and specular light together, for every channel of the light.

    Args:
        diffuse: a and b of a + b roughness, per channel (``diffuse_shading``).
        roughness: Float.
        reflected: (A, B, D), what a lobe reflects: R0 A + B, and that of a dielectric D.
        light: under the lobe, per channel.
    """
    A, B, D = reflected
    return [
        (dr.fma(roughness, b, a), A * value, B * value, D * value)
        for (a, b), value in zip(diffuse, light, strict=True)
    ]


def radiance(parts: list[Parts], base_color: Sequence[Any], mixed: Sequence[Any]) -> list[Any]:
    """Return outgoing radiance, a Float per channel of the base colour.

    Args:
        parts: per channel of the light, one of which stands for all under grey light.
        base_color: Floats in [0, 1].
        mixed: other parameters, as ``mixture`` takes them.
    """
    how = mixture(*mixed)
    return [
        dot(how.at(color), columns(*parts[k % len(parts)])) for k, color in enumerate(base_color)
    ]


def interpolated(
    levels: Sequence[list[Parts]], roughness: Any, base_color: Sequence[Any], mixed: Sequence[Any]
) -> list[Any]:
    """Return outgoing radiance at any roughness, linear between two levels.

    Args:
        levels: parts at even levels of roughness on [0, 1].
        roughness: Float.
        base_color: Floats, as ``radiance`` takes them.
        mixed: likewise.
    """
    place, found = roughness * (len(levels) - 1), [dr.zeros(type(roughness))] * len(base_color)
    for k, level in enumerate(levels):
        share = dr.maximum(1 - dr.abs(place - k), 0)
        here = radiance(level, base_color, mixed)
        found = [dr.fma(share, new, old) for new, old in zip(here, found, strict=True)]
    return found


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Return the sum of products."""
    total: Any = 0.0
    for x, y in zip(a, b, strict=True):
        total = dr.fma(x, y, total)
    return total
