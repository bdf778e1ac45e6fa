"""Linear smoothing on the surface: (D + K) x = y, D of every texel and K between neighbours.

K is total variation made quadratic around textures x0 [Vogel and Oman 1996]: a link of weight

    w_ij = lambda / sqrt((x0_i - x0_j)^2 + epsilon^2)

of every pair of neighbours, strong where they are alike, weak across an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned

TOLERANCE = 1e-3  # of the residual, relative to the right-hand side's
LOOK = 8  # iterations between looks at it
MOST = 400


@dataclass(frozen=True)
class Smoother:
    """D + K of N fields over T texels, which do not know of each other.

    Lanes are texels of the first field, then of the second, and so on.

    Attributes:
        precision: (N T,) Float, the diagonal of D, positive.
        around: K columns (N T,) UInt32: the lanes of every lane's neighbours, itself where it has
            fewer than K.
        weights: (N T,) Floats of these links.
        diagonal: (N T,) Float, of D + K.
    """

    precision: Any
    around: Sequence[Any]
    weights: Sequence[Any]
    diagonal: Any

    @staticmethod
    def of(
        precision: np.ndarray, values: np.ndarray, table: np.ndarray, strength: float,
        epsilon: float,
    ) -> Smoother:  # fmt: skip
        """Link neighbours that are alike.

        Args:
            precision: (N, T), positive.
            values: (N, T), that links depend on.
            table: (K, T) numbers of neighbours (``Neighbors.table``).
            strength: lambda.
            epsilon: differences far below it do not make a link any stronger.
        """
        fields, count = precision.shape
        own, first = np.arange(count), np.arange(fields)[:, None] * count
        around, weights = [], []
        for column in table:
            apart = values - values[:, column]
            weight = strength / np.sqrt(apart**2 + epsilon**2) * (column != own)
            around.append(owned(mi.UInt32, (first + column).ravel().astype(np.uint32)))
            weights.append(owned(mi.Float, weight.ravel().astype(np.float32)))
        given = owned(mi.Float, precision.ravel().astype(np.float32))
        diagonal = given + sum(weights)
        dr.eval(diagonal)
        return Smoother(given, around, weights, diagonal)

    def __matmul__(self, x: Any) -> Any:
        """Return (D + K) x."""
        total = self.diagonal * x
        for other, weight in zip(self.around, self.weights, strict=True):
            total = dr.fma(-weight, dr.gather(mi.Float, x, other), total)
        return total

    def solve(self, right: Any) -> Any:
        """Return x with (D + K) x = right, by conjugate gradients [Hestenes and Stiefel 1952].

        Args:
            right: (N T,) Float.
        """
        x = right / self.diagonal
        rest = right - self @ x
        step = rest / self.diagonal
        size = dr.sum(rest * step)
        goal = TOLERANCE**2 * dr.sum(dr.square(right) / self.diagonal)
        dr.eval(x, rest, step, size, goal)
        for iteration in range(MOST):
            if iteration % LOOK == 0 and size[0] <= goal[0]:
                break
            x, rest, step, size = self._iterate(x, rest, step, size)
        return x

    def _iterate(self, x: Any, rest: Any, step: Any, size: Any) -> tuple[Any, ...]:
        turned = self @ step
        along = dr.sum(step * turned)
        dr.eval(turned, along)
        length = dr.select(along > 0, size / along, 0)
        x, rest = dr.fma(length, step, x), dr.fma(-length, turned, rest)
        better = rest / self.diagonal
        new = dr.sum(rest * better)
        dr.eval(x, rest, better, new)
        step = dr.fma(dr.select(size > 0, new / size, 0), step, better)
        dr.eval(step)
        return x, rest, step, new

    def pulls(self, random: np.random.Generator) -> Any:
        """Draw from a normal distribution of covariance K, (N T,) Float: every link pulls at both
        of its ends with a force of its own."""
        total = dr.zeros(mi.Float, dr.width(self.diagonal))
        lane = dr.arange(mi.UInt32, dr.width(self.diagonal))
        seed = dr.opaque(mi.UInt64, int(random.integers(2**63)))
        for other, weight in zip(self.around, self.weights, strict=True):
            first, second = dr.minimum(lane, other), dr.maximum(lane, other)
            force = _normal(seed, (mi.UInt64(first) << 32) | mi.UInt64(second))
            sign = dr.select(lane < other, mi.Float(1), mi.Float(-1))
            total = dr.fma(dr.sqrt(weight) * sign, force, total)
        dr.eval(total)
        return total


def _normal(seed: Any, number: Any) -> Any:
    """Return a standard normal number of each (seed, number), whoever asks for it."""
    random = mi.PCG32(initstate=seed, initseq=number)
    u, v = random.next_float32(), random.next_float32()
    return dr.sqrt(-2 * dr.log(1 - u)) * dr.cos(dr.two_pi * v)
