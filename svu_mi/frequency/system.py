"""What both ways of solving Eq. 12 share: the problem, and where its samples come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import harmonics

Sample = Callable[[Any], tuple[Any, Any, list[Any]]]
"""``view -> (direction, weight, values)``: see ``fit_lanes``."""


@dataclass(frozen=True)
class System:
    """What both ways of solving Eq. 12 need to know; lists have one entry per degree."""

    degree: int
    channels: int
    ridge: list[float]  # e^l, 0 where a degree is free
    regularizer: Any  # lambda, an opaque double: a new value must not mean a new kernel

    @staticmethod
    def of(degree: int, channels: int, regularizer: float, penalize_constant: bool) -> System:
        """State the problem.

        Args:
            degree: l*, in [0, 9].
            channels: number of right-hand sides; they share one factorisation.
            regularizer: lambda > 0.
            penalize_constant: R_00 = 1 as printed (True) or 0 (False).
        """
        ridge = harmonics.ridge(degree, penalize_constant)
        return System(degree, channels, ridge, dr.opaque(mi.Float64, regularizer))

    @property
    def degrees(self) -> list[int]:
        """The degree of every coefficient."""
        return [l for l in range(self.degree + 1) for _ in range(2 * l + 1)]

    def basis(self, direction: list[Any]) -> list[Any]:
        """Y_lm of a unit direction, in double precision."""
        return harmonics.basis(mi.Vector3d(*direction), self.degree)


def unit(direction: Any) -> Any:
    """Return a single precision direction with unit length in double precision.

    The rounding of its length (1e-7) shows in the fit of many views that crowd together, and
    makes the addition theorem, hence the dual, differ from the primal.
    """
    return dr.normalize(mi.Vector3d(direction))
