"""Sufficient statistics of all views, per texel and roughness level (method: one pass).

For weights w_i the mean squared error over n views of the model b ~ Kd e + R0 p + q is a
quadratic in (Kd, R0). With t = b - q, six weighted sums hold it,

    sum w (e^2, e p, p^2, e t, p t, t^2),

and it is kept in *square-root form*: the triangular factor U of the sums, as a QR
factorisation of the samples would give it,

    1/n sum_i w_i (b_i - r_i)^2 = |U (Kd, R0)^T - z|^2 + floor + least,

where least is the same for all levels: what no (Kd, R0) of any roughness explains.

The sums are in double precision and the factor in single, which is safe: a residual taken
from the factor is exact to rounding of the *radiance*, where one taken from the sums would be
to rounding of its square. The number of views no longer matters, and no sample is stored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.angular.model import Reflection, Terms, terms
from svu_mi.frequency.arrays import scatter_strided
from svu_mi.radiance import Surface, Survey, Views
from svu_mi.radiance.hemisphere import as_channels, mirror_free
from svu_mi.radiance.observe import Observation

FIELDS = 6  # U_ee, U_ep, U_pp, z_e, z_p, floor
TINY = 2e-11  # part of its diagonal below which a pivot is nothing but rounding


@dataclass(frozen=True)
class Statistics:
    """What remains of the views of T texels.

    Attributes:
        values: ((R * C * 6 + C) * T,) Float: for level, channel and field, one value per
            texel; fields are U_ee, U_ep, U_pp, z_e, z_p, all in radiance, and floor, in
            squared radiance. Then, for every channel, least.
        views: (T,) UInt32, number n of views that see each texel.
        levels: R.
        channels: C.
        count: T.
    """

    values: Any
    views: Any
    levels: int
    channels: int
    count: int


def gather(
    views: Views,
    surface: Surface,
    found: Survey,
    model: Reflection,
    scale: Any,
    channels: int | None = None,
) -> Statistics:
    """Collect the statistics of texels: one kernel, one pass over the views.

    Args:
        views: the packed capture.
        surface: the texels that are asked for; ``model`` is of the same. Others stay 0.
        found: who sees whom, of all T texels.
        model: the reflection model.
        scale: Float, opaque: radiance above which heteroscedastic weights fall off; not used
            by the other noise rules.
        channels: of the photographs that are looked at, 1 or 3; by default those of the model,
            which has 1 for all of them under grey light.
    """
    levels, channels = len(model.roughness), channels or model.channels
    normal = mi.Vector3f(surface.normal)

    def consume(seen: Observation, _: Any, *sums: Any) -> Any:
        free = mi.Bool(True)
        if model.arriving.visible:
            free = mirror_free(views.scene, surface, seen, found.asked(seen.seen))

        def add(*state: Any) -> tuple[Any, ...]:
            # Inputs of the model reach a branch through the closure: they do not change.
            part = terms(model, normal, seen.direction, dr.maximum(seen.cosine, 1e-3), free)
            radiance = as_channels(seen.radiance, channels)
            w = dr.select(seen.seen, _weight(model, radiance, scale), 0)
            products = _products(part, radiance)
            return tuple(dr.fma(w, new, old) for old, new in zip(state, products, strict=True))

        asked = found.asked(seen.seen)
        return dr.if_stmt(args=sums, cond=asked, true_fn=add, false_fn=lambda *s: s)

    size = 3 * levels * (model.channels + channels)
    zeros = tuple(dr.zeros(mi.Float64, surface.count) for _ in range(size))
    sums = found.over_views(views, surface, consume, zeros)
    texel = surface.index
    count = dr.gather(mi.UInt32, found.coverage, texel)
    systems = _systems(list(sums), model.channels, channels)
    columns = _columns([_factor(system, count) for system in systems], channels)
    all_texels = int(dr.width(found.coverage))
    values = dr.zeros(mi.Float, len(columns) * all_texels)
    dr.eval(values)
    values = scatter_strided(values, columns, texel, dr.opaque(mi.UInt32, all_texels))
    dr.eval(values)
    return Statistics(values, found.coverage, levels, channels, all_texels)


def _columns(factors: list[list[Any]], channels: int) -> list[Any]:
    """Fields of every level and channel, then what no level of a channel explains."""
    least = []
    for channel in range(channels):
        of_channel = factors[channel::channels]
        low = of_channel[0][-1]
        for factor in of_channel:
            low = dr.minimum(low, factor[-1])
        for factor in of_channel:
            factor[-1] = factor[-1] - low
        least.append(low)
    return [field for factor in factors for field in factor] + least


def _weight(model: Reflection, radiance: list[Any], scale: Any) -> Any:
    """w of a sample, as Float64."""
    if model.switches.noise != "heteroscedastic":
        return mi.Float64(1)
    # The standard deviation grows with radiance: 1 + (b / scale)^2, in units of that of black.
    brightness = sum(radiance) / len(radiance)
    return mi.Float64(dr.rcp(1 + dr.square(brightness / scale)))


def _products(part: Terms, radiance: list[Any]) -> list[Any]:
    """The sums' terms, in double precision, level by level.

    First e^2, e p, p^2 of every channel of the light, then e t, p t, t^2 of every channel of
    the photographs.
    """
    products = []
    for e, p, q in zip(part.diffuse, part.scaled, part.added, strict=True):
        e, p = _double(e), _double(p)
        for e_c, p_c in zip(e, p, strict=True):
            products += [e_c * e_c, e_c * p_c, p_c * p_c]
        for c, b in enumerate(radiance):
            k = c % len(e)  # grey light has one channel for all
            t = mi.Float64(b - q[k])
            products += [e[k] * t, p[k] * t, t * t]
    return products


def _double(values: list[Any]) -> list[Any]:
    return [mi.Float64(value) for value in values]


def _systems(sums: list[Any], light: int, channels: int) -> list[list[Any]]:
    """Return the six sums of every level and channel of the photographs."""
    systems, size = [], 3 * (light + channels)
    for first in range(0, len(sums), size):
        level = sums[first : first + size]
        for c in range(channels):
            shared, own = 3 * (c % light), 3 * (light + c)
            systems.append(level[shared : shared + 3] + level[own : own + 3])
    return systems


def _factor(sums: list[Any], views: Any) -> list[Any]:
    """Cholesky factor of six sums divided by n: U_ee, U_ep, U_pp, z_e, z_p, floor."""
    inverse = dr.rcp(mi.Float64(dr.maximum(views, 1)))
    ee, ep, pp, et, pt, tt = (value * inverse for value in sums)
    scale_e = inverse_root(ee, 0 * ee)
    u_ee, u_ep, z_e = ee * scale_e, ep * scale_e, et * scale_e
    rest = pp - u_ep * u_ep
    scale_p = inverse_root(rest, TINY * pp)
    u_pp, z_p = rest * scale_p, (pt - u_ep * z_e) * scale_p
    floor = dr.maximum(tt - z_e * z_e - z_p * z_p, 0)
    return [u_ee, u_ep, u_pp, z_e, z_p, floor]


def inverse_root(pivot: Any, threshold: Any) -> Any:
    """Return 1 / sqrt(pivot), or 0 where it is not above its threshold: a dependent column."""
    good = pivot > threshold
    return dr.select(good, dr.rsqrt(dr.select(good, pivot, 1)), 0)
