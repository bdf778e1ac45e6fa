"""From photographs to statistics: one kernel, one pass over the views."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from svu_mi.errors import OptionError
from svu_mi.parameters import MIXED, NAMES
from svu_mi.reflection.model import Model
from svu_mi.reflection.principled import columns
from svu_mi.reflection.shading import Parts, hats, interpolated, radiance
from svu_mi.statistics.censored import CLIPPED_PART, Models, parabola
from svu_mi.statistics.factors import PAIRS
from svu_mi.statistics.sums import EDGES, Gathered, noise_weight
from svu_mi.visibility import Observation, Surface, Survey, Views
from svu_mi.visibility.bits import Bits
from svu_mi.visibility.pixels import as_channels
from svu_mi.visibility.reach import Mirrors

GRAZING = 1e-3  # cosine: more grazing views are treated like this one
SMALLEST = 0.05  # error, in units of kappa, from which a sample counts no more than others


Values = dict[str, list[Any]]
"""Parameters of S texels, by name: a Float for every channel."""


@dataclass(frozen=True)
class Weighting:
    """How much samples count.

    Attributes:
        kappa: radiance around which they begin to count less (see ``Statistics``).
        edges: how much less those on edges of a photograph count (``noise_weight``).
        models: of the texels, that clipped channels are compared with (``censored``); nothing but
            those channels counts then. Without any, all others do.
        current: parameters of the texels. Samples then also count less the more these are off,
            by 1 / |r - b|: squares become absolute errors [Holland and Welsch 1977]. Sums that
            are weighted so never add to others: their kappa is NaN. Levels must be uniform on
            [0, 1], between which r is interpolated.
    """

    kappa: float = inf
    edges: float = EDGES
    current: Values | None = None
    models: Models | None = None


ALIKE = Weighting()


def gather(
    views: Views, found: Survey, model: Model, mirrors: Mirrors | None,
    channels: int | None = None, weighting: Weighting = ALIKE,
) -> Gathered:  # fmt: skip
    """Collect the statistics of the texels of a model.

    Args:
        views: the packed capture.
        found: which views see which texels, of all texels.
        model: the reflection model of S texels.
        mirrors: what stands in the mirror direction of a sample; None if nothing does.
        channels: C of the photographs, 3 or 1; the model's by default. A model of one channel,
            under grey light, stands for all.
        weighting: how much samples count; all alike by default.

    Raises:
        OptionError: ``current`` without a finite kappa, or in grey.
    """
    surface, levels = model.surface, model.levels
    kappa, current = weighting.kappa, weighting.current
    channels = channels or model.channels
    if current is not None and not (kappa < inf and channels == 3):
        raise OptionError("gather(): current needs a finite kappa and 3 channels.")
    knee, weighted = dr.opaque(mi.Float, kappa), kappa < inf
    eta = dr.opaque(mi.Float, weighting.edges)
    clipped = found.clipped is not None and current is None

    def consume(seen: Observation, slot: Any, *sums: Any) -> Any:
        free = mi.Bool(True) if mirrors is None else mirrors.test(slot, surface.index)

        def add(weight: Any, number: Any, *state: Any) -> tuple[Any, ...]:
            lobes = model.columns(seen.direction, dr.maximum(seen.cosine, GRAZING), free)
            observed = as_channels(seen.radiance, channels)
            w = dr.select(seen.seen, mi.Float(1), 0)
            if weighted:
                w *= noise_weight(sum(observed) / channels, knee, seen.contrast, eta)
            if current is not None:
                off = sum(_errors(lobes, observed, current)) / channels
                w *= knee / dr.maximum(off, SMALLEST * knee)
            shown: list[list[Shown]] = [[Shown(b) for b in observed]] * levels
            part: Any = mi.Float(1)
            if clipped:
                shown = _clipped(lobes, observed, seen.clipped, w, surface.lane, weighting.models)
                part = sum(one.part for of_level in shown for one in of_level) / (levels * channels)
                number = number + dr.select(seen.seen, part, 0)
            weight, w = weight + mi.Float64(part * w), mi.Float64(w)
            added = [x for pair in zip(lobes, shown, strict=True) for x in _products(*pair)]
            return weight, number, *(
                dr.fma(w, new, old) for old, new in zip(state, added, strict=True)
            )

        return dr.if_stmt(
            args=sums, cond=found.asked(seen.seen),
            true_fn=add, false_fn=lambda *state: state,
        )  # fmt: skip

    among = weighting.models.samples if weighting.models is not None else None
    count, size = surface.count, levels * channels * len(PAIRS)
    none = dr.zeros(mi.Float, count if clipped else 1)
    zeros = (dr.zeros(mi.Float64, count), none, *(dr.zeros(mi.Float64, count) for _ in range(size)))
    weight, partly, *sums = found.over_views(
        views, surface, consume, zeros, clipped=clipped, among=among
    )
    counts = partly if clipped else mi.Float(dr.gather(mi.UInt32, found.coverage, surface.index))
    return Gathered(
        sums, weight, counts, surface.index, model.roughness, channels,
        kappa if current is None else nan, weighting.edges,
    )  # fmt: skip


def clipped_samples(views: Views, found: Survey, surface: Surface) -> Bits:
    """Return which samples of S texels have channels that are clipped: a bit per number of a view
    in ``found.order`` and lane."""
    bits = Bits.clear(views.number, surface.count)

    def consume(seen: Observation, slot: Any, found: Any) -> tuple[Any]:
        flagged = seen.seen & (dr.max(seen.clipped) > CLIPPED_PART)
        bits.set(slot, surface.lane, flagged)
        return (found | flagged,)

    (some,) = found.over_views(
        views, surface, consume, (dr.zeros(mi.Bool, surface.count),), clipped=True
    )
    dr.eval(bits, some)
    return bits


def flat(values: Values) -> list[Any]:
    """Return all Floats, parameter by parameter in the order of ``NAMES``."""
    return [x for name in NAMES for x in values[name]]


def mixed_of(values: Values) -> list[Any]:
    """Return the values that mix the columns, in the order of ``MIXED``."""
    return [values[name][0] for name in MIXED]


class Shown(NamedTuple):
    """Radiance of a channel, and how much it counts; None if all channels count alike."""

    radiance: Any
    part: Any = None


def _products(level: list[Parts], shown: list[Shown]) -> list[Any]:
    """Products of the columns of every channel, in double precision."""
    products = []
    for c, (b, part) in enumerate(shown):
        # Grey light has one channel for all.
        u = [mi.Float64(column) for column in columns(*level[c % len(level)], b)]
        counted = u if part is None else [mi.Float64(part) * column for column in u]
        products += [counted[i] * u[j] for i, j in PAIRS]
    return products


def _clipped(
    lobes: list[list[Parts]], observed: list[Any], over: Any, weight: Any, lane: Any,
    models: Models | None,
) -> list[list[Shown]]:  # fmt: skip
    """Return what channels show at every level.

    Args:
        lobes: of the levels.
        observed: radiance of C channels; where they are clipped, at least.
        over: Color3f, part of each that is clipped.
        weight: of the sample.
        lane: UInt32, of the launch.
        models: what clipped channels are compared with.
    """
    parts = list(over) if len(observed) > 1 else [dr.max(over)]
    flags = [part > CLIPPED_PART for part in parts]
    if models is None:
        dropped = [Shown(b, dr.select(flag, mi.Float(0), 1))
                   for b, flag in zip(observed, flags, strict=True)]  # fmt: skip
        return [dropped] * len(lobes)
    noise, found = models.noise(lane) * dr.rsqrt(dr.maximum(weight, 1e-6)), []
    for number, level in enumerate(lobes):
        mixed, color = models.of_level(lane, number, len(lobes))
        of_level = []
        for b, flag, r in zip(observed, flags, radiance(level, color, mixed), strict=True):
            t, h = parabola(r, b, noise)
            of_level.append(Shown(t, dr.select(flag, h, 0)))
        found.append(of_level)
    return found


def _errors(found: list[list[Parts]], observed: list[Any], current: Values) -> list[Any]:
    """|r - b| of every channel."""
    (roughness,) = current["roughness"]
    shares = hats(roughness, len(found))
    r = interpolated(found, shares, current["base_color"], mixed_of(current))
    return [dr.abs(x - b) for x, b in zip(r, observed, strict=True)]
