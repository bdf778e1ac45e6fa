"""Eq. 12 by its normal equations: (degree + 1)^2 unknowns, any number of views."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import cholesky
from svu_mi.frequency.system import Sample, System, unit


def fit_primal(sample: Sample, views: Any, system: System) -> list[list[Any]]:
    """Accumulate the normal equations view by view, then solve them in place."""
    count = (system.degree + 1) ** 2
    size = system.degree + 1  # tiles of this edge fill the matrix without padding
    blocks = dr.opaque(mi.UInt32, count // size)
    memory = cholesky.packed_count(count // size)
    gram = cholesky.allocate(mi.Float64, size * size, memory)
    right = cholesky.allocate(mi.Float64, size * system.channels, count // size)
    rows = cholesky.allocate(mi.Float64, size, count // size)
    gram, right = clear(gram, right, dr.opaque(mi.UInt32, memory), blocks)
    write_ridge(gram, system, size)
    gram, right, seen = accumulate(sample, views, gram, right, rows, blocks, system.basis)
    gram, right = cholesky.factor_and_forward(gram, right, blocks, size)
    right = cholesky.backward(gram, right, blocks, size, count // size)
    return [
        [
            dr.select(seen, mi.Float(right[i % size * system.channels + c][i // size]), 0)
            for c in range(system.channels)
        ]
        for i in range(count)
    ]


@dr.syntax
def clear(gram: list, right: list, tiles: Any, blocks: Any) -> tuple[list, list]:
    """Fill both with zeros."""
    i = mi.UInt32(0)
    while i < tiles:
        cholesky.store(gram, i, [mi.Float64(0) for _ in gram])
        i += 1
    i = mi.UInt32(0)
    while i < blocks:
        cholesky.store(right, i, [mi.Float64(0) for _ in right])
        i += 1
    return gram, right


def write_ridge(gram: list, system: System, size: int) -> None:
    """Write lambda R on the diagonal."""
    for i, l in enumerate(system.degrees):
        tile = cholesky.packed_count(i // size) + i // size
        gram[i % size * (size + 1)][tile] = system.ridge[l] * system.regularizer


@dr.syntax
def accumulate(
    sample: Sample,
    views: Any,
    gram: list,
    right: list,
    rows: list,
    blocks: Any,
    basis: Callable[[list], list],
) -> tuple[list, list, Any]:
    """Add Y^T W^2 Y and Y^T W^2 f, and say which lanes saw anything."""
    seen = mi.Bool(False)
    view = mi.UInt32(0)
    while view < views:
        direction, weight, values = sample(view)
        if weight > 0:
            write_row(rows, basis(unit(direction)), mi.Float64(weight))
            scaled = [mi.Float64(weight) * mi.Float64(value) for value in values]
            bi = mi.UInt32(0)
            while bi < blocks:
                a = cholesky.load(rows, bi)
                bj = mi.UInt32(0)
                while bj <= bi:
                    tile = cholesky.packed_count(bi) + bj
                    b = cholesky.load(rows, bj)
                    cholesky.store(gram, tile, _add_outer(cholesky.load(gram, tile), a, b))
                    bj += 1
                cholesky.store(right, bi, _add_outer(cholesky.load(right, bi), a, scaled))
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
