"""The sums in square-root form, which single precision is enough for.

The triangular factor U of a texel's sums, as a QR factorisation of its samples would give it:
the weighted mean squared error of parameters that mix the columns by x (``Mixture``) is

    |U x|^2,

never negative, neither by rounding nor where factors of two levels are interpolated, and exact
to rounding of *radiance*, where one taken from the sums would be to rounding of its square. The
square of the last entry is what no parameters explain; what no roughness of a channel explains
either is kept apart, in double precision until then: it would drown differences.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.reflection.principled import COLUMNS
from svu_mi.statistics.blocks import BLOCK, Reader, rows_of, scattered, size, taken

PAIRS = tuple((i, j) for i in range(COLUMNS) for j in range(i, COLUMNS))
FLOOR = len(PAIRS) - 1  # the entry that is kept as a square
TINY = 1e-13  # part of its diagonal below which a pivot is nothing but rounding


@dataclass(frozen=True)
class Factors:
    """The factors U of S texels at R levels of roughness and in C channels.

    Attributes:
        values: (ceil(S / 16) * (R * C * P + C + 1) * 16,) Float in blocks (see ``blocks``): for
            level, channel and each of P pairs of columns an entry of U, in radiance; the last of
            them ``floor``, squared radiance, its square less the ``least`` of its channel. Then
            least of every channel, and the sum of the weights that U was divided by.
        views: (S,) UInt32, how many views see each texel.
        texel: (S,) UInt32, which of all texels each is.
        roughness: (R,) float64 of the levels.
        channels: C.
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
    def rows(self) -> int:
        """Number of values per texel, R C P + C + 1."""
        return self.entries + self.channels + 1

    @property
    def entries(self) -> int:
        """Number of entries of U per texel, R C P."""
        return self.levels * self.channels * len(PAIRS)

    def at(self, lane: Any | None = None) -> FactorReader:
        """Return what reads the factors of texels, by default of all in order."""
        return FactorReader(self, lane)

    def some(self, chosen: np.ndarray) -> Factors:
        """Return the factors of some texels, by their numbers among S."""
        lanes = owned(mi.UInt32, np.asarray(chosen).astype(np.uint32))
        return replace(
            self,
            values=taken(self.values, self.rows, lanes),
            views=dr.gather(mi.UInt32, self.views, lanes),
            texel=dr.gather(mi.UInt32, self.texel, lanes),
        )

    @staticmethod
    def joined(parts: Iterable[Factors], count: int) -> Factors:
        """Return the factors of texels that come part by part, of which only one is held beside
        the result.

        Args:
            parts: whole blocks of texels each, but for the last (see ``blocks``).
            count: S, texels in all.
        """
        values, views, texel, done, part = mi.Float(), [], [], 0, None
        for part in parts:
            assert done % BLOCK == 0
            if not done:
                values = dr.empty(mi.Float, size(part.rows, count))
            place = dr.arange(mi.UInt32, dr.width(part.values))
            place += dr.opaque(mi.UInt32, size(part.rows, done))
            dr.scatter(values, part.values, place, mode=dr.ReduceMode.NoConflicts)
            dr.eval(values)
            views.append(part.views)
            texel.append(part.texel)
            done += part.count
        assert part is not None and done == count
        return replace(part, values=values, views=dr.concat(views), texel=dr.concat(texel))

    def table(self) -> np.ndarray:
        """Return U as (R, C, P, S) float32, with its last entry itself."""
        rows = self._table()
        least = rows[self.entries : -1]
        shape = (self.levels, self.channels, len(PAIRS), self.count)
        entries = rows[: self.entries].reshape(shape).copy()
        entries[:, :, FLOOR] = np.sqrt(entries[:, :, FLOOR] + least)
        return entries

    def lanes(self, total: int) -> np.ndarray:
        """Return which of the S texels each of all T is, (T,) int64; 0 for others."""
        lanes, texel = np.zeros(total, np.int64), self.texel.numpy()
        lanes[texel] = np.arange(len(texel))
        return lanes

    def unexplained(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean squared error that nothing explains, the sum over channels, and the sum
        of the weights: (S,) float64 both."""
        reader = self.at()
        least = sum(mi.Float64(reader.least(channel)) for channel in range(self.channels))
        weight = reader.weight()
        dr.eval(least, weight)
        return np.array(least), np.array(weight, np.float64)

    def _table(self) -> np.ndarray:
        return rows_of(self.values, self.rows, self.count)


class FactorReader:
    """Reads factors of the texels of a launch; levels and channels may differ by lane."""

    def __init__(self, factors: Factors, lane: Any | None) -> None:
        self._read = Reader(factors.values, factors.rows, factors.count, lane).read
        self._channels = factors.channels
        self._least = dr.opaque(mi.UInt32, factors.entries)

    def entries(self, level: Any, channel: int) -> list[Any]:
        """Return the entries of U but the last, and ``floor``: Floats."""
        row = (level * self._channels + channel) * len(PAIRS)
        return [self._read(row + entry) for entry in range(len(PAIRS))]

    def least(self, channel: int) -> Any:
        """Return the squared error that nothing explains: Float."""
        return self._read(self._least + channel)

    def weight(self) -> Any:
        """Return the sum of the weights: Float."""
        return self._read(self._least + self._channels)

    def factor(self, level: Any, channel: int) -> list[Any]:
        """Return all entries of U, in the order of ``PAIRS``: Floats."""
        *entries, floor = self.entries(level, channel)
        return [*entries, dr.sqrt(floor + self.least(channel))]


def combined(U: list[Any], x: Sequence[Any]) -> list[Any]:
    """Return the components of U x.

    Args:
        U: entries in the order of ``PAIRS``.
        x: how often each column counts.
    """
    entries, found = dict(zip(PAIRS, U, strict=True)), []
    for row in range(COLUMNS):
        total: Any = 0.0
        for column in reversed(range(row, COLUMNS)):
            total = dr.fma(entries[row, column], x[column], total)
        found.append(total)
    return found


def factorize(
    sums: Any, views: Any, texel: Any, roughness: np.ndarray, channels: int
) -> Factors:
    """Factorise sums, divided by their weight; arguments as ``Statistics`` has them."""
    count, levels = int(dr.width(texel)), len(roughness)
    last = levels * channels * len(PAIRS)
    reader = Reader(sums, last + 1, count)
    weight = reader.read(dr.opaque(mi.UInt32, last))
    scale = dr.select(weight > 0, dr.rcp(dr.select(weight > 0, weight, 1)), 0)
    columns, least = [], [mi.Float64(dr.inf)] * channels
    for level in range(levels):
        for channel in range(channels):
            row = (level * channels + channel) * len(PAIRS)
            U = _cholesky([scale * reader.read(row + entry) for entry in range(len(PAIRS))])
            least[channel] = dr.minimum(least[channel], U[-1])
            columns += U
    # Channels take turns, level by level; the last entry of each is the floor.
    for place in range(FLOOR, len(columns), len(PAIRS)):
        columns[place] = columns[place] - least[place // len(PAIRS) % channels]
    values = scattered(mi.Float, [*columns, *least, weight], count)
    return Factors(values, views, texel, roughness, channels)


def _cholesky(sums: list[Any]) -> list[Any]:
    """Return the entries of U row by row, the last squared, from those of U^T U; dependent
    columns give zeros."""
    left = dict(zip(PAIRS, sums, strict=True))  # what the rows above leave of the products
    U: dict[tuple[int, int], Any] = {}
    for i in range(COLUMNS - 1):
        pivot = left[i, i]
        for j in range(i + 1, COLUMNS):
            # Cauchy and Schwarz, which rounding may break where columns nearly depend; the pivot
            # grows by no more than that rounding, however little is left of the other column.
            other = dr.maximum(left[j, j], dr.abs(left[i, j]))
            pivot = dr.maximum(pivot, dr.square(left[i, j]) / dr.select(other > 0, other, 1))
        good = pivot > TINY * sums[PAIRS.index((i, i))]
        root = dr.select(good, dr.rsqrt(dr.select(good, pivot, 1)), 0)
        U[i, i] = pivot * root
        for j in range(i + 1, COLUMNS):
            U[i, j] = left[i, j] * root
            for k in range(i + 1, j + 1):
                left[k, j] = left[k, j] - U[i, k] * U[i, j]
    U[COLUMNS - 1, COLUMNS - 1] = dr.maximum(left[COLUMNS - 1, COLUMNS - 1], 0)
    return [U[pair] for pair in PAIRS]
