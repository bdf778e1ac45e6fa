"""Expected entropy (Eq. 13) or variance with the residuals of the angular method.

If psi_0 is true, the photographs from a set S of views show the radiance r_i(psi_0). Other
parameters psi then have the energy

    d_S(psi_0, psi) = sum_{i in S} w_i |r_i(psi_0) - r_i(psi)|^2 / (2 s^2 tau),

a sum over views and channels with the weights w_i of the estimate. It is divided by the number of
views if the estimate averages over views. A candidate adds one term. Three sums per row and channel
determine the energy of all base colours (``objectives.py``). ``Responses`` contain the parts
e, p, q and d of reflection (``reflection/principled.py``) by level and channel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.local_memory import load, store, zeros
from svu_mi.geometry.sample_view import ViewSample
from svu_mi.guidance.forecast import Forecast, numbers
from svu_mi.guidance.objectives import FAR, ChannelFields, Colors
from svu_mi.guidance.predicted_responses import ResponseFunction
from svu_mi.light.light_visibility import trace_mirror
from svu_mi.posterior import row_entropy
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.reflection.mix_columns import dot
from svu_mi.reflection.principled import columns as columns_of
from svu_mi.reflection.principled import mixture
from svu_mi.reflection.reflection_model import ReflectionModel
from svu_mi.statistics.gather_statistics import GRAZING
from svu_mi.statistics.statistics import noise_weight

HOPELESS = 16.0  # skip rows whose energy exceeds the truth's by this many nats


def columns(levels: int, channels: int) -> int:
    """Return the number of columns: cos theta, then parts e, p, q, d by level and channel."""
    return 1 + 4 * levels * channels


def respond(scene: Any, model: ReflectionModel) -> ResponseFunction:
    """Return a function that evaluates the reflectance columns of a view."""
    surface = model.surface

    def evaluate(seen: ViewSample, view: Any) -> list[Any]:
        free = mi.Bool(True)
        if model.reads_mirrors:
            free = trace_mirror(scene, surface, seen, seen.seen)
        cosine = dr.maximum(seen.cosine, GRAZING)
        levels = model.columns(seen.direction, cosine, free, view)
        return [value for level in levels for lobe in level for value in lobe]

    return evaluate


@dataclass(frozen=True)
class AngularForecast(Forecast):
    """``Forecast`` on a ``PrincipledGrid``; its R M rows fix all parameters but base colour.

    Attributes:
        truths: (T * R * M * C,) Float, base colour to assume if a row is the truth.
        precision: (T,) Float, 1 / (2 s^2 tau).
        kappa: Radiance at which weights begin to fall (``noise_weight``).
    """

    grid: PrincipledGrid
    truths: Any
    channels: int
    precision: Any
    kappa: float
    averaged: bool
    colors: Colors

    def _evaluate(
        self, views: np.ndarray, candidates: np.ndarray | None, texels: np.ndarray
    ) -> np.ndarray:
        if candidates is None:
            return self._expect(
                texels, 1, partial(_view_by_view, views=_ViewList(views), known=len(views))
            )
        each = partial(
            _with_each_candidate, known=_ViewList(views), candidates=_ViewList(candidates)
        )
        return self._expect(texels, len(candidates), each)

    def cumulative(self, views: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        # One kernel accumulates the views; the base class would repeat them per candidate.
        order = _ViewList(np.concatenate([views, candidates]))
        in_turn = partial(_view_by_view, views=order, known=len(views))
        steps = self._expect(np.arange(self.count), 1 + len(candidates), in_turn)
        steps[0, ~self.seen[views].any(axis=0)] = self.measure.unseen
        for before, after, seen in zip(steps[:-1], steps[1:], self.seen[candidates], strict=True):
            after[~seen] = before[~seen]
        return steps

    def _expect(self, texels: np.ndarray, number: int, kernel: Callable[..., Any]) -> np.ndarray:
        """Return the expected measures that ``kernel`` computes, (number, L); 0 if unseen."""
        place, hypothesis = self.hypotheses.of_texels(texels)
        out = dr.zeros(mi.Float, number * len(place))
        dr.eval(out)
        out = kernel(_HypothesisLanes(self, numbers(texels[place]), numbers(hypothesis)), out=out)
        dr.eval(out)
        each = out.numpy().reshape(number, len(place))
        return np.add.reduceat(each, np.flatnonzero(hypothesis == 0), axis=1)


class _ViewList:
    """View indices in the order in which a kernel visits them."""

    def __init__(self, views: np.ndarray) -> None:
        self.count = dr.opaque(mi.UInt32, len(views))
        self._views = numbers(views if len(views) else [0])  # Dr.Jit cannot gather from size 0

    def at(self, place: Any) -> Any:
        return dr.gather(mi.UInt32, self._views, place)


Truth = tuple[Any, list[Any], Any, Any]
"""Row, base colour of every channel, probability and -log prior of a hypothesis."""
Lobes = list[tuple[Any, ...]]
"""Columns of every lobe (``reflection/principled.py``)."""
PredictedSample = tuple[Any, list[Any]]
"""Weight of the squared error of a photograph (over 2 s^2 tau), radiance of every channel."""


class _HypothesisLanes:
    """Hypotheses of texels, one per lane, compared with all rows of the grid."""

    def __init__(self, forecast: AngularForecast, lane: Any, number: Any) -> None:
        self._forecast, self._lane = forecast, lane
        self._responses, self.measure = forecast.responses.at(lane), forecast.measure
        self.levels, *mixed, _ = forecast.grid.shape
        self._roughness, self._mixed = forecast.grid.roughness_nodes, forecast.grid.mixed_nodes
        self.mixtures = prod(mixed)
        self.rows = self.levels * self.mixtures
        self._truths, self.channels = forecast.truths, forecast.channels
        self._lobes = (self._responses.columns - 1) // (4 * self.levels)  # 1 if light is grey
        self._kappa = dr.opaque(mi.Float, forecast.kappa)
        self._averaged = dr.opaque(mi.Bool, forecast.averaged)
        self._precision = dr.gather(mi.Float, forecast.precision, lane)
        self._stride = dr.opaque(mi.UInt32, self.rows * self.channels)
        self._size = dr.opaque(mi.UInt32, dr.width(lane))
        self._own = dr.arange(mi.UInt32, dr.width(lane))
        self.truth = self._truth(number)

    def sees(self, view: Any) -> Any:
        """Return cos theta of a view; 0 if the view does not see the texel."""
        return self._responses.sees(view)

    def _truth(self, number: Any) -> Truth:
        row, weight = self._forecast.hypotheses.at(number, self._lane)
        place = self._lane * self._stride + row * self.channels
        colors = [dr.gather(mi.Float, self._truths, place + k) for k in range(self.channels)]
        return row, colors, weight, self._prior(row)

    def predicted(self, view: Any) -> PredictedSample:
        """Predict weight and radiance of a view if the hypothesis is true."""
        row, colors, *_ = self.truth
        level = row // self.mixtures
        lines = self._lines(self.lobes(view, level), row - level * self.mixtures)
        r = [dr.fma(c, slope, base) for c, (slope, base) in zip(colors, lines, strict=True)]
        return self._precision * noise_weight(sum(r) / len(r), self._kappa), r

    def lobes(self, view: Any, level: Any) -> Lobes:
        """Return the columns of every lobe in a view, shared by all rows of a level."""
        return [
            columns_of(*self._responses.read(view, level * self._lobes + lobe))
            for lobe in range(self._lobes)
        ]

    def products(
        self, sums: list[Any], lobes: Lobes, mixed: Any, shown: PredictedSample | None
    ) -> list[Any]:  # fmt: skip
        """Return the sums of a row (A, B, C of ``objectives``, per channel) with a view added.

        ``shown`` contains weight and radiance of the view; with None, ``sums`` are returned.
        """
        if shown is None:
            return sums
        weight, radiance = shown
        products: list[Any] = []
        for (slope, base), c, r in zip(
            self._lines(lobes, mixed), self.truth[1], radiance, strict=True
        ):
            rest = r - dr.fma(c, slope, base)
            scaled = weight * slope
            products += [scaled * slope, scaled * rest, weight * rest * rest]
        return [old + new for old, new in zip(sums, products, strict=True)]

    def empty(self) -> list[Any]:
        """Allocate local memory for the sums of every row, all 0."""
        return zeros(mi.Float, 3 * self.channels, self.rows)

    @dr.syntax
    def accumulate(self, sums: list[Any], view: Any) -> Any:
        """Add a view to the sums of every row; return 1 if the view sees the texel, else 0."""
        sees = mi.Float(0)
        if self.sees(view) > 0:
            sees = mi.Float(1)
            shown = self.predicted(view)
            level = mi.UInt32(0)
            # Literal bounds: Dr.Jit 1.5 omits the size of local memory from the kernel's hash.
            while level < mi.UInt32(self.levels):
                lobes = self.lobes(view, level)
                mixed = mi.UInt32(0)
                while mixed < mi.UInt32(self.mixtures):
                    row = level * self.mixtures + mixed
                    store(sums, row, self.products(load(sums, row), lobes, mixed, shown))
                    mixed += 1
                level += 1
        return sees

    @dr.syntax
    def evaluate(self, sums: list[Any], views: Any, candidate: Any | None) -> Any:
        """Return the measure, Float, for ``sums`` and one more view ``candidate`` (or None)."""
        share = dr.select(self._averaged, dr.rcp(views), 1)
        shown = None if candidate is None else self.predicted(candidate)
        total = self.measure.start()
        level = mi.UInt32(0)
        while level < mi.UInt32(self.levels):
            lobes = [] if candidate is None else self.lobes(candidate, level)
            mixed = mi.UInt32(0)
            while mixed < mi.UInt32(self.mixtures):
                row = level * self.mixtures + mixed
                here = load(sums, row)
                here = [share * x for x in self.products(here, lobes, mixed, shown)]
                energy, channels = self.row(here, row)
                if energy < HOPELESS:
                    total = self.add(total, row, energy, channels)
                mixed += 1
            level += 1
        return self.measure.value(total)

    def row(self, sums: list[Any], row: Any) -> tuple[Any, Any]:
        """Return lowest energy of a row minus the truth's energy, and likelihood per channel."""
        _, colors, _, usual = self.truth
        bound, channels = self._forecast.colors.channels(sums, colors)
        return bound + self._prior(row) - usual, channels

    def add(
        self, sums: list[Any], row: Any, energy: Any, channels: list[ChannelFields]
    ) -> list[Any]:
        """Add a row to the sums of the measure."""
        level = row // self.mixtures
        mixed = row_entropy.row_values(mi.Float, self._mixed, row - level * self.mixtures)
        shared = (row_entropy.axis_value(mi.Float, self._roughness, level), *mixed)
        energy = dr.maximum(energy, -FAR)
        return self.measure.add(sums, self._forecast.colors.row(energy, channels, row), shared)

    def write(self, out: Any, place: Any, measure: Any) -> None:
        """Write p(psi_0) times the measure to row ``place`` of ``out``."""
        value = self.truth[2] * measure
        dr.scatter(out, value, place * self._size + self._own, mode=dr.ReduceMode.NoConflicts)

    def _prior(self, row: Any) -> Any:
        return dr.gather(mi.Float, self._forecast.prior, row)

    def _lines(self, lobes: Lobes, mixed: Any) -> list[tuple[Any, Any]]:
        """Return slope and intercept of radiance over base colour, per channel of a row."""
        how = mixture(*row_entropy.row_values(mi.Float, self._mixed, mixed))
        lines = [(dot(how.slope, x), dot(how.offset, x)) for x in lobes]
        return lines if len(lines) == self.channels else lines * self.channels


@dr.syntax
def _with_each_candidate(
    lanes: _HypothesisLanes, known: _ViewList, candidates: _ViewList, out: Any
) -> Any:
    """Write p(psi_0) times the measure with each candidate added alone: (candidates, lanes)."""
    sums = lanes.empty()
    n = mi.Float(0)
    i = mi.UInt32(0)
    while i < known.count:
        n += lanes.accumulate(sums, known.at(i))
        i += 1
    j = mi.UInt32(0)
    while j < candidates.count:
        view = candidates.at(j)
        if lanes.sees(view) > 0:
            lanes.write(out, j, lanes.evaluate(sums, n + 1, view))
        j += 1
    return out


@dr.syntax
def _view_by_view(lanes: _HypothesisLanes, views: _ViewList, known: int, out: Any) -> Any:
    """Write p(psi_0) times the measure given ``known`` views, then with each later view added."""
    sums, last = lanes.empty(), dr.opaque(mi.UInt32, known - 1)
    n = mi.Float(0)
    i = mi.UInt32(0)
    while i < views.count:
        view = views.at(i)
        sees = lanes.accumulate(sums, view)
        n += sees
        if (n > 0) & ((i == last) | ((i > last) & (sees > 0))):
            lanes.write(out, i - last, lanes.evaluate(sums, n, None))
        i += 1
    return out
