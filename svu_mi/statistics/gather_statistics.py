"""Statistics from photographs: one kernel and one pass over the views."""

from dataclasses import dataclass
from math import inf, nan
from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.quantization import variance
from svu_mi.errors import OptionError
from svu_mi.geometry.bitset import Bits
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import TexelLanes, ViewSample
from svu_mi.geometry.visibility import Visibility
from svu_mi.light.light_visibility import SampleBits
from svu_mi.parameters import MIXED, NAMES
from svu_mi.reflection.mix_columns import Parts, interpolate_radiance, mixed_radiance
from svu_mi.reflection.principled import columns
from svu_mi.reflection.reflection_model import ReflectionModel
from svu_mi.reflection.roughness_levels import linear_weights
from svu_mi.statistics.censored import CLIPPED_PART, BestModels, parabola
from svu_mi.statistics.cholesky_factors import PAIRS
from svu_mi.statistics.statistics import EDGES, LazyStatistics, noise_weight

GRAZING = 1e-3  # minimum cosine of the viewing angle
SMALLEST = 0.05  # minimum error |r - b|, relative to kappa

Values = dict[str, list[Any]]
"""Parameters of S texels by name: a Float per channel."""


@dataclass(frozen=True)
class Weighting:
    """Weights of samples.

    Attributes:
        kappa: radiance above which weights decrease (``noise_weight``).
        edges: eta, decrease of weights at image edges (``noise_weight``).
        current: parameters whose error |r - b| divides weights, to minimise absolute errors
            [Holland and Welsch 1977]. Requires ``roughness_levels``; sets kappa to NaN.
        models: best models of the texels; if given, only saturated channels are summed
            (``censored``).
    """

    kappa: float = inf
    edges: float = EDGES
    current: Values | None = None
    models: BestModels | None = None


UNIFORM = Weighting()


def gather_statistics(
    views: Views, visibility: Visibility, model: ReflectionModel, mirrors: SampleBits | None,
    channels: int | None = None, weighting: Weighting = UNIFORM,
) -> LazyStatistics:  # fmt: skip
    """Return the statistics of a model's texels in C channels, 3 or 1.

    A one-channel model (grey light) is used for all C. Without ``mirrors``,
    mirror directions count as unoccluded.
    """
    surface, kappa, channels = model.surface, weighting.kappa, channels or model.channels
    samples = _sample_model(weighting, channels)
    saturated = visibility.clipped is not None and samples.reads_saturated
    knee, eta = dr.opaque(mi.Float, kappa), dr.opaque(mi.Float, weighting.edges)
    size = model.levels * channels * len(PAIRS)

    def consume(seen: ViewSample, slot: Any, *sums: Any) -> Any:
        free = mi.Bool(True) if mirrors is None else mirrors.test(slot, surface.index)

        def add(weight: Any, number: Any, *state: Any) -> tuple[Any, ...]:
            cosine = dr.maximum(seen.cosine, GRAZING)
            lobes = model.columns(seen.direction, cosine, free, slot, seen.bend)
            radiance, w = as_channels(seen.radiance, channels), dr.select(seen.seen, mi.Float(1), 0)
            if kappa < inf:
                w *= noise_weight(sum(radiance) / channels, knee, seen.contrast, eta)
            flags = _saturated(seen.clipped, channels) if saturated else None
            terms, w = samples.columns_and_weights(
                TexelSample(lobes, radiance, flags, w, surface.lane)
            )
            part: Any = mi.Float(1)
            if saturated:
                part = sum(share for _, share in terms) / len(terms)
                number = number + dr.select(seen.seen, part, 0)
            weight, w = weight + mi.Float64(part * w), mi.Float64(w)
            added = [product for term in terms for product in _products(*term)]
            return (
                weight,
                number,
                *(dr.fma(w, new, old) for old, new in zip(state, added, strict=True)),
            )

        return dr.if_stmt(sums, visibility.needs_work(seen.seen), add, lambda *state: state)

    none = dr.zeros(mi.Float, surface.count if saturated else 1)
    weight, *state = (dr.zeros(mi.Float64, surface.count) for _ in range(1 + size))
    among = weighting.models.samples if weighting.models is not None else None
    weight, counts, *sums = visibility.over_views(
        views, surface, consume, (weight, none, *state), clipped=saturated, among=among
    )
    if not saturated:
        counts = mi.Float(dr.gather(mi.UInt32, visibility.coverage, surface.index))
    return LazyStatistics(
        sums, weight, counts, surface.index, model.roughness, channels,
        kappa if weighting.current is None else nan, weighting.edges,
    )  # fmt: skip


class TexelSample(NamedTuple):
    """Sample of each texel in one view, with C channels and R roughness levels.

    Attributes:
        lobes: parts of the model for each level and channel of the light.
        radiance: C Floats; lower bounds where saturated.
        saturated: C Bools; None if no photograph has saturated pixels.
    """

    lobes: list[list[Parts]]
    radiance: list[Any]
    saturated: list[Any] | None
    weight: Any
    lane: Any


Columns = tuple[tuple[Any, ...], Any]
"""Columns of r - b, and a factor of the sample's weight (None: 1)."""


class SampleModel(Protocol):
    """Interface: columns and weight of a sample in the statistics."""

    reads_saturated: bool

    def columns_and_weights(self, sample: TexelSample) -> tuple[list[Columns], Any]:
        """Return the columns of each level and channel, level by level, and the weight."""


class UnsaturatedSamples:
    """Samples without saturated channels."""

    reads_saturated = True

    def columns_and_weights(self, sample: TexelSample) -> tuple[list[Columns], Any]:
        """See ``SampleModel``."""
        parts: list[Any] = [None] * len(sample.radiance)
        if sample.saturated is not None:
            parts = [dr.select(flag, mi.Float(0), 1) for flag in sample.saturated]
        shown = list(zip(sample.radiance, parts, strict=True))
        return [term for level in sample.lobes for term in _columns(level, shown)], sample.weight


class ReweightedSamples:
    """Samples whose weights are divided by the error of the current parameters."""

    reads_saturated = False

    def __init__(self, current: Values, kappa: float) -> None:
        self._current, self._knee = current, dr.opaque(mi.Float, kappa)

    def columns_and_weights(self, sample: TexelSample) -> tuple[list[Columns], Any]:
        """See ``SampleModel``."""
        current = self._current
        shares = linear_weights(current["roughness"][0], len(sample.lobes))
        r = interpolate_radiance(
            sample.lobes, shares, current["base_color"], mixing_values(current)
        )
        off = sum(dr.abs(x - b) for x, b in zip(r, sample.radiance, strict=True)) / len(r)
        weight = sample.weight * (self._knee / dr.maximum(off, SMALLEST * self._knee))
        shown = [(b, None) for b in sample.radiance]
        return [term for level in sample.lobes for term in _columns(level, shown)], weight


class CensoredSamples:
    """Samples of saturated channels only, as parabolas around given models (``censored``)."""

    reads_saturated = True

    def __init__(self, models: BestModels) -> None:
        self._models = models

    def columns_and_weights(self, sample: TexelSample) -> tuple[list[Columns], Any]:
        """See ``SampleModel``."""
        assert sample.saturated is not None
        noise = self._models.noise(sample.lane) * dr.rsqrt(dr.maximum(sample.weight, 1e-6))
        terms: list[Columns] = []
        for number, level in enumerate(sample.lobes):
            mixed, color = self._models.parameters(sample.lane, number, len(sample.lobes))
            expected, shown = mixed_radiance(level, color, mixed), []
            for b, flag, r in zip(sample.radiance, sample.saturated, expected, strict=True):
                t, h = parabola(r, b, noise)
                shown.append((t, dr.select(flag, h, 0)))
            terms += _columns(level, shown)
        return terms, sample.weight


def _sample_model(weighting: Weighting, channels: int) -> SampleModel:
    """Return the sample model of a weighting."""
    if weighting.current is not None:
        if not (weighting.kappa < inf and channels == 3):
            raise OptionError("gather_statistics(): current needs a finite kappa and 3 channels.")
        return ReweightedSamples(weighting.current, weighting.kappa)
    return UnsaturatedSamples() if weighting.models is None else CensoredSamples(weighting.models)


def clipped_samples(views: Views, visibility: Visibility, surface: TexelLanes) -> Bits:
    """Return one bit per sample, 1 if saturated; bit n is view n of ``Visibility.order``."""
    bits = Bits.clear(views.number, surface.count)

    def consume(seen: ViewSample, slot: Any, touched: Any) -> tuple[Any]:
        flagged = seen.seen & (dr.max(seen.clipped) > CLIPPED_PART)
        bits.set(slot, surface.lane, flagged)
        return (touched | flagged,)

    (touched,) = visibility.over_views(
        views, surface, consume, (dr.zeros(mi.Bool, surface.count),), clipped=True
    )
    dr.eval(bits, touched)
    return bits


def flatten_values(values: Values) -> list[Any]:
    """Return the Floats of all parameters in one list, in the order of ``NAMES``."""
    return [x for name in NAMES for x in values[name]]


def mixing_values(values: Values) -> list[Any]:
    """Return the mixing parameters, in the order of ``MIXED``."""
    return [values[name][0] for name in MIXED]


def _saturated(over: Any, channels: int) -> list[Any]:
    """Return C Bools, True if the fraction of saturated pixels exceeds ``CLIPPED_PART``."""
    parts = list(over) if channels > 1 else [dr.max(over)]
    return [part > CLIPPED_PART for part in parts]


def _columns(level: list[Parts], shown: list[tuple[Any, Any]]) -> list[Columns]:
    """Return (columns, weight factor) of each channel at one level."""
    return [(columns(*level[c % len(level)], b), part) for c, (b, part) in enumerate(shown)]


def _products(columns: tuple[Any, ...], part: Any) -> list[Any]:
    """Return products of pairs of columns, times ``part`` (None: 1), in double precision."""
    u = [mi.Float64(column) for column in columns]
    counted = u if part is None else [mi.Float64(part) * column for column in u]
    return [counted[i] * u[j] for i, j in PAIRS]


def rounding_sums(
    views: Views, visibility: Visibility, surface: TexelLanes, weighting: Weighting
) -> np.ndarray | None:
    """Return (S,) weighted sums of rounding variances; None if photographs are floats."""
    if views.rounding is None:
        return None
    first, slope = views.rounding
    knee, eta = dr.opaque(mi.Float, weighting.kappa), dr.opaque(mi.Float, weighting.edges)

    def consume(seen: ViewSample, slot: Any, total: Any) -> tuple[Any]:
        view = dr.gather(mi.UInt32, visibility.order, slot)
        steps = (dr.gather(mi.Color3f, of_views, view) for of_views in (first, slope))
        of_channels = [variance(*of) for of in zip(seen.radiance, *steps, strict=True)]
        weight = noise_weight(sum(seen.radiance) / 3, knee, seen.contrast, eta)
        added = weight * sum(of_channels) / len(of_channels)
        return (dr.fma(dr.select(seen.seen, mi.Float(1), 0), added, total),)

    (total,) = visibility.over_views(views, surface, consume, (dr.zeros(mi.Float, surface.count),))
    dr.eval(total)
    return np.array(total, np.float64)
