"""Solver of sparse linear systems (D + K) x = y between neighbours on the surface.

D is diagonal. Total variation is approximated by a quadratic around textures x0 (lagged diffusivity
[Vogel and Oman 1996]). K is its Hessian, a graph Laplacian. Each pair of neighbours has a link of
weight

    w_ij = lambda / sqrt((x0_i - x0_j)^2 + epsilon^2),

strong between similar texels, weak across edges.

Conjugate gradients propagate values by one texel per iteration. ``Nested`` therefore starts at the
solution on groups of 2 x 2 texels (nested iteration [Hackbusch 1985]).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.neighbors import (
    group_means,
    group_neighbors,
    group_sums,
    occupied_squares,
    over_neighbors,
)

TOLERANCE = 1e-3  # of the residual, relative to the right-hand side
CHECK_EVERY = 8  # iterations between convergence tests
MOST_ITERATIONS = 400
# For ``solve_masked``: tolerance relative to the initial residual.
MASKED_TOLERANCE, MASKED_ITERATIONS = 5e-3, 1000
FEW_TEXELS = 2**14  # texels up to which no groups are formed
GROUPING_LIMIT = 0.7  # largest useful ratio of groups to texels


@dataclass(frozen=True)
class Smoother:
    """Matrix D + K of N independent fields over T texels.

    A *vector* is a Float (N T,), field by field.

    Attributes:
        fields: Number of fields, N.
        around: Neighbours of the texels, columns (T,) UInt32 of ``Neighbors``.
        lanes: Neighbours of the elements of a vector, columns (N T,) UInt32.
        strength, epsilon: lambda and epsilon of the links, opaque Floats.
        own: Diagonal of D, a vector of positive values.
        start: x0, a vector.
        diagonal: Diagonal of D + K, a vector.
        masked: (N T,) Bool, elements whose links have full strength whatever x0 is; or None.
    """

    fields: int
    around: Sequence[Any]
    lanes: Sequence[Any]
    strength: Any
    epsilon: Any
    own: Any
    start: Any
    diagonal: Any
    masked: Any | None = None

    @staticmethod
    def of(
        precision: np.ndarray, values: np.ndarray, around: Sequence[Any], strength: float,
        epsilon: float,
    ) -> "Smoother":  # fmt: skip
        """Create the matrix from D = ``precision`` and x0 = ``values``, (N, T) each."""
        own, start = _vector(precision), _vector(values)
        links = dr.opaque(mi.Float, strength), dr.opaque(mi.Float, epsilon)
        lanes = _lanes(around, len(values))
        return Smoother(len(values), tuple(around), lanes, *links, own, start, own)._completed()

    def with_precision(
        self, precision: np.ndarray, values: np.ndarray | None = None,
        masked: np.ndarray | None = None,
    ) -> "Smoother":  # fmt: skip
        """Return a copy with another D and, if given, another x0 and mask."""
        start = self.start if values is None else _vector(values)
        hidden = None if masked is None else to_drjit(mi.Bool, np.tile(masked, self.fields))
        return replace(self, own=_vector(precision), start=start, masked=hidden)._completed()

    def restricted(self, texels: np.ndarray) -> "Smoother":
        """Return the links of texels (t,), complete where all neighbours are among them."""
        own, place = np.arange(len(texels)), np.full(dr.width(self.around[0]), -1)
        place[texels] = own
        columns = [place[np.array(column, np.int64)[texels]] for column in self.around]
        around = [to_drjit(mi.UInt32, np.where(c < 0, own, c).astype(np.uint32)) for c in columns]
        return replace(self, around=around, lanes=_lanes(around, self.fields))

    def halved(self, owner: np.ndarray, precision: np.ndarray, values: np.ndarray) -> "Smoother":
        """Return the matrix of groups of 2 x 2 texels, given the group (T,) of each texel.

        Two links join adjacent groups, so the strength doubles. Epsilon doubles like the distance.
        """
        around = group_neighbors([np.array(column, np.int64) for column in self.around], owner)
        strength, epsilon = 2 * self.strength, 2 * self.epsilon
        dr.eval(strength, epsilon)
        links = replace(
            self, around=around, lanes=_lanes(around, self.fields),
            strength=strength, epsilon=epsilon, masked=None,
        )  # fmt: skip
        return links.with_precision(precision, values)

    @property
    def precision(self) -> np.ndarray:
        """Diagonal of D, (N, T) float64."""
        return self._table(self.own)

    @property
    def values(self) -> np.ndarray:
        """x0, (N, T) float64."""
        return self._table(self.start)

    @property
    def links(self) -> np.ndarray:
        """Diagonal of K, the sum of the link weights of each texel, (N, T) float64."""
        return self._table(self.diagonal - self.own)

    @cached_property
    def squared_steps(self) -> np.ndarray:
        """Mean squared difference of x0 between each texel and its neighbours, (N, T) float64."""

        def added(other: Any, sums: Any) -> Any:
            apart = self.start - dr.gather(mi.Float, self.start, other)
            return dr.fma(apart, apart, sums[0]), sums[1] + 1

        total, number = over_neighbors(self.lanes, added, (mi.Float(0), mi.Float(0)))
        return self._table(total / dr.maximum(number, 1))

    def solve(self, right: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """Solve (D + K) x = right, (N, T), by conjugate gradients [Hestenes and Stiefel 1952]."""
        wanted = _vector(right)
        x = wanted / self.diagonal if start is None else _vector(start)
        goal = TOLERANCE**2 * dr.sum(dr.square(wanted) / self.diagonal)
        return self._table(self._descend(x, wanted - self @ x, mi.Float(1), goal, MOST_ITERATIONS))

    def solve_masked(self, right: np.ndarray, start: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Solve (D + K) x = right at ``free`` texels; others keep ``start``: (N, T)."""
        x, wanted = _vector(start), _vector(np.tile(free, (len(start), 1)))
        rest = wanted * (_vector(right) - self @ x)
        goal = MASKED_TOLERANCE**2 * dr.sum(dr.square(rest) / self.diagonal)
        return self._table(self._descend(x, rest, wanted, goal, MASKED_ITERATIONS))

    def sample_links(self, random: np.random.Generator) -> np.ndarray:
        """Draw from N(0, K), (N, T) float64, as the sum of one random force per link."""
        seed = dr.opaque(mi.UInt64, int(random.integers(2**63)))
        own, total = dr.arange(mi.UInt32, dr.width(self.own)), mi.Float(0)
        for other in self.lanes:
            first, second = dr.minimum(own, other), dr.maximum(own, other)
            force = _normal(seed, (mi.UInt64(first) << 32) | mi.UInt64(second))
            pull = dr.sqrt(self._weight(other)) * dr.select(own < other, force, -force)
            total = dr.select(other != own, total + pull, total)
        return self._table(total)

    def __matmul__(self, x: Any) -> Any:
        """Return (D + K) x."""
        dr.eval(x)

        def pulled(other: Any, total: Any) -> Any:
            return dr.fma(-self._weight(other), dr.gather(mi.Float, x, other), total)

        return over_neighbors(self.lanes, pulled, self.diagonal * x)

    def _completed(self) -> "Smoother":
        """Return a copy with ``diagonal`` computed."""

        def added(other: Any, total: Any) -> Any:
            return total + self._weight(other)

        diagonal = over_neighbors(self.lanes, added, self.own)
        dr.eval(diagonal)
        return replace(self, diagonal=diagonal)

    def _weight(self, other: Any) -> Any:
        """Return the link weight between each element of a vector and the element ``other``."""
        apart = self.start - dr.gather(mi.Float, self.start, other)
        if self.masked is not None:
            apart = dr.select(self.masked | dr.gather(mi.Bool, self.masked, other), 0, apart)
        return self.strength * dr.rsqrt(dr.fma(apart, apart, dr.square(self.epsilon)))

    def _descend(self, x: Any, rest: Any, free: Any, goal: Any, most: int) -> Any:
        step = rest / self.diagonal
        size = _dot(rest, step)
        dr.eval(x, goal)
        for iteration in range(most):
            if iteration % CHECK_EVERY == 0 and size[0] <= goal[0]:
                break
            x, rest, step, size = self._iterate(x, rest, step, size, free)
        return x

    def _iterate(self, x: Any, rest: Any, step: Any, size: Any, free: Any) -> tuple[Any, ...]:
        turned = free * (self @ step)
        along = _dot(step, turned)
        length = dr.select(along > 0, size / along, 0)
        x, rest = dr.fma(length, step, x), dr.fma(-length, turned, rest)
        better = rest / self.diagonal
        dr.schedule(x)
        new = _dot(rest, better)
        return x, rest, dr.fma(dr.select(size > 0, new / size, 0), step, better), new

    def _table(self, vector: Any) -> np.ndarray:
        """Return a vector as (N, T) float64."""
        return np.array(vector.numpy().reshape(self.fields, -1), np.float64)


def _vector(table: np.ndarray) -> Any:
    """Convert (N, T) values to a vector."""
    return to_drjit(mi.Float, table.astype(np.float32).ravel())


def _lanes(around: Sequence[Any], fields: int) -> list[Any]:
    """Return the neighbours of the elements of a vector."""
    first = np.arange(fields, dtype=np.uint32)[:, None] * np.uint32(dr.width(around[0]))
    return [to_drjit(mi.UInt32, (first + np.array(column)).ravel()) for column in around]


def _dot(a: Any, b: Any) -> Any:
    """Return the inner product of two vectors, which are evaluated in the same kernel."""
    product = a * b
    dr.eval(a, b, product)
    return dr.sum(product)


def _normal(seed: Any, number: Any) -> Any:
    """Return standard normal random numbers, a function of (seed, number)."""
    random = mi.PCG32(initstate=seed, initseq=number)
    u, v = random.next_float32(), random.next_float32()
    return dr.sqrt(-2 * dr.log(1 - u)) * dr.cos(dr.two_pi * v)


@dataclass(frozen=True)
class Nested:
    """Multilevel solver: the matrix of T texels, and a solver for groups of texels.

    Attributes:
        smoother: Matrix of the texels.
        coarser: Solver of the groups; None on the coarsest level.
        owner: (T,) int64, group of each texel.
    """

    smoother: Smoother
    coarser: "Nested | None" = None
    owner: np.ndarray | None = None

    @staticmethod
    def of(smoother: Smoother, squares: np.ndarray) -> "Nested":
        """Group texels in squares of 2 x 2 recursively, down to FEW_TEXELS."""
        if len(squares) <= FEW_TEXELS:
            return Nested(smoother)
        wider, owner = occupied_squares(squares // 2)
        if len(wider) > GROUPING_LIMIT * len(squares):
            return Nested(smoother)
        values, precision = group_means(smoother.values, smoother.precision, owner)
        return Nested(smoother, Nested.of(smoother.halved(owner, precision, values), wider), owner)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve (D + K) x = right, (N, T) float64 each."""
        if self.coarser is None or self.owner is None:
            return self.smoother.solve(right)
        start = self.coarser.solve(group_sums(right, self.owner))
        return self.smoother.solve(right, start[:, self.owner])
