"""Solver of symmetric positive definite systems in local memory, one system per lane.

The lower triangle is divided into square tiles, which are in registers while in use. Loops over
tiles are symbolic, so compile time is independent of the size, which can differ between lanes.
Unrolled loops are in plain helpers, because ``@dr.syntax`` would trace them.
"""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.core.local_memory import Block, load, store


def packed_count(blocks: Any) -> Any:
    """Return the number of tiles in the lower triangle of ``blocks`` x ``blocks`` tiles."""
    return (blocks * (blocks + 1)) >> 1


def _subtract_outer(tile: Block, a: Block, b: Block, size: int, lower: bool = False) -> Block:
    """Return tile - a b^T, or only its lower triangle."""
    out = list(tile)
    for k in range(size):
        for i in range(size):
            for j in range(i + 1 if lower else size):
                q = i * size + j
                out[q] = dr.fma(-a[i * size + k], b[j * size + k], out[q])
    return out


def _factor(tile: Block, size: int) -> Block:
    """Return the Cholesky factor of a diagonal tile, with 1 / L_jj on the diagonal."""
    out = list(tile)
    for j in range(size):
        pivot = dr.rcp(dr.sqrt(out[j * size + j]))
        out[j * size + j] = pivot
        for i in range(j + 1, size):
            out[i * size + j] = out[i * size + j] * pivot
        for k in range(j + 1, size):
            for i in range(k, size):
                q = i * size + k
                out[q] = dr.fma(-out[i * size + j], out[k * size + j], out[q])
    return out


def _divide_right(tile: Block, lower: Block, size: int) -> Block:
    """Return X with X L^T = tile; ``lower`` is L, with reciprocals on the diagonal."""
    out = list(tile)
    for j in range(size):
        for i in range(size):
            value = out[i * size + j]
            for k in range(j):
                value = dr.fma(-out[i * size + k], lower[j * size + k], value)
            out[i * size + j] = value * lower[j * size + j]
    return out


def _subtract_applied(right: Block, tile: Block, other: Block, size: int, transpose: bool) -> Block:
    """Return right - tile @ other (or tile^T @ other) for a block of right-hand sides."""
    columns = len(right) // size
    out = list(right)
    for k in range(size):
        for i in range(size):
            entry = -tile[k * size + i if transpose else i * size + k]
            for c in range(columns):
                q = i * columns + c
                out[q] = dr.fma(entry, other[k * columns + c], out[q])
    return out


def _substitute(right: Block, lower: Block, size: int, transpose: bool) -> Block:
    """Solve L x = right (or L^T x = right) within one diagonal tile."""
    columns = len(right) // size
    out = list(right)
    for i in reversed(range(size)) if transpose else range(size):
        for c in range(columns):
            value = out[i * columns + c]
            for k in range(i + 1, size) if transpose else range(i):
                entry = lower[k * size + i] if transpose else lower[i * size + k]
                value = dr.fma(-entry, out[k * columns + c], value)
            out[i * columns + c] = value * lower[i * size + i]
    return out


@dr.syntax
def factor_and_forward(
    lower: list[Any],
    solution: list[Any],
    blocks: Any,
    size: int,
    matrix: Callable[[Any, Any, bool], Block] | None = None,
    right: Callable[[Any], Block] | None = None,
) -> tuple[list[Any], list[Any]]:
    """Factorise M = L L^T and solve L z = b; return L in ``lower``, z in ``solution``.

    Tile (i, j) of L is at i (i + 1) / 2 + j; z has ``size`` rows per tile row. ``matrix(i, j,
    diagonal)`` returns a tile of M, padded with the identity; ``right(i)`` returns rows of b,
    padded with zeros. Without them, ``lower`` contains M, and ``solution`` contains b.
    """
    entry = matrix or (lambda bi, bj, _: load(lower, packed_count(bi) + bj))
    given = right or (lambda bi: load(solution, bi))
    bi = mi.UInt32(0)
    while bi < blocks:
        row = packed_count(bi)
        bj = mi.UInt32(0)
        while bj < bi:
            column = packed_count(bj)
            tile = entry(bi, bj, False)
            bk = mi.UInt32(0)
            while bk < bj:
                tile = _subtract_outer(tile, load(lower, row + bk), load(lower, column + bk), size)
                bk += 1
            store(lower, row + bj, _divide_right(tile, load(lower, column + bj), size))
            bj += 1
        diagonal, block = entry(bi, bi, True), given(bi)
        bk = mi.UInt32(0)
        while bk < bi:
            left = load(lower, row + bk)
            diagonal = _subtract_outer(diagonal, left, left, size, True)
            block = _subtract_applied(block, left, load(solution, bk), size, False)
            bk += 1
        diagonal = _factor(diagonal, size)
        store(lower, row + bi, diagonal)
        store(solution, bi, _substitute(block, diagonal, size, False))
        bi += 1
    return lower, solution


@dr.syntax
def backward(lower: list[Any], solution: list[Any], blocks: Any, size: int, held: int) -> list[Any]:
    """Solve L^T x = z in place; return ``solution``.

    All lanes start at tile row ``held``, not at their own ``blocks``, which avoids gathers.
    """
    past = mi.UInt32(held)
    while past > 0:
        row = past - 1
        if row < blocks:
            block = load(solution, row)
            bk = mi.UInt32(past)
            while bk < blocks:
                tile = load(lower, packed_count(bk) + row)
                block = _subtract_applied(block, tile, load(solution, bk), size, True)
                bk += 1
            diagonal = load(lower, packed_count(row) + row)
            store(solution, row, _substitute(block, diagonal, size, True))
        past -= 1
    return solution


@dr.syntax
def forward(lower: list[Any], solution: list[Any], blocks: Any, size: int) -> list[Any]:
    """Solve L z = b in place; return ``solution``."""
    bi = mi.UInt32(0)
    while bi < blocks:
        row = packed_count(bi)
        block = load(solution, bi)
        bk = mi.UInt32(0)
        while bk < bi:
            block = _subtract_applied(block, load(lower, row + bk), load(solution, bk), size, False)
            bk += 1
        diagonal = load(lower, row + bi)
        store(solution, bi, _substitute(block, diagonal, size, False))
        bi += 1
    return solution
