"""Eq. 12 by its normal equations: (degree + 1)^2 unknowns, any number of views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import cholesky
from svu_mi.frequency.system import Sample, System, unit
from svu_mi.local import allocate, load, store


def fit_primal(sample: Sample, views: Any, system: System) -> list[list[Any]]:
    """Accumulate the normal equations view by view, then solve them in place."""
    solved = Solved.of(sample, views, system)
    return [
        [dr.select(solved.seen, mi.Float(value), 0) for value in row]
        for row in solved.coefficients(system)
    ]


@dataclass
class Solved:
    """Normal equations in local memory, factored and solved.

    Attributes:
        factor: of A = Y^T W^2 Y + lambda R, packed lower tiles.
        solution: c, one block of degree + 1 rows per tile row.
        rows: room for one more row of Y.
        blocks: number of tile rows, UInt32.
        seen: Bool, which lanes saw anything.
    """

    factor: list
    solution: list
    rows: list
    blocks: Any
    seen: Any

    @staticmethod
    def of(sample: Sample, views: Any, system: System) -> Solved:
        """Accumulate the equations view by view, and solve them."""
        size = system.degree + 1  # tiles of this edge fill the matrix without padding
        blocks, memory = dr.opaque(mi.UInt32, size), cholesky.packed_count(size)
        gram = allocate(mi.Float64, size * size, memory)
        right = allocate(mi.Float64, size * system.channels, size)
        rows = allocate(mi.Float64, size, size)
        gram, right = _clear(gram, right, dr.opaque(mi.UInt32, memory), blocks)
        _add_ridge(gram, system, size)
        memory = gram, right, rows, blocks
        gram, right, seen = _accumulate(sample, views, memory, system.basis)
        gram, right = cholesky.factor_and_forward(gram, right, blocks, size)
        right = cholesky.backward(gram, right, blocks, size, size)
        return Solved(gram, right, rows, blocks, seen)

    def coefficients(self, system: System) -> list[list[Any]]:
        """Read c: (degree + 1)^2 rows of channels, Float64."""
        return read_rows(self.solution, system)


def read_rows(memory: list, system: System) -> list[list[Any]]:
    """Read (degree + 1)^2 rows of channels from blocks."""
    size, channels = system.degree + 1, system.channels
    return [
        [memory[i % size * channels + c][i // size] for c in range(channels)]
        for i in range(size * size)
    ]


@dr.syntax
def _clear(gram: list, right: list, tiles: Any, blocks: Any) -> tuple[list, list]:
    """Fill both with zeros."""
    i = mi.UInt32(0)
    while i < tiles:
        store(gram, i, [mi.Float64(0) for _ in gram])
        i += 1
    i = mi.UInt32(0)
    while i < blocks:
        store(right, i, [mi.Float64(0) for _ in right])
        i += 1
    return gram, right


def _add_ridge(gram: list, system: System, size: int) -> None:
    """Write lambda R on the diagonal."""
    for i, l in enumerate(system.degrees):
        tile = cholesky.packed_count(i // size) + i // size
        gram[i % size * (size + 1)][tile] = system.ridge[l] * system.regularizer


@dr.syntax
def _accumulate(
    sample: Sample, views: Any, memory: tuple[list, list, list, Any], basis: Callable[[list], list]
) -> tuple[list, list, Any]:
    """Add Y^T W^2 Y and Y^T W^2 f, and say which lanes saw anything."""
    gram, right, rows, blocks = memory
    seen = mi.Bool(False)
    view = mi.UInt32(0)
    while view < views:
        direction, weight, values = sample(view)
        if weight > 0:
            write_row(rows, basis(unit(direction)), mi.Float64(weight))
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
    """Write w Y_lm(d) of one sample as blocks of len(rows)."""
    for i, value in enumerate(y):
        rows[i % len(rows)][i // len(rows)] = weight * value


def _add_outer(tile: list, a: list, b: list) -> list:
    """Return tile + a b^T."""
    return [dr.fma(a[q // len(b)], b[q % len(b)], value) for q, value in enumerate(tile)]
