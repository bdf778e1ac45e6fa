"""Smoothing from coarse to fine: what is solved on groups of texels is where texels begin.

Links that are strong carry values far, one texel in each iteration of conjugate gradients; over
groups of 2 x 2 they go twice as far, in a quarter of the work (nested iteration [Hackbusch 1985]).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from svu_mi.recovery.field.smoother import Smoother
from svu_mi.surface.neighbors import means, owners_of, sums

FEW = 2**14  # texels that are solved for at once
FEWER = 0.7  # part of the texels from which on groups are no help


@dataclass(frozen=True)
class Nested:
    """A smoother of T texels, and one of groups of these, if they are many.

    Attributes:
        smoother: of the texels.
        coarser: of the groups.
        owner: (T,) int64, the group that each texel is of.
    """

    smoother: Smoother
    coarser: Nested | None = None
    owner: np.ndarray | None = None

    @staticmethod
    def of(smoother: Smoother, squares: np.ndarray) -> Nested:
        """Group texels in squares of 2 x 2, then groups, until few are left.

        Args:
            smoother: of T texels.
            squares: (T, 2) int64, their rows and columns in the map.
        """
        if len(squares) <= FEW:
            return Nested(smoother)
        wider, owner = owners_of(squares // 2)
        if len(wider) > FEWER * len(squares):
            return Nested(smoother)
        values, precision = means(smoother.values, smoother.precision, owner)
        return Nested(smoother, Nested.of(smoother.halved(owner, precision, values), wider), owner)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return x with (D + K) x = right, (N, T) float64 each (``Smoother.solve``)."""
        if self.coarser is None or self.owner is None:
            return self.smoother.solve(right)
        start = self.coarser.solve(sums(right, self.owner))
        return self.smoother.solve(right, start[:, self.owner])
