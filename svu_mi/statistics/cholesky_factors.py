"""Triangular factors of the statistics, accurate enough in single precision.

U is the triangular factor (QR) of a texel's weighted samples, divided by the sum of weights. For
parameters that mix the columns by x (``Mixture``), the weighted mean squared error is

    |U x|^2.

It is never negative, also between interpolated levels. The square of U's last entry is the residual
of the best x; its minimum over roughness is stored separately (``residual_floor``).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.core.local_memory import QUAD, padded_to_quads, quad_count, scatter_strided
from svu_mi.reflection.principled import COLUMNS

PAIRS = tuple((i, j) for i in range(COLUMNS) for j in range(i, COLUMNS))
FLOOR = len(PAIRS) - 1  # index of the last entry, which is stored as a square
TINY = 1e-13  # pivots below this fraction of the diagonal are rounding errors
SUBNORMAL = 1e-300  # pivots below have no reciprocal square root


def pair_weights(x: Sequence[np.ndarray]) -> np.ndarray:
    """Return weights (P, ...) of the sums of pairs of columns in the squared error of ``x``."""
    return np.stack([(2 - (i == j)) * x[i] * x[j] for i, j in PAIRS])


@dataclass(frozen=True)
class Factors:
    """Factors U of S texels at R roughness levels in C channels.

    Values of a texel are contiguous and padded to groups of four, which kernels read at once.

    Attributes:
        values: (S * ``stride``,) Float. Per texel: for each level and channel, the P entries of U,
            in radiance, the last one squared and minus the residual floor. Then the residual
            floor of each channel and the sum of weights.
        views: (S,) UInt32, number of views of each texel.
        texel: (S,) UInt32, texel number in [0, T).
        roughness: (R,) float64, roughness of the levels.
    """

    values: Any
    views: Any
    texel: Any
    roughness: np.ndarray
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
    def stride(self) -> int:
        """Number of values per texel."""
        return stride(self.levels, self.channels)

    def reader(self, lane: Any | None = None) -> "FactorReader":
        """Return a reader of the factors of texels ``lane`` (UInt32, default: all)."""
        return FactorReader(self, dr.arange(mi.UInt32, self.count) if lane is None else lane)

    def subset(self, chosen: np.ndarray) -> "Factors":
        """Return the factors of the lanes ``chosen``, in [0, S)."""
        lanes = to_drjit(mi.UInt32, np.asarray(chosen).astype(np.uint32))
        values = mi.Float()
        if len(chosen):
            place = dr.arange(mi.UInt32, self.stride * len(chosen))
            of_texel = dr.opaque(mi.UInt32, self.stride)
            lane = place // of_texel
            source = dr.gather(mi.UInt32, lanes, lane) * of_texel + (place - lane * of_texel)
            values = dr.gather(mi.Float, self.values, source)
            dr.eval(values)
        return replace(
            self,
            values=values,
            views=dr.gather(mi.UInt32, self.views, lanes),
            texel=dr.gather(mi.UInt32, self.texel, lanes),
        )

    @staticmethod
    def concatenated(parts: "Iterable[Factors]", count: int) -> "Factors":
        """Concatenate parts with ``count`` texels in total; one part is in memory at a time."""
        values, views, texel, done, part = mi.Float(), [], [], 0, None
        for part in parts:
            if not done:
                values = dr.empty(mi.Float, part.stride * count)
            place = dr.arange(mi.UInt32, dr.width(part.values))
            place += dr.opaque(mi.UInt32, part.stride * done)
            dr.scatter(values, part.values, place, mode=dr.ReduceMode.NoConflicts)
            dr.eval(values)
            views.append(part.views)
            texel.append(part.texel)
            done += part.count
        assert part is not None and done == count
        return replace(part, values=values, views=dr.concat(views), texel=dr.concat(texel))

    def table(self) -> np.ndarray:
        """Return U as (R, C, P, S) float32, with its last entry not squared."""
        rows, number = self.values.numpy().reshape(self.count, self.stride), len(PAIRS)
        width = self.levels * padded_to_quads(self.channels * number)
        of_levels, ends = np.split(rows, [width], axis=1)
        of_levels = of_levels.reshape(self.count, self.levels, -1)[..., : self.channels * number]
        entries = of_levels.reshape(self.count, self.levels, self.channels, number)
        entries = np.transpose(entries, (1, 2, 3, 0)).copy()
        entries[:, :, FLOOR] = np.sqrt(entries[:, :, FLOOR] + ends[:, : self.channels].T)
        return entries

    def lane_of_texel(self, total: int) -> np.ndarray:
        """Return the lane in [0, S) of each of T texels, (T,) int64; 0 if it has none."""
        lanes, texel = np.zeros(total, np.int64), self.texel.numpy()
        lanes[texel] = np.arange(len(texel))
        return lanes

    def residuals(self) -> tuple[np.ndarray, np.ndarray]:
        """Return residual floors, summed over channels, and sums of weights: (S,) float64."""
        reader = self.reader()
        floor = sum(mi.Float64(x) for x in reader.residual_floor)
        weight = mi.Float(reader.weight)
        dr.eval(floor, weight)
        return np.array(floor), np.array(weight, np.float64)


class FactorReader:
    """Reader of the factors of texels; the level can differ between lanes."""

    def __init__(self, factors: Factors, lane: Any) -> None:
        self._values, self._channels = factors.values, factors.channels
        self._first = lane * dr.opaque(mi.UInt32, factors.stride // QUAD)
        self._row = quad_count(factors.channels * len(PAIRS))
        ends = self._first + dr.opaque(mi.UInt32, factors.levels * self._row)
        self._ends = self._read(ends, factors.channels + 1)

    def entries(self, level: Any) -> list[list[Any]]:
        """Return the entries of U of each channel, the last as stored (``Factors.values``)."""
        row = self._read(self._first + level * self._row, self._channels * len(PAIRS))
        return [row[k : k + len(PAIRS)] for k in range(0, len(row), len(PAIRS))]

    def factor(self, level: Any) -> list[list[Any]]:
        """Return the entries of U of each channel, in the order of ``PAIRS``: Floats."""
        floors = self.residual_floor
        return [
            [*entries, dr.sqrt(rest + floor)]
            for (*entries, rest), floor in zip(self.entries(level), floors, strict=True)
        ]

    @property
    def residual_floor(self) -> list[Any]:
        """Least squared error over all roughness levels, a Float per channel."""
        return self._ends[:-1]

    @property
    def weight(self) -> Any:
        """Sum of the weights: Float."""
        return self._ends[-1]

    def _read(self, first: Any, count: int) -> list[Any]:
        """Read ``count`` values, starting at the group of four with index ``first``."""
        fours = [dr.gather(mi.Vector4f, self._values, first + k)
                 for k in range(quad_count(count))]  # fmt: skip
        return [x for four in fours for x in four][:count]


def stride(levels: int, channels: int) -> int:
    """Return the number of values per texel."""
    return levels * padded_to_quads(channels * len(PAIRS)) + padded_to_quads(channels + 1)


def apply_factor(U: list[Any], x: Sequence[Any]) -> list[Any]:
    """Return the components of U x."""
    entries, product = dict(zip(PAIRS, U, strict=True)), []
    for row in range(COLUMNS):
        total: Any = 0.0
        for column in reversed(range(row, COLUMNS)):
            total = dr.fma(entries[row, column], x[column], total)
        product.append(total)
    return product


def squared_length(components: list[Any], floor: Any) -> Any:
    """Return |U x|^2, given the square ``floor`` of the last component."""
    total = floor
    for x in reversed(components):
        total = dr.fma(x, x, total)
    return total


def factorize(
    columns: list[Any], weight: Any, views: Any, texel: Any, roughness: np.ndarray, channels: int
) -> Factors:
    """Factorise sums, divided by the sum of weights, within the kernel that computes them."""
    levels, count = len(roughness), int(dr.width(texel))
    scale = dr.select(weight > 0, dr.rcp(dr.select(weight > 0, weight, 1)), 0)
    floor = [mi.Float64(dr.inf)] * channels
    rows: list[list[list[Any]]] = [[] for _ in range(levels)]
    for level in range(levels):
        for channel in range(channels):
            row = (level * channels + channel) * len(PAIRS)
            U = _cholesky([scale * column for column in columns[row : row + len(PAIRS)]])
            floor[channel] = dr.minimum(floor[channel], U[-1])
            rows[level].append(U)
    written = []
    for of_level in rows:
        written += _padded([x for U, low in zip(of_level, floor, strict=True)
                            for x in (*U[:-1], U[-1] - low)])  # fmt: skip
    written += _padded([*floor, weight])
    values = dr.empty(mi.Float, stride(levels, channels) * count)
    place = dr.arange(mi.UInt32, count) * len(written)
    values = scatter_strided(values, written, place, mi.UInt32(1))
    dr.eval(values, views)
    return Factors(values, views, texel, roughness, channels)


def _padded(values: list[Any]) -> list[Any]:
    """Append zeros until the number of values is a multiple of four."""
    return [*values, *[mi.Float64(0)] * (padded_to_quads(len(values)) - len(values))]


def _cholesky(sums: list[Any]) -> list[Any]:
    """Return U by rows, the last entry squared, from U^T U; dependent columns give zeros."""
    left = dict(zip(PAIRS, sums, strict=True))  # products minus contributions of previous rows
    U: dict[tuple[int, int], Any] = {}
    for i in range(COLUMNS - 1):
        pivot = left[i, i]
        for j in range(i + 1, COLUMNS):
            # Rounding can violate the Cauchy-Schwarz inequality of nearly dependent columns. The
            # pivot is increased by no more than this rounding error.
            other = dr.maximum(left[j, j], dr.abs(left[i, j]))
            pivot = dr.maximum(pivot, dr.square(left[i, j]) / dr.select(other > 0, other, 1))
        good = pivot > dr.maximum(TINY * sums[PAIRS.index((i, i))], SUBNORMAL)
        root = dr.select(good, dr.rsqrt(dr.select(good, pivot, 1)), 0)
        U[i, i] = pivot * root
        for j in range(i + 1, COLUMNS):
            U[i, j] = left[i, j] * root
            for k in range(i + 1, j + 1):
                left[k, j] = left[k, j] - U[i, k] * U[i, j]
    U[COLUMNS - 1, COLUMNS - 1] = dr.maximum(left[COLUMNS - 1, COLUMNS - 1], 0)
    return [U[pair] for pair in PAIRS]
