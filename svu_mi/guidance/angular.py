"""Expected entropy (Eq. 13), or error, by the angular method.

If psi_0 were the truth, photographs of a set S of views would show r_i(psi_0), and another psi
would be off by

    d_S(psi_0, psi) = 1/|S| sum_{i in S} w_i (r_i(psi_0) - r_i(psi))^2.

A candidate v adds one square to the sum, however many views there are:

    d_{S+v} = (|S| d_S + w_v (r_v(psi_0) - r_v(psi))^2) / (|S| + 1).

The weights are the estimator's: 1, or less where r_i(psi_0) is large if the noise grows with
radiance. Expected errors, which follow what recovery makes of photographs, also count grazing
samples less, by the cos^2 theta of Eq. 12: they are stretched over few pixels, and models are
worst there.

No photograph takes part: r = (1 - m) (c e + d) + m (c p + q), and e, p, q, d of every roughness
level are what ``Responses`` hold, in units of sqrt(2) sigma.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.guidance.forecast import Forecast, numbers
from svu_mi.guidance.measures import FAR, Cell, Measure
from svu_mi.guidance.responses import Respond
from svu_mi.posterior import PrincipledGrid, streaming
from svu_mi.reflection.model import Model
from svu_mi.statistics.sums import noise_weight
from svu_mi.visibility import Observation
from svu_mi.visibility.reach import mirror_free


def columns(levels: int) -> int:
    """Numbers per view and texel: cos theta, then e, p, q, d of every level."""
    return 1 + 4 * levels


def respond(scene: Any, model: Model, sigma: Any) -> Respond:
    """Return what evaluates a view of texels.

    Args:
        scene: what occludes.
        model: the texels and the light, in grey.
        sigma: Float, opaque: standard deviation of radiance.
    """
    surface, scale = model.surface, dr.rsqrt(mi.Float(2)) / sigma

    def evaluate(seen: Observation) -> list[Any]:
        free = mi.Bool(True)
        if model.reads_mirrors:
            free = mirror_free(scene, surface, seen, seen.seen)
        found = model.columns(seen.direction, dr.maximum(seen.cosine, 1e-3), free)
        return [seen.cosine, *(scale * value for (level,) in found for value in level)]

    return evaluate


@dataclass(frozen=True)
class AngularForecast(Forecast):
    """``Forecast`` on a grid of (roughness, metallic, base colour).

    Attributes:
        growth: a sample of r weighs 1 / (1 + (growth r)^2), with r in units of sqrt(2) sigma:
            noise that grows with radiance; 0 if it does not.
        grazing: whether samples also weigh cos^2 theta.
        measure: what is expected, by default the entropy.
    """

    grid: PrincipledGrid
    growth: float
    grazing: bool
    measure: Measure

    @property
    def unseen(self) -> float:
        """What is expected of a texel that no view sees."""
        return self.measure.unseen

    def _evaluate(
        self, views: np.ndarray, candidates: np.ndarray | None, texels: np.ndarray
    ) -> np.ndarray:
        launch = _Launch(self, numbers(texels))
        asked = np.zeros(1, np.int64) if candidates is None else candidates
        count, size = len(asked), len(texels)
        out = dr.zeros(mi.Float, count * size)
        dr.eval(out)
        add = dr.opaque(mi.Float, 0 if candidates is None else 1)
        _entropies(launch, _Order(views), _Order(asked), add, out)
        dr.eval(out)
        return out.numpy().reshape(count, size)


class _Order:
    """Views to go through, one after the other."""

    def __init__(self, views: np.ndarray) -> None:
        self.count = dr.opaque(mi.UInt32, len(views))
        self._views = numbers(views if len(views) else [0])  # nothing can be read from nothing

    def at(self, place: Any) -> Any:
        return dr.gather(mi.UInt32, self._views, place)


class _Launch:
    """The texels of one launch, and the cells of their grid."""

    def __init__(self, forecast: AngularForecast, lane: Any) -> None:
        self._responses, self._lane = forecast.responses.at(lane), lane
        self._hypotheses, self._prior = forecast.hypotheses, forecast.prior
        levels, columns, _ = forecast.grid.shape
        axes = forecast.grid.axes
        self.rows, self.measure = levels * columns, forecast.measure
        self._roughness, self._metallic = axes["roughness"], axes["metallic"]
        self.nodes = [mi.Float(node) for node in streaming.cells(axes["base_color"])]
        self._columns = dr.opaque(mi.UInt32, columns)
        self._growth = dr.opaque(mi.Float, forecast.growth)
        self._grazing = dr.opaque(mi.Float, float(forecast.grazing))
        self.size = dr.opaque(mi.UInt32, dr.width(lane))
        self.place = dr.arange(mi.UInt32, dr.width(lane))
        self.hypotheses = dr.gather(mi.UInt32, self._hypotheses.counts, lane)

    def sees(self, view: Any) -> Any:
        """cos theta of a view, 0 where it does not see the texel."""
        return self._responses.read(view, 0)

    def truth(self, number: Any) -> tuple[Any, Cell, Any, Any]:
        """Roughness level, cell, probability and -log prior of a hypothesis."""
        place, weight = self._hypotheses.at(number, self._lane)
        row = place // len(self.nodes)
        level, m = self._row(row)
        c = self.nodes[0]
        for index, node in enumerate(self.nodes[1:], 1):
            c = dr.select(place - row * len(self.nodes) == index, node, c)
        prior = mi.Float(0) if self._prior is None else dr.gather(mi.Float, self._prior, place)
        return level, (self._level(level), m, c), weight, prior

    def predicted(self, view: Any, truth: tuple[Any, Cell, Any, Any]) -> Any:
        """r(psi_0) in a view."""
        level, (_, m, c), *_ = truth
        e, p, q, d = self._column(view, level)
        return dr.lerp(dr.fma(c, e, d), dr.fma(c, p, q), m)

    def squares(self, view: Any, row: Any, predicted: Any) -> list[Any]:
        """w (r(psi_0) - r(psi))^2 in a view, for all cells psi of a row."""
        weight = dr.lerp(mi.Float(1), dr.square(self.sees(view)), self._grazing)
        weight *= noise_weight(self._growth * predicted, 1.0)
        level, m = self._row(row)
        e, p, q, d = self._column(view, level)
        # Radiance is linear in c.
        rest, slope = predicted - dr.lerp(d, q, m), dr.lerp(e, p, m)
        return [weight * dr.square(dr.fma(-c, slope, rest)) for c in self.nodes]

    def add(
        self, sums: list[Any], row: Any, distances: list[Any], share: Any, prior: Any
    ) -> list[Any]:
        """Add the cells of a row to the measure's sums; energies are relative to the truth's."""
        level, m = self._row(row)
        energies = []
        for j, distance in enumerate(distances):
            x = share * distance
            if self._prior is not None:
                x += dr.gather(mi.Float, self._prior, row * len(self.nodes) + j) - prior
            energies.append(dr.clip(x, -FAR, FAR))
        return self.measure.add(sums, (self._level(level), m), energies, self.nodes)

    def _level(self, level: Any) -> Any:
        return streaming.node(mi.Float, self._roughness, level)

    def _row(self, row: Any) -> tuple[Any, Any]:
        level = row // self._columns
        return level, streaming.node(mi.Float, self._metallic, row - level * self._columns)

    def _column(self, view: Any, level: Any) -> list[Any]:
        return [self._responses.read(view, 1 + 4 * level + k) for k in range(4)]


@dr.syntax
def _entropies(launch: _Launch, known: _Order, asked: _Order, add: Any, out: Any) -> Any:
    """Add p(psi_0) times the measure, for every psi_0, to ``out`` (views asked for, texels).

    The squares of the views so far, per cell, are summed up once per hypothesis and kept in
    local memory, where all candidates find them.

    Args:
        launch: texels and cells.
        known: the views so far.
        asked: the candidates.
        add: 1 to add the candidate; 0 for the views so far alone, whatever is asked.
        out: Float, zeros.
    """
    so_far = [dr.alloc_local(mi.Float, launch.rows) for _ in launch.nodes]
    # A literal: Dr.Jit 1.5 leaves the size of local memory out of what tells kernels apart.
    rows = mi.UInt32(launch.rows)
    h = mi.UInt32(0)
    while h < launch.hypotheses:
        truth = launch.truth(h)
        row = mi.UInt32(0)
        while row < rows:
            _set(so_far, row, [mi.Float(0) for _ in so_far])
            row += 1
        n = mi.Float(0)
        i = mi.UInt32(0)
        while i < known.count:
            view = known.at(i)
            if launch.sees(view) > 0:
                r = launch.predicted(view, truth)
                row = mi.UInt32(0)
                while row < rows:
                    _set(so_far, row, _sums(so_far, row, launch.squares(view, row, r)))
                    row += 1
                n += 1
            i += 1
        j = mi.UInt32(0)
        while j < asked.count:
            view = asked.at(j)
            if dr.select(add > 0, launch.sees(view), n) > 0:
                r = launch.predicted(view, truth)
                share = dr.rcp(n + add)
                sums = launch.measure.start()
                row = mi.UInt32(0)
                while row < rows:
                    squares = [add * x for x in launch.squares(view, row, r)]
                    sums = launch.add(sums, row, _sums(so_far, row, squares), share, truth[3])
                    row += 1
                value = launch.measure.value(sums, truth[1])
                _add(out, j * launch.size + launch.place, truth[2] * value)
            j += 1
        h += 1
    return out


def _set(memory: list[Any], row: Any, values: list[Any]) -> None:
    for slot, value in zip(memory, values, strict=True):
        slot[row] = value


def _sums(memory: list[Any], row: Any, squares: list[Any]) -> list[Any]:
    return [slot[row] + square for slot, square in zip(memory, squares, strict=True)]


def _add(out: Any, place: Any, value: Any) -> None:
    dr.scatter_add(out, value, place, True, dr.ReduceMode.NoConflicts)
