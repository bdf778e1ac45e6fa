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
from svu_mi.radiance import Surface, Survey, Views, over_views
from svu_mi.radiance.hemisphere import as_channels, mirror_free
from svu_mi.radiance.observe import Observation, Tally

FIELDS = 6  # U_ee, U_ep, U_pp, z_e, z_p, floor
SUMS = 6
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
        survey: what was seen on the way, if the statistics were gathered from views.
    """

    values: Any
    views: Any
    levels: int
    channels: int
    count: int
    survey: Survey | None = None


def gather(views: Views, surface: Surface, model: Reflection, scale: Any) -> Statistics:
    """Collect the statistics of every texel: one kernel, one pass over the views.

    Args:
        views: the packed capture.
        surface: the texels; ``model`` is of the same.
        model: the reflection model.
        scale: Float, opaque: radiance above which heteroscedastic weights fall off; not used
            by the other noise rules.
    """
    levels, channels = len(model.roughness), model.channels
    tally = Tally(views)
    normal = mi.Vector3f(surface.normal)

    def consume(seen: Observation, view: Any, found: tuple[Any, Any], *sums: Any) -> Any:
        free = mi.Bool(True)
        if model.arriving.visible:
            free = mirror_free(views.scene, surface, seen)

        def add(*state: Any) -> tuple[Any, ...]:
            # Inputs of the model reach a branch through the closure: they do not change.
            part = terms(model, normal, seen.direction, dr.maximum(seen.cosine, 1e-3), free)
            radiance = as_channels(seen.radiance, channels)
            w = _weight(model, radiance, scale)
            products = _products(part, radiance)
            return tuple(dr.fma(w, new, old) for old, new in zip(state, products, strict=True))

        new = dr.if_stmt(args=sums, cond=seen.seen, true_fn=add, false_fn=lambda *s: s)
        return (tally.add(seen, view, found), *new)

    size = levels * channels * SUMS
    zeros = [dr.zeros(mi.Float64, surface.count) for _ in range(size)]
    found, *sums = over_views(views, surface, consume, (tally.start(surface), *zeros))
    count = found[0]
    factors = [_factor(sums[i : i + SUMS], count) for i in range(0, len(sums), SUMS)]
    least = []
    for channel in range(channels):
        of_channel = factors[channel::channels]
        low = of_channel[0][-1]
        for factor in of_channel:
            low = dr.minimum(low, factor[-1])
        for factor in of_channel:
            factor[-1] = factor[-1] - low
        least.append(low)
    columns = [field for factor in factors for field in factor]
    columns += least
    values = dr.zeros(mi.Float, len(columns) * surface.count)
    dr.eval(values)
    lane, stride = dr.arange(mi.UInt32, surface.count), dr.opaque(mi.UInt32, surface.count)
    values = scatter_strided(values, columns, lane, stride)
    dr.eval(values, found, tally.per_view)
    return Statistics(values, count, levels, channels, surface.count, tally.survey(found))


def _weight(model: Reflection, radiance: list[Any], scale: Any) -> Any:
    """w of a sample, as Float64."""
    if model.switches.noise != "heteroscedastic":
        return mi.Float64(1)
    # The standard deviation grows with radiance: 1 + (b / scale)^2, in units of that of black.
    brightness = sum(radiance) / len(radiance)
    return mi.Float64(dr.rcp(1 + dr.square(brightness / scale)))


def _products(part: Terms, radiance: list[Any]) -> list[Any]:
    """The six products of every level and channel, in double precision."""
    products = []
    for level in zip(part.diffuse, part.scaled, part.added, strict=True):
        for e, p, q, b in zip(*level, radiance, strict=True):
            e, p, t = mi.Float64(e), mi.Float64(p), mi.Float64(b - q)
            products += [e * e, e * p, p * p, e * t, p * t, t * t]
    return products


def _factor(sums: list[Any], views: Any) -> list[Any]:
    """Cholesky factor of the sums divided by n: U_ee, U_ep, U_pp, z_e, z_p, floor."""
    inverse = dr.rcp(mi.Float64(dr.maximum(views, 1)))
    ee, ep, pp, et, pt, tt = (value * inverse for value in sums)
    scale_e = _inverse_root(ee, 0 * ee)
    u_ee, u_ep, z_e = ee * scale_e, ep * scale_e, et * scale_e
    rest = pp - u_ep * u_ep
    scale_p = _inverse_root(rest, TINY * pp)
    u_pp, z_p = rest * scale_p, (pt - u_ep * z_e) * scale_p
    floor = dr.maximum(tt - z_e * z_e - z_p * z_p, 0)
    return [u_ee, u_ep, u_pp, z_e, z_p, floor]


def _inverse_root(pivot: Any, threshold: Any) -> Any:
    """1 / sqrt(pivot), or 0 where the pivot is not above its threshold: a dependent column."""
    good = pivot > threshold
    return dr.select(good, dr.rsqrt(dr.select(good, pivot, 1)), 0)
