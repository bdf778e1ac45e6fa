"""Statistics of texels: weighted sums over views, which can be added.

At one roughness, the residual for base colour c and metallic m is a sum of four columns,

    r - b = c (1 - m) e + c m p + m (q - d) + (d - b).

The squared error of all parameters follows from the P = 10 products of pairs of columns, summed
over the views with weights. Sums are in double precision, because errors are small differences of
sums. ``Factors`` are in single precision.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.errors import OptionError, ShapeError
from svu_mi.presets import AngularPreset
from svu_mi.reflection.principled import mixture
from svu_mi.statistics import texel_blocks as blocks
from svu_mi.statistics.cholesky_factors import PAIRS, Factors, factorize, pair_weights

EDGES = AngularPreset.edges  # eta
PARTLY = 0.01  # tolerance when the number of views is rounded down


def noise_weight(radiance: Any, kappa: Any, contrast: Any = 0.0, edges: Any = EDGES) -> Any:
    """Return w = 1 / (1 + (b / kappa)^2 + eta v / kappa^2); v is the variance of nearby pixels."""
    relative = radiance / kappa
    return 1 / (1 + relative * relative + edges * (contrast / kappa / kappa))


@dataclass(frozen=True)
class LazyStatistics:
    """Unevaluated statistics; each evaluation runs the kernel again.

    Attributes:
        columns: (S,) Float64s, R C P sums of products (see ``Statistics.sums``).
        weight: (S,) Float64, sum of weights.
    """

    columns: list[Any]
    weight: Any
    counts: Any
    texel: Any
    roughness: np.ndarray
    channels: int
    kappa: float
    edges: float

    def statistics(self) -> "Statistics":
        """Return the evaluated sums."""
        count, columns = int(dr.width(self.texel)), [*self.columns, self.weight]
        sums = blocks.write_blocks(mi.Float64, columns, count, self.counts)
        return Statistics(
            sums, self.counts, self.texel, self.roughness, self.channels, self.kappa, self.edges
        )

    def factor(self) -> Factors:
        """Return the factors, without storing the sums."""
        return factorize(
            self.columns, self.weight, whole_views(self.counts), self.texel, self.roughness,
            self.channels,
        )  # fmt: skip


@dataclass(frozen=True)
class Statistics:
    """Statistics of S texels.

    Attributes:
        sums: (ceil(S / 16) * (R * C * P + 1) * 16,) Float64, squared radiance, in blocks (see
            ``texel_blocks``): sum w x y for each level, channel and pair of columns; then sum w.
        counts: (S,) Float, number of views of each texel; fractional if partly saturated.
        texel: (S,) UInt32, texel number in [0, T).
        roughness: (R,) float64, roughness of the levels.
        kappa: radiance above which weights decrease (``noise_weight``). Infinite: equal weights;
            NaN: weights depend on residuals.
        edges: eta of ``noise_weight``; ignored if kappa is infinite.
    """

    sums: Any
    counts: Any
    texel: Any
    roughness: np.ndarray
    channels: int
    kappa: float = inf
    edges: float = EDGES

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
        """Number of values per texel, R C P + 1."""
        return self.levels * self.channels * len(PAIRS) + 1

    def __add__(self, other: "Statistics") -> "Statistics":
        """Return the statistics of the union of both sets of views."""
        if (
            self.channels != other.channels
            or not np.array_equal(self.roughness, other.roughness)
            or not np.array_equal(self.texel.numpy(), other.texel.numpy())
        ):
            raise ShapeError(
                "Statistics of different texels, roughness levels or channels cannot be added: "
                f"{self._shape()} and {other._shape()}."
            )
        if self.kappa != other.kappa or (self.kappa < inf and self.edges != other.edges):
            raise OptionError(
                f"Statistics with kappa {self.kappa:g} and {other.kappa:g} (edges {self.edges:g} "
                f"and {other.edges:g}) cannot be added, because the weights differ; gather both "
                "with the same values."
            )
        sums, counts = self.sums + other.sums, self.counts + other.counts
        dr.eval(sums, counts)
        return replace(self, sums=sums, counts=counts)

    def _shape(self) -> str:
        return f"{self.count} texels x {self.levels} levels x {self.channels} channels"

    @cached_property
    def views(self) -> Any:
        """(S,) UInt32, number of views of each texel, rounded (``whole_views``)."""
        views = whole_views(self.counts)
        dr.eval(views)
        return views

    def factor(self) -> Factors:
        """Return the triangular factors; cached."""
        return self._factors

    @cached_property
    def _factors(self) -> Factors:
        reader = blocks.BlockReader(self.sums, self.rows, self.count)
        *columns, weight = (reader.read(row) for row in range(self.rows))
        return factorize(columns, weight, self.views, self.texel, self.roughness, self.channels)

    @property
    def weight(self) -> np.ndarray:
        """(S,) float64, sum of the weights of samples."""
        return blocks.from_blocks(self.sums, self.rows, self.count)[-1]

    def left_out(self, groups: int) -> "Statistics":
        """Return the sums of all groups of views, and those without each: (1 + G) t texels.

        Texel g t + k of this is texel k in the views of group g alone.
        """

        count, total = self.count // groups, self.counts.numpy().reshape(groups, -1)
        counts = np.concatenate([total.sum(axis=0)[None], total.sum(axis=0) - total])
        sums = blocks.empty_blocks(mi.Float64, self.rows, counts.size)
        texels, rows, end = (dr.opaque(mi.UInt32, n) for n in (count, self.rows, groups))
        lane = dr.arange(mi.UInt32, counts.size)
        without = lane // texels
        place, first = lane - without * texels, blocks.texel_offset(lane, rows)

        def write(row: Any) -> Any:
            def add(group: Any, total: Any) -> tuple[Any, Any]:
                source = blocks.texel_offset(place + group * texels, rows) + row * blocks.BLOCK
                held = group + 1 != without
                return group + 1, total + dr.gather(mi.Float64, self.sums, source, held)

            (value,) = fold(0, end, add, dr.zeros(mi.Float64, counts.size))
            dr.scatter(sums, value, first + row * blocks.BLOCK, mode=dr.ReduceMode.NoConflicts)
            return (row + 1,)

        fold(0, rows, write)
        dr.eval(sums)
        counts = to_drjit(mi.Float, counts.ravel())
        return replace(self, sums=sums, counts=counts, texel=lane)

    def subset(self, lanes: np.ndarray) -> "Statistics":
        """Return the statistics of the texels in ``lanes``, indices in [0, S)."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        return replace(
            self, sums=blocks.gather_texels(self.sums, self.rows, chosen),
            counts=dr.gather(mi.Float, self.counts, chosen),
            texel=dr.gather(mi.UInt32, self.texel, chosen),
        )  # fmt: skip

    def replaced(self, lanes: np.ndarray, others: "Statistics") -> "Statistics":
        """Return a copy in which ``others`` replaces the statistics of the (distinct) ``lanes``."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        counts = mi.Float(self.counts)
        dr.scatter(counts, others.counts, chosen)
        dr.eval(counts)
        sums = blocks.scatter_texels(self.sums, self.rows, chosen, others.sums)
        return replace(self, sums=sums, counts=counts)

    def table(self) -> np.ndarray:
        """Return the sums as (R, C, P, S) float64."""
        rows = blocks.from_blocks(self.sums, self.rows, self.count)[:-1]
        return rows.reshape(self.levels, self.channels, len(PAIRS), self.count)

    def errors(self, *nodes: np.ndarray) -> np.ndarray:
        """Return weighted mean squared errors at grid nodes, (S, R, C, M ..., K); 0 if unseen."""
        *mixed, color = np.meshgrid(*nodes, indexing="ij")
        x = mixture(*mixed).at(color)
        mean = self.table() / np.maximum(self.weight, 1e-300)
        # Rounding can make a sum of squares negative.
        return np.maximum(np.einsum("rcps,p...->src...", mean, pair_weights(x), optimize=True), 0)

    @staticmethod
    def of(
        table: np.ndarray, weight: np.ndarray, views: np.ndarray, roughness: np.ndarray,
        kappa: float = inf,
    ) -> "Statistics":  # fmt: skip
        """Return statistics from NumPy sums, (R, C, P, S); the inverse of ``table``."""
        channels, count = table.shape[1], table.shape[-1]
        rows = np.concatenate([table.reshape(-1, count), np.reshape(weight, (1, count))])
        return Statistics(
            sums=blocks.to_blocks(mi.Float64, rows),
            counts=to_drjit(mi.Float, np.asarray(views, np.float32)),
            texel=dr.arange(mi.UInt32, count),
            roughness=np.asarray(roughness, np.float64), channels=channels, kappa=kappa,
        )  # fmt: skip


def whole_views(counts: Any) -> Any:
    """Return numbers of views rounded down, UInt32; at least 1 if positive."""
    minimum = dr.select(counts > 0, mi.UInt32(1), 0)
    return dr.maximum(mi.UInt32(counts + PARTLY), minimum)
