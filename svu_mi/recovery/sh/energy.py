"""Mean squared error of parameters, and its derivatives, from sufficient statistics.

The factors of a texel are smooth functions of roughness; between levels they are interpolated
by Catmull-Rom splines [Catmull and Rom 1974], so that the error has a derivative there, too.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.statistics.factors import COLUMNS, PAIRS, Factors
from svu_mi.statistics.gather import Values
from svu_mi.statistics.spline import catmull_rom


def energy(factors: Factors, values: Values) -> tuple[Any, list[Any]]:
    """Return the squared error of S texels, the mean over their views and channels.

    Args:
        factors: of S texels.
        values: their parameters in [0, 1].

    Returns:
        Float (S,), squared radiance, and its derivatives by every parameter.
    """
    levels, weights, slopes = _spline(factors, values.roughness)
    m, colors = values.metallic, values[:3]
    error, by_roughness, by_metallic = mi.Float(0), mi.Float(0), mi.Float(0)
    by_color = []
    for channel, c in enumerate(colors):
        # One channel stands for all where photographs and light are grey.
        of_channel = channel % factors.channels
        factor, turned = _interpolate(factors, of_channel, levels, weights, slopes)
        u, v = halves(factor, m)
        u_r, v_r = halves(turned, m)
        rest = [dr.fma(c, a, b) for a, b in zip(u, v, strict=True)]
        error += _dot(rest, rest)
        by_color.append(2 * _dot(rest, u))
        by_roughness += 2 * _dot(rest, [dr.fma(c, a, b) for a, b in zip(u_r, v_r, strict=True)])
        (e, p, g, _) = _columns(factor)
        change = [dr.fma(c, y - x, z) for x, y, z in zip(e, p, g, strict=True)]
        by_metallic += 2 * _dot(rest, change)
    scale = 1 / len(colors)
    return scale * error, [scale * slope for slope in (*by_color, by_roughness, by_metallic)]


def halves(factor: list[Any], metallic: Any) -> tuple[list[Any], list[Any]]:
    """Return u and v of r - b = c u + v (statistics/sums.py), as four components each.

    Args:
        factor: entries of U, in the order of ``PAIRS``.
        metallic: m.
    """
    e, p, g, t = _columns(factor)
    u = [dr.lerp(a, b, metallic) for a, b in zip(e, p, strict=True)]
    v = [dr.fma(metallic, a, b) for a, b in zip(g, t, strict=True)]
    return u, v


def _columns(factor: list[Any]) -> list[list[Any]]:
    """Return the columns of U: those of e, p, q - d and d - b."""
    U = dict(zip(PAIRS, factor, strict=True))
    return [
        [U.get((row, column), mi.Float(0)) for row in range(COLUMNS)] for column in range(COLUMNS)
    ]


def _dot(a: list[Any], b: list[Any]) -> Any:
    total = mi.Float(0)
    for x, y in zip(a, b, strict=True):
        total = dr.fma(x, y, total)
    return total


def _spline(factors: Factors, roughness: Any) -> tuple[list[Any], list[Any], list[Any]]:
    """Return four levels around a roughness, their weights, and the derivatives of these."""
    last = dr.opaque(mi.Float, factors.levels - 1)
    place = dr.clip(roughness, 0, 1) * last
    first = dr.maximum(dr.minimum(dr.floor(place), last - 1), 0)  # one level is all there is
    t = place - first
    slopes = [
        0.5 * last * (-1 + t * (4 - 3 * t)),
        0.5 * last * t * (-10 + 9 * t),
        0.5 * last * (1 + t * (8 - 9 * t)),
        0.5 * last * t * (3 * t - 2),
    ]
    levels = [mi.UInt32(dr.clip(first + step, 0, last)) for step in (-1, 0, 1, 2)]
    return levels, catmull_rom(t), slopes


def _interpolate(
    factors: Factors, channel: int, levels: list[Any], weights: list[Any], slopes: list[Any]
) -> tuple[list[Any], list[Any]]:
    """Return U at a roughness, and its derivative."""
    reader = factors.at()
    near = [reader.factor(level, channel) for level in levels]
    values, turned = [], []
    for entry in range(len(PAIRS)):
        value, slope = mi.Float(0), mi.Float(0)
        for factor, weight, change in zip(near, weights, slopes, strict=True):
            value = dr.fma(weight, factor[entry], value)
            slope = dr.fma(change, factor[entry], slope)
        values.append(value)
        turned.append(slope)
    return values, turned
