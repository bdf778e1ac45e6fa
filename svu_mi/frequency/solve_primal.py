"""Primal solver of Eq. 12: normal equations with (degree + 1)^2 unknowns.

``fit_candidates`` also returns fits with one additional sample, for each of several candidates.
With A = Y^T W^2 Y + lambda R factorised once, a sample with basis values y, weight w and value f
changes c to [Sherman and Morrison 1950]

    c' = c + A^-1 w y  w (f - y . c) / (1 + w y . A^-1 w y).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.core.local_memory import allocate, load, store, zeros
from svu_mi.frequency import cholesky
from svu_mi.frequency.harmonics import FitSystem, ReadSample, normalized_double, power_per_degree


def fit_primal(sample: ReadSample, views: Any, system: FitSystem) -> list[list[Any]]:
    """Fit the samples of each lane; return coefficients (see ``fit_lanes``)."""
    solved = SolvedSystem.of(sample, views, system)
    return [
        [dr.select(solved.seen, mi.Float(value), 0) for value in row]
        for row in solved.coefficients(system)
    ]


@dataclass
class SolvedSystem:
    """Factorised and solved normal equations, in local memory.

    Attributes:
        factor: Cholesky factor of A = Y^T W^2 Y + lambda R, packed lower tiles.
        solution: c, in blocks of degree + 1 rows per tile row.
        rows: working memory for one row of Y.
    """

    factor: list
    solution: list
    rows: list
    blocks: Any
    seen: Any

    @staticmethod
    def of(sample: ReadSample, views: Any, system: FitSystem) -> "SolvedSystem":
        """Accumulate the equations over the views and solve them."""
        size = system.degree + 1  # tiles with this edge need no padding
        blocks, memory = dr.opaque(mi.UInt32, size), cholesky.packed_count(size)
        gram = zeros(mi.Float64, size * size, memory)
        right = zeros(mi.Float64, size * system.channels, size)
        rows = allocate(mi.Float64, size, size)
        _add_ridge(gram, system, size)
        memory = gram, right, rows, blocks
        gram, right, seen = _accumulate(sample, views, memory, system.basis)
        gram, right = cholesky.factor_and_forward(gram, right, blocks, size)
        right = cholesky.backward(gram, right, blocks, size, size)
        return SolvedSystem(gram, right, rows, blocks, seen)

    def coefficients(self, system: FitSystem) -> list[list[Any]]:
        """Return c: (degree + 1)^2 rows of channels, Float64."""
        return read_rows(self.solution, system)


def read_rows(memory: list, system: FitSystem) -> list[list[Any]]:
    """Return (degree + 1)^2 rows of channels, read from blocks."""
    size, channels = system.degree + 1, system.channels
    return [
        [memory[i % size * channels + c][i // size] for c in range(channels)]
        for i in range(size * size)
    ]


def _add_ridge(gram: list, system: FitSystem, size: int) -> None:
    """Write lambda R on the diagonal."""
    for i, l in enumerate(system.degrees):
        tile = cholesky.packed_count(i // size) + i // size
        gram[i % size * (size + 1)][tile] = system.ridge[l] * system.regularizer


@dr.syntax
def _accumulate(
    sample: ReadSample, views: Any, memory: tuple[list, list, list, Any],
    basis: Callable[[list], list],
) -> tuple[list, list, Any]:  # fmt: skip
    """Add Y^T W^2 Y and Y^T W^2 f to ``memory``; return both, and a mask of seen lanes."""
    gram, right, rows, blocks = memory
    seen = mi.Bool(False)
    view = mi.UInt32(0)
    while view < views:
        direction, weight, values = sample(view)
        if weight > 0:
            write_row(rows, basis(normalized_double(direction)), mi.Float64(weight))
            scaled = [mi.Float64(weight) * mi.Float64(value) for value in values]
            bi = mi.UInt32(0)
            while bi < blocks:
                a = load(rows, bi)
                bj = mi.UInt32(0)
                while bj <= bi:
                    tile = cholesky.packed_count(bi) + bj
                    b = load(rows, bj)
                    store(gram, tile, _add_outer(load(gram, tile), a, b))
                    bj += 1
                store(right, bi, _add_outer(load(right, bi), a, scaled))
                bi += 1
            seen |= True
        view += 1
    return gram, right, seen


def write_row(rows: list, y: list, weight: Any) -> None:
    """Write w Y_lm(d) of one sample; index i is at row i % len(rows)."""
    for i, value in enumerate(y):
        rows[i % len(rows)][i // len(rows)] = weight * value


def _add_outer(tile: list, a: list, b: list) -> list:
    """Return tile + a b^T."""
    return [dr.fma(a[q // len(b)], b[q % len(b)], value) for q, value in enumerate(tile)]


FREE = 1e-12
"""Replaces R_00 = 0, so that the matrix of a lane without samples is regular. The relative change
of c is 1e-12."""

TakeSpectrum = Callable[[Any, list[list[Any]]], None]
"""Callback (j, power): spectrum with candidate j added, Float64 by degree and channel."""


def fit_candidates(
    known: tuple[ReadSample, Any], added: tuple[ReadSample, Any], system: FitSystem,
    take: TakeSpectrum,
) -> list[list[Any]]:  # fmt: skip
    """Return the spectrum of the ``known`` samples, and call ``take`` for each candidate.

    ``take`` receives the spectrum of the known samples and one added sample, the candidate.
    ``known`` and ``added`` are pairs of a sample function and the number of samples.
    """
    system = replace(system, ridge=[max(value, FREE) for value in system.ridge])
    solved = SolvedSystem.of(*known, system)
    sample, candidates = added
    _add_each(_AddedSample(system, sample, take), candidates, solved, system.degree + 1)
    return power_per_degree(solved.coefficients(system))


class _AddedSample:
    """Rank-one update by one sample. Not a dataclass: Dr.Jit would treat fields as loop state."""

    def __init__(self, system: FitSystem, added: ReadSample, take: TakeSpectrum) -> None:
        self._system, self.added, self._take = system, added, take

    def basis(self, direction: Any) -> list[Any]:
        """Return the basis values y of a direction."""
        return self._system.basis(normalized_double(direction))

    def norm(self, step: list) -> Any:
        """Return 1 + w y . A^-1 w y, from z = L^-1 w y."""
        size = self._system.degree + 1
        z = [step[i % size][i // size] for i in range(size * size)]
        return 1 + sum(value * value for value in z)

    def errors(self, fitted: list, y: list, values: list, scale: Any) -> list[Any]:
        """Return ``scale`` times the sample's residual f - y . c, for each channel."""
        old = read_rows(fitted, self._system)
        return [
            scale * (mi.Float64(f) - sum(b * c[k] for b, c in zip(y, old, strict=True)))
            for k, f in enumerate(values)
        ]

    def take(self, j: Any, fitted: list, step: list, errors: list) -> None:
        """Call ``take`` with the changed spectrum; ``step`` contains A^-1 w y."""
        size, old = self._system.degree + 1, read_rows(fitted, self._system)
        new = [
            [dr.fma(step[i % size][i // size], e, c) for e, c in zip(errors, row, strict=True)]
            for i, row in enumerate(old)
        ]
        self._take(j, power_per_degree(new))


@dr.syntax
def _add_each(change: _AddedSample, candidates: Any, solved: SolvedSystem, size: int) -> Any:
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
