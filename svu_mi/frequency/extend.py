"""Fits with one more sample, for every sample that might be added: rank-1 changes of Eq. 12.

With A = Y^T W^2 Y + lambda R factored once, a sample of direction y, weight w and value f
changes the coefficients c by [Sherman and Morrison 1950]

    c' = c + A^-1 w y  w (f - y . c) / (1 + w y . A^-1 w y),

two substitutions instead of a factorisation. In double precision, like the fit itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import cholesky
from svu_mi.frequency.primal import Solved, read_rows, write_row
from svu_mi.frequency.spectrum import power_lanes
from svu_mi.frequency.system import Sample, System, unit

FREE = 1e-12
"""Stands for R_00 = 0: a lane without samples has a matrix, too. Changes c by 1e-12 of itself."""

Take = Callable[[Any, list[list[Any]]], None]
"""``(j, power)``: is given the spectrum with sample j added, Float64 by degree and channel."""


def extend_lanes(
    known: tuple[Sample, Any], added: tuple[Sample, Any], system: System, take: Take
) -> list[list[Any]]:
    """Fit the samples that are known, then each candidate in addition to them.

    Args:
        known: samples of Eq. 12, as ``fit_lanes`` takes them, and how many, an opaque UInt32.
        added: the candidates, in the same form.
        system: the problem.
        take: called where a candidate's weight is positive, within the kernel.

    Returns:
        Power spectrum of the known samples alone: Float64 by degree and channel.
    """
    system = replace(system, ridge=[max(value, FREE) for value in system.ridge])
    solved = Solved.of(*known, system)
    sample, candidates = added
    _add_each(_Change(system, sample, take), candidates, solved, system.degree + 1)
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

    def errors(self, fitted: list, y: list, values: list, scale: Any) -> list[Any]:
        """scale (f - y . c) of every channel."""
        old = read_rows(fitted, self._system)
        return [
            scale * (mi.Float64(f) - sum(b * c[k] for b, c in zip(y, old, strict=True)))
            for k, f in enumerate(values)
        ]

    def take(self, j: Any, fitted: list, step: list, errors: list) -> None:
        """Hand the changed spectrum over; ``step`` holds A^-1 w y."""
        size, old = self._system.degree + 1, read_rows(fitted, self._system)
        new = [
            [dr.fma(step[i % size][i // size], e, c) for e, c in zip(errors, row, strict=True)]
            for i, row in enumerate(old)
        ]
        self._take(j, power_lanes(new))


@dr.syntax
def _add_each(change: _Change, candidates: Any, solved: Solved, size: int) -> Any:
    gram, fitted, step, blocks = solved.factor, solved.solution, solved.rows, solved.blocks
    j = mi.UInt32(0)
    while j < candidates:
        direction, weight, values = change.added(j)
        if weight > 0:
            y, w = change.basis(direction), mi.Float64(weight)
            write_row(step, y, w)
            step = cholesky.forward(gram, step, blocks, size)
            scale = w / change.norm(step)
            step = cholesky.backward(gram, step, blocks, size, size)
            change.take(j, fitted, step, change.errors(fitted, y, values, scale))
        j += 1
    return step
