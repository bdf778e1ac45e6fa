"""Fits with one more sample, for every sample that might be added: rank-1 changes of Eq. 12.

With A = Y^T W^2 Y + lambda R factored once, a sample of direction y, weight w and value f
changes the coefficients c by [Sherman and Morrison 1950]

    c' = c + A^-1 w y  w (f - y . c) / (1 + w y . A^-1 w y),

two substitutions instead of a factorisation. In double precision, like the fit itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import cholesky, harmonics
from svu_mi.frequency.primal import Solved, read_rows, write_row
from svu_mi.frequency.spectrum import power_lanes
from svu_mi.frequency.system import Sample, System, unit

FREE = 1e-12
"""Stands for R_00 = 0: a lane without samples has a matrix, too. Changes c by 1e-12 of itself."""

Take = Callable[[Any, list[list[Any]]], None]
"""``(j, power)``: is given the spectrum with sample j added, Float64 by degree and channel."""


def extend_lanes(
    known: Sample,
    views: Any,
    added: Sample,
    candidates: Any,
    take: Take,
    *,
    degree: int,
    channels: int,
    regularizer: float,
    penalize_constant: bool,
) -> list[list[Any]]:
    """Fit the samples that are known, then each candidate in addition to them.

    Args:
        known: samples of Eq. 12, as ``fit_lanes`` takes them.
        views: how many, an opaque UInt32.
        added: the candidates, in the same form.
        candidates: how many, an opaque UInt32.
        take: called where a candidate's weight is positive, within the kernel.
        degree: l*, in [0, 9].
        channels: number of right-hand sides.
        regularizer: lambda > 0.
        penalize_constant: R_00 = 1 as printed (True) or 0 (False).

    Returns:
        Power spectrum of the known samples alone: Float64 by degree and channel.
    """
    ridge = [max(value, FREE) for value in harmonics.ridge(degree, penalize_constant)]
    system = System(degree, channels, ridge, dr.opaque(mi.Float64, regularizer))
    solved = Solved.of(known, views, system)
    _add_each(
        _Change(system, added, take), candidates, solved.factor, solved.solution, solved.rows,
        solved.blocks, degree + 1,
    )  # fmt: skip
    return power_lanes(solved.coefficients(system))


class _Change:
    """What a sample changes; not a dataclass, which a loop would take for part of its state."""

    def __init__(self, system: System, added: Sample, take: Take) -> None:
        self._system, self.added, self._take = system, added, take

    def basis(self, direction: Any) -> list[Any]:
        """y of a direction."""
        return self._system.basis(unit(direction))

    def norm(self, step: list) -> Any:
        """1 + w y . A^-1 w y, from z = L^-1 w y."""
        size = self._system.degree + 1
        z = [step[i % size][i // size] for i in range(size * size)]
        return 1 + sum(value * value for value in z)

    def take(self, j: Any, fitted: list, step: list, y: list, weight: Any, values: list,
             norm: Any) -> None:  # fmt: skip
        """Hand the changed spectrum over; ``step`` holds A^-1 w y."""
        size, old = self._system.degree + 1, read_rows(fitted, self._system)
        errors = [
            weight * (mi.Float64(f) - sum(b * c[k] for b, c in zip(y, old, strict=True))) / norm
            for k, f in enumerate(values)
        ]
        new = [
            [dr.fma(step[i % size][i // size], e, c) for e, c in zip(errors, row, strict=True)]
            for i, row in enumerate(old)
        ]
        self._take(j, power_lanes(new))


@dr.syntax
def _add_each(
    change: _Change, candidates: Any, gram: list, fitted: list, step: list, blocks: Any, size: int
) -> Any:
    j = mi.UInt32(0)
    while j < candidates:
        direction, weight, values = change.added(j)
        if weight > 0:
            y, w = change.basis(direction), mi.Float64(weight)
            write_row(step, y, w)
            step = cholesky.forward(gram, step, blocks, size)
            norm = change.norm(step)
            step = cholesky.backward(gram, step, blocks, size, size)
            change.take(j, fitted, step, y, w, values, norm)
        j += 1
    return step
