"""Linear smoothing on the surface: (D + K) x = y, D of every texel and K between neighbours.

K is total variation made quadratic around textures x0 [Vogel and Oman 1996]: a link of weight

    w_ij = lambda / sqrt((x0_i - x0_j)^2 + epsilon^2)

of every pair of neighbours, strong where they are alike, weak across an edge.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned

TOLERANCE = 1e-3  # of the residual, relative to the right-hand side's
LOOK = 8  # iterations between looks at it
MOST = 400
CLOSE, LONG = 5e-3, 1000  # the same of what is filled in, relative to the residual at first


@dataclass(frozen=True)
class Smoother:
    """D + K of N fields over T texels, which do not know of each other.

    Lanes are texels of the first field, then of the second, and so on.

    Attributes:
        precision: (N T,) Float, the diagonal of D, positive.
        values: (N T,) Float, x0.
        around: K columns (T,) UInt32: numbers of the neighbours of every texel, its own where it
            has fewer than K.
        strength, epsilon: opaque Floats, of the links.
        diagonal: (N T,) Float, of D + K.
        blind: (N T,) Bool, lanes of whose values links must not know: theirs are as strong as any;
            None for none.
    """

    precision: Any
    values: Any
    around: Sequence[Any]
    strength: Any
    epsilon: Any
    diagonal: Any
    blind: Any | None = None

    @staticmethod
    def of(
        precision: np.ndarray, values: np.ndarray, around: Sequence[Any], strength: float,
        epsilon: float,
    ) -> Smoother:  # fmt: skip
        """Link neighbours that are alike.

        Args:
            precision: (N, T), positive.
            values: (N, T), that links depend on.
            around: K columns (T,) UInt32 (``Neighbors.around``).
            strength: lambda.
            epsilon: differences far below it do not make a link any stronger.
        """
        given, middle = lanes(precision), lanes(values)
        links = dr.opaque(mi.Float, strength), dr.opaque(mi.Float, epsilon)
        return Smoother(given, middle, tuple(around), *links, given)._completed()

    def with_precision(
        self, precision: np.ndarray, values: np.ndarray | None = None,
        blind: np.ndarray | None = None,
    ) -> Smoother:  # fmt: skip
        """Return links of the same strength with another D.

        Args:
            precision: (N, T), positive.
            values: (N, T), that links depend on; by default, those that they do.
            blind: (T,) bool, texels whose values they must not know.
        """
        given, hidden = lanes(precision), None
        middle = self.values if values is None else lanes(values)
        if blind is not None:
            hidden = owned(mi.Bool, np.tile(blind, len(precision)))
        return replace(self, precision=given, values=middle, blind=hidden)._completed()

    def halved(
        self, around: Sequence[Any], precision: np.ndarray, values: np.ndarray
    ) -> Smoother:
        """Return links between groups of 2 x 2 texels: two links of texels go from one group to
        the next, over twice the way.

        Args:
            around: columns (G,) UInt32 of the groups' neighbours.
            precision: (N, G), positive.
            values: (N, G), that links depend on.
        """
        strength, epsilon = 2 * self.strength, 2 * self.epsilon
        dr.eval(strength, epsilon)
        links = replace(self, around=tuple(around), strength=strength, epsilon=epsilon, blind=None)
        return links.with_precision(precision, values)

    def _completed(self) -> Smoother:
        """Return the same with its diagonal."""
        diagonal = self.precision + sum(weight for _, weight in self._links())
        dr.eval(diagonal)
        return replace(self, diagonal=diagonal)

    def _others(self) -> Iterator[Any]:
        """Yield the lane of a neighbour of every lane, its own for none."""
        first = dr.arange(mi.UInt32, dr.width(self.values)) - self._texel
        for column in self.around:
            yield first + dr.gather(mi.UInt32, column, self._texel)

    def _links(self) -> Iterator[tuple[Any, Any]]:
        """Yield the lane of a neighbour of every lane, and the weight of the link, 0 for none."""
        lane = dr.arange(mi.UInt32, dr.width(self.values))
        for other in self._others():
            yield other, dr.select(other == lane, 0, self._weight(other))

    def _weight(self, other: Any) -> Any:
        """Return the weight of the link from every lane to another."""
        apart = self.values - dr.gather(mi.Float, self.values, other)
        if self.blind is not None:
            apart = dr.select(self.blind | dr.gather(mi.Bool, self.blind, other), 0, apart)
        return self.strength * dr.rsqrt(dr.fma(apart, apart, dr.square(self.epsilon)))

    @cached_property
    def _texel(self) -> Any:
        """(N T,) UInt32, which texel a lane is; kept, as divisions take as long as the rest."""
        count = dr.opaque(mi.UInt32, dr.width(self.around[0])) if self.around else 1
        texel = dr.arange(mi.UInt32, dr.width(self.values)) % count
        dr.eval(texel)
        return texel

    def __matmul__(self, x: Any) -> Any:
        """Return (D + K) x."""
        lane, total = dr.arange(mi.UInt32, dr.width(self.values)), self.diagonal * x
        for other in self._others():

            def pulled(total: Any, other: Any = other) -> tuple[Any]:
                return (dr.fma(-self._weight(other), dr.gather(mi.Float, x, other), total),)

            # Only along seams are there more than four; whole packets skip the rest.
            (total,) = dr.if_stmt(
                args=(total,), cond=other != lane, true_fn=pulled, false_fn=lambda total: (total,)
            )
        return total

    def solve(self, right: Any) -> Any:
        """Return x with (D + K) x = right, by conjugate gradients [Hestenes and Stiefel 1952].

        Args:
            right: (N T,) Float.
        """
        x = right / self.diagonal
        goal = TOLERANCE**2 * dr.sum(dr.square(right) / self.diagonal)
        return self._descend(x, right - self @ x, mi.Float(1), goal, MOST)

    def fill(self, right: np.ndarray, start: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Return x with (D + K) x = right at some texels, and what it was at all others, (N, T).

        Args:
            right: (N, T).
            start: (N, T), x to begin with.
            free: (T,) bool, where x is looked for.
        """
        x, wanted = lanes(start), lanes(np.tile(free, (len(start), 1)))
        rest = wanted * (lanes(right) - self @ x)
        goal = CLOSE**2 * dr.sum(dr.square(rest) / self.diagonal)
        found = self._descend(x, rest, wanted, goal, LONG)
        return np.array(found, np.float64).reshape(start.shape)

    def _descend(self, x: Any, rest: Any, free: Any, goal: Any, most: int) -> Any:
        step = rest / self.diagonal
        size = dr.sum(rest * step)
        dr.eval(x, rest, step, size, goal)
        for iteration in range(most):
            if iteration % LOOK == 0 and size[0] <= goal[0]:
                break
            x, rest, step, size = self._iterate(x, rest, step, size, free)
        return x

    def _iterate(self, x: Any, rest: Any, step: Any, size: Any, free: Any) -> tuple[Any, ...]:
        turned = free * (self @ step)
        dr.eval(turned)  # a sum evaluates what it adds up: all of it would be computed twice
        along = dr.sum(step * turned)
        length = dr.select(along > 0, size / along, 0)
        x, rest = dr.fma(length, step, x), dr.fma(-length, turned, rest)
        better = rest / self.diagonal
        dr.eval(x, rest, better)
        new = dr.sum(rest * better)
        step = dr.fma(dr.select(size > 0, new / size, 0), step, better)
        dr.eval(step)
        return x, rest, step, new

    def pulls(self, random: np.random.Generator) -> Any:
        """Draw from a normal distribution of covariance K, (N T,) Float: every link pulls at both
        of its ends with a force of its own."""
        total = dr.zeros(mi.Float, dr.width(self.diagonal))
        lane = dr.arange(mi.UInt32, dr.width(self.diagonal))
        seed = dr.opaque(mi.UInt64, int(random.integers(2**63)))
        for other, weight in self._links():
            first, second = dr.minimum(lane, other), dr.maximum(lane, other)
            force = _normal(seed, (mi.UInt64(first) << 32) | mi.UInt64(second))
            sign = dr.select(lane < other, mi.Float(1), mi.Float(-1))
            total = dr.fma(dr.sqrt(weight) * sign, force, total)
        dr.eval(total)
        return total


def lanes(values: np.ndarray) -> Any:
    """Return (N, T) values as (N T,) Float."""
    return owned(mi.Float, values.ravel().astype(np.float32))


def _normal(seed: Any, number: Any) -> Any:
    """Return a standard normal number of each (seed, number), whoever asks for it."""
    random = mi.PCG32(initstate=seed, initseq=number)
    u, v = random.next_float32(), random.next_float32()
    return dr.sqrt(-2 * dr.log(1 - u)) * dr.cos(dr.two_pi * v)
