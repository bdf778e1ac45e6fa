"""What both ways of solving Eq. 12 share: the problem, and where its samples come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import harmonics
from svu_mi.frequency.precision import Precision

Sample = Callable[[Any], tuple[Any, Any, list[Any]]]
"""``view -> (direction, weight, values)``: see ``fit_lanes``."""


@dataclass(frozen=True)
class System:
    """What both ways of solving Eq. 12 need to know; lists have one entry per degree."""

    degree: int
    channels: int
    ridge: list[float]  # e^l, 0 where a degree is free
    regularizer: Any  # lambda, opaque: a new value must not mean a new kernel
    precision: Precision

    @property
    def Float(self) -> type:  # noqa: N802 - a type
        """What the kernel computes with."""
        return mi.Float if self.precision == "single" else mi.Float64

    @property
    def degrees(self) -> list[int]:
        """The degree of every coefficient."""
        return [l for l in range(self.degree + 1) for _ in range(2 * l + 1)]

    def unit(self, direction: Any) -> Any:
        """Return a direction with unit length in the precision of the kernel.

        In double precision, the rounding of a single precision length (1e-7) would show in the
        fit of many views that crowd together, and make the dual differ from the primal.
        """
        return dr.normalize(vector(self.Float, *direction))

    def basis(self, direction: list[Any]) -> list[Any]:
        """Y_lm of a unit direction in the precision of the kernel."""
        return harmonics.basis(vector(self.Float, *direction), self.degree)

    def row(self, direction: Any, weight: Any) -> list[Any]:
        """w Y_lm of one sample in the precision of the kernel."""
        w = self.Float(weight)
        return [w * y for y in harmonics.basis(self.unit(direction), self.degree)]


def vector(Float: type, x: Any, y: Any, z: Any) -> Any:  # noqa: N803 - a type
    """Return a 3-vector of the given precision."""
    return (mi.Vector3d if Float is mi.Float64 else mi.Vector3f)(x, y, z)
