"""Sufficient statistics for recovery: what all views say, in ten sums per roughness level.

At one roughness, Mitsuba's ``principled`` reflects (brdf/, angular/model.py)

    r = (1 - m) (c e + d) + m (c p + q)

with base colour c, metallic m, diffuse shading e, what a dielectric reflects d, and the two
parts p, q of a metal's lobe. With the errors d - b and q - b that black materials of either
kind leave of a photograph b,

    r - b = c ((1 - m) e + m p) + (1 - m) (d - b) + m (q - b),

so the mean squared error of every (c, m) follows from the products of four columns,
(e, p, d - b, q - b), summed over the views. After this pass no photograph is needed any more.

The sums are kept in *square-root form*, the triangular factor U that a QR factorisation of the
columns would give: the error |U (c (1 - m), c m, 1 - m, m)|^2 is then never negative, neither by
rounding nor where factors of two levels are interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.angular.statistics import TINY, inverse_root
from svu_mi.frequency.arrays import scatter_strided
from svu_mi.interop import owned
from svu_mi.radiance import Surface, Survey, Views
from svu_mi.radiance.hemisphere import mirror_free
from svu_mi.radiance.observe import Observation
from svu_mi.recovery.sh.gradient import Values
from svu_mi.recovery.sh.model import Model

COLUMNS = 4
PAIRS = tuple((i, j) for i in range(COLUMNS) for j in range(i, COLUMNS))
BLOCK = 16
SMALLEST = 0.05  # error, in units of the knee, from which a sample counts no more than others


@dataclass(frozen=True)
class ErrorFactors:
    """The factors U of S seen texels, at every roughness level: what remains of their views.

    Attributes:
        values: (ceil(S / 16) * R * C * 10 * 16,) Float, in radiance: for every block of 16
            texels, level, channel and entry of U (``PAIRS``: row, column), one value per texel.
            A packet of lanes finds all it reads in a few pages; by rows of S values it would
            be in a hundred, which takes five times as long.
        roughness: (R,) float64 of the levels, uniform on [0, 1].
        texel: (S,) UInt32, which of all texels each is.
        coverage: (S,) number of views that see each.
        channels: C.
    """

    values: Any
    roughness: np.ndarray
    texel: Any
    coverage: np.ndarray
    channels: int

    @property
    def count(self) -> int:
        """Number of texels S."""
        return int(dr.width(self.texel))

    @property
    def levels(self) -> int:
        """Number of roughness levels R."""
        return len(self.roughness)

    @property
    def rows(self) -> int:
        """Number of values per texel, R * C * 10."""
        return self.levels * self.channels * len(PAIRS)

    def table(self) -> np.ndarray:
        """Return ``values`` as (R * C * 10, S) float32."""
        blocks = self.values.numpy().reshape(-1, self.rows, BLOCK)
        return np.moveaxis(blocks, 1, 0).reshape(self.rows, -1)[:, : self.count]

    def some(self, chosen: np.ndarray) -> ErrorFactors:
        """Return the factors of some texels, by their numbers among S."""
        return replace(
            self,
            values=in_blocks(self.table()[:, chosen]),
            texel=dr.gather(mi.UInt32, self.texel, owned(mi.UInt32, chosen)),
            coverage=self.coverage[chosen],
        )

    def products(self) -> np.ndarray:
        """Return the columns' products U^T U, which add up over texels: (R * C * 10, S) float32."""
        factors = self.table().reshape(-1, len(PAIRS), self.count)
        U = dict(zip(PAIRS, np.moveaxis(factors, 1, 0), strict=True))
        found = [sum(U[k, i] * U[k, j] for k in range(i + 1)) for i, j in PAIRS]
        return np.stack(found, axis=1).reshape(-1, self.count)


def gather(
    views: Views, surface: Surface, found: Survey, model: Model, knee: Any,
    current: Values | None = None,
) -> ErrorFactors:  # fmt: skip
    """Collect the statistics of texels: one kernel, one pass over the views.

    Args:
        views: the packed capture, in three channels.
        surface: the seen texels; ``model`` is of the same.
        found: who sees whom.
        model: the reflection model.
        knee: Float, opaque: radiance around which samples begin to count less, as
            1 / (1 + (b / knee)^2): the errors of model and photographs grow with radiance.
        current: parameters of the texels. Samples then also count less the more these are off,
            by 1 / |r - b|: squares become absolute errors [Holland and Welsch 1977].
    """
    levels, channels = len(model.roughness), views.channels

    def consume(seen: Observation, _: Any, *sums: Any) -> Any:
        free = mirror_free(views.scene, surface, seen, found.asked(seen.seen))

        def add(weight: Any, *state: Any) -> tuple[Any, ...]:
            lobes = model.columns(surface, seen.direction, dr.maximum(seen.cosine, 1e-3), free)
            grey = sum(seen.radiance) / channels
            w = dr.select(seen.seen, dr.rcp(1 + dr.square(grey / knee)), 0)
            if current is not None:
                off = sum(_errors(lobes, seen.radiance, current)) / channels
                w *= knee / dr.maximum(off, SMALLEST * knee)
            w = mi.Float64(w)
            added = []
            for k in range(levels):
                for b, (e, p, q, d) in zip(seen.radiance, lobes[k], strict=True):
                    u = [mi.Float64(column) for column in (e, p, d - b, q - b)]
                    added += [u[i] * u[j] for i, j in PAIRS]
            return weight + w, *(
                dr.fma(w, new, old) for old, new in zip(state, added, strict=True)
            )

        return dr.if_stmt(
            args=sums, cond=found.asked(seen.seen),
            true_fn=add, false_fn=lambda *state: state,
        )  # fmt: skip

    size = 1 + levels * channels * len(PAIRS)
    zeros = tuple(dr.zeros(mi.Float64, surface.count) for _ in range(size))
    weight, *sums = found.over_views(views, surface, consume, zeros)
    inverse = dr.rcp(dr.maximum(weight, 1e-30))
    columns = []
    for first in range(0, len(sums), len(PAIRS)):
        columns += factor([value * inverse for value in sums[first : first + len(PAIRS)]])
    coverage = dr.gather(mi.UInt32, found.coverage, surface.index)
    return ErrorFactors(
        values=_scattered(columns, surface), roughness=model.roughness,
        texel=surface.index, coverage=np.array(coverage), channels=channels,
    )  # fmt: skip


def _errors(lobes: list[list[Any]], radiance: Any, current: Values) -> list[Any]:
    """|r - b| of every channel; r between two levels is interpolated."""
    place, m = current.roughness * (len(lobes) - 1), current.metallic
    result = []
    for channel, (b, c) in enumerate(zip(radiance, current[:3], strict=True)):
        r = mi.Float(0)
        for k, level in enumerate(lobes):
            e, p, q, d = level[channel]
            share = dr.maximum(1 - dr.abs(place - k), 0)
            r = dr.fma(share, dr.lerp(dr.fma(c, e, d), dr.fma(c, p, q), m), r)
        result.append(dr.abs(r - b))
    return result


def _scattered(columns: list[Any], surface: Surface) -> Any:
    """Write the values of all lanes into blocks, in the kernel that computes them."""
    factors = dr.zeros(mi.Float, -(-surface.count // BLOCK) * len(columns) * BLOCK)
    dr.eval(factors)
    start = _start(surface.lane, len(columns))
    factors = scatter_strided(factors, columns, start, mi.UInt32(BLOCK))
    dr.eval(factors)
    return factors


def _start(lane: Any, rows: Any) -> Any:
    """Return where the first of a texel's values is; the next is ``BLOCK`` further on."""
    return (lane // BLOCK) * (rows * BLOCK) + lane % BLOCK


def in_blocks(table: np.ndarray) -> Any:
    """Lay values (R * C * 10, S) out as ``ErrorFactors.values`` are: the inverse of ``table``."""
    padded = np.pad(table, ((0, 0), (0, -table.shape[1] % BLOCK)))
    return owned(mi.Float, np.moveaxis(padded.reshape(len(table), -1, BLOCK), 1, 0).ravel())


class Reader:
    """Reads values of texels of a launch out of ``ErrorFactors.values``."""

    def __init__(self, statistics: ErrorFactors) -> None:
        self._values = statistics.values
        lane, rows = dr.arange(mi.UInt32, statistics.count), dr.opaque(mi.UInt32, statistics.rows)
        self._start = _start(lane, rows)

    def read(self, row: Any) -> Any:
        """Return a row's value of every texel: Float (S,)."""
        return dr.gather(mi.Float, self._values, self._start + row * BLOCK)


def factor(sums: list[Any]) -> list[Any]:
    """Return the entries of U, row by row, from those of U^T U; dependent columns give zeros."""
    products = dict(zip(PAIRS, sums, strict=True))
    U: dict[tuple[int, int], Any] = {}
    for i in range(COLUMNS):
        pivot = products[i, i] - sum(dr.square(U[k, i]) for k in range(i))
        root = inverse_root(pivot, TINY * products[i, i])
        for j in range(i, COLUMNS):
            rest = products[i, j] - sum(U[k, i] * U[k, j] for k in range(i))
            U[i, j] = rest * root
    return [mi.Float(U[pair]) for pair in PAIRS]
