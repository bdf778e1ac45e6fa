"""Radiance of one sample as a mixture of diffuse and specular parts."""

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr

from svu_mi.presets import Diffuse
from svu_mi.reflection.principled import columns, mixture

Parts = tuple[Any, Any, Any, Any]
"""(e, p, q, d) of one channel, Floats in radiance (see ``reflection/principled.py``)."""


def combine_parts(
    diffuse: list[tuple[Any, Any]], roughness: Any, reflected: tuple[Any, Any, Any],
    light: list[Any],
) -> list[Parts]:  # fmt: skip
    """Return the parts (e, p, q, d) of each channel; ``reflected`` are albedos (A, B, D)."""
    A, B, D = reflected
    return [
        (dr.fma(roughness, b, a), A * value, B * value, D * value)
        for (a, b), value in zip(diffuse, light, strict=True)
    ]


def mixed_radiance(
    parts: list[Parts], base_color: Sequence[Any], mixed: Sequence[Any]
) -> list[Any]:
    """Return the outgoing radiance, a Float per channel of the base colour."""
    mix = mixture(*mixed)
    return [
        dot(mix.at(color), columns(*parts[k % len(parts)])) for k, color in enumerate(base_color)
    ]


def interpolate_radiance(
    levels: Sequence[list[Parts]], shares: Sequence[Any], base_color: Sequence[Any],
    mixed: Sequence[Any],
) -> list[Any]:  # fmt: skip
    """Return the outgoing radiance, interpolated between roughness levels by ``shares``."""
    total = [dr.zeros(type(shares[0]))] * len(base_color)
    for level, share in zip(levels, shares, strict=True):
        added = mixed_radiance(level, base_color, mixed)
        total = [dr.fma(share, new, old) for new, old in zip(added, total, strict=True)]
    return total


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Return the scalar product."""
    total: Any = 0.0
    for x, y in zip(a, b, strict=True):
        total = dr.fma(x, y, total)
    return total


def diffuse_shading(
    model: Diffuse, moments: list[Any], direction: Any, cosine: Any
) -> tuple[Any, Any]:
    """Return (a, b): a white diffuse surface has the radiance a + roughness b.

    Disney's model [Burley 2015] as in Mitsuba's ``principled``, with Schlick weights
    F = (1 - cos)^5 of the incident (i) and outgoing (o) direction, is

        f = ((1 - F_o / 2) (1 - F_i / 2) + R (F_o + F_i + F_o F_i (R - 1))) / pi,
        R = roughness (1 + w_i . w_o).

    Without R^2 F_o F_i, it is linear in the eight ``moments`` (``LightVisibility.diffuse``).
    """
    c0, m0, c1, m1 = moments[0], moments[1:4], moments[4], moments[5:8]
    if model == "lambert":
        return c0 / math.pi, 0.0 * c0
    F_o = (1 - cosine) ** 5
    d0 = c0 + sum(m * w for m, w in zip(m0, direction, strict=True))
    d1 = c1 + sum(m * w for m, w in zip(m1, direction, strict=True))
    a = (1 - 0.5 * F_o) * (c0 - 0.5 * c1)
    b = dr.lerp(d1, d0, F_o)
    return a / math.pi, b / math.pi
