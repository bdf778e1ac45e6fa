"""Dual solver of Eq. 12: one unknown per visible view.

Solve M a = W f with M = W K W + I, K_ij = k(d_i . d_j), where k is the zonal kernel of
(lambda R)^-1. Then c = (lambda R)^-1 Y^T W a. If R_00 = 0, the constant is another, unpenalised
unknown: for u = W Y_00, c_00 = u^T M^-1 W f / u^T M^-1 u and a = M^-1 (W f - u c_00).

Double precision, because single precision has errors of 1e-3 of the spectrum for close views.
"""

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.core.local_memory import allocate, load, store
from svu_mi.frequency import cholesky, harmonics
from svu_mi.frequency.harmonics import FitSystem, ReadSample, normalized_double

TILE = 4
"""Edge of a tile. Fastest of 2 to 8: half of the 16 double precision values stay in registers."""

Y00 = 1 / math.sqrt(4 * math.pi)


def fit_dual(sample: ReadSample, views: Any, system: FitSystem, capacity: int) -> list[list[Any]]:
    """Fit the visible samples of each lane; return coefficients (see ``fit_lanes``)."""
    channels = system.channels
    free = system.ridge[0] == 0
    columns = channels + free
    held = -(-max(capacity, 1) // TILE)  # tile rows
    # Local arrays: x, y, z, w and values of the samples.
    types = [mi.Float64] * 4 + [mi.Float] * channels
    samples = [dr.alloc_local(Type, held * TILE) for Type in types]
    samples, count = _compact(sample, views, samples, held * TILE)
    blocks = (count + (TILE - 1)) // TILE
    _pad(samples, count, blocks)

    lower = allocate(mi.Float64, TILE * TILE, cholesky.packed_count(held))
    solution = allocate(mi.Float64, TILE * columns, held)
    lower, solution = cholesky.factor_and_forward(
        lower, solution, blocks, TILE,
        matrix=lambda bi, bj, diagonal: _kernel_tile(samples, bi, bj, diagonal, system),
        right=lambda bi: _dual_right(samples, bi, free),
    )  # fmt: skip
    constant = None
    if free:
        solution, constant = _free_constant(solution, blocks, [mi.Float64(0)] * channels)
        solution = [s for q, s in enumerate(solution) if q % columns < channels]
    solution = cholesky.backward(lower, solution, blocks, TILE, held)
    rows = allocate(mi.Float64, channels, held * TILE)
    rows = _weigh(samples, solution, rows, blocks)
    zero = [[mi.Float64(0) for _ in range(channels)] for _ in system.degrees]
    total = _sum_samples(samples[:3], rows, count, zero, system.basis)
    return _scale_coefficients(total, system, constant, count > 0)


@dr.syntax
def _compact(sample: ReadSample, views: Any, samples: list, capacity: int) -> tuple[list, Any]:
    """Store the visible samples of each lane consecutively; return them and their number."""
    count = mi.UInt32(0)
    view = mi.UInt32(0)
    while view < views:
        direction, weight, values = sample(view)
        held = (weight > 0) & (count < capacity)
        # Local memory treats an index of width 1 (a counter that starts from a literal) as uniform
        # over lanes. The select gives it the width of the lanes.
        slot = dr.select(held, count, 0)
        if held:
            store(samples, slot, [*normalized_double(direction), mi.Float64(weight), *values])
            count += 1
        view += 1
    return samples, count


def _pad(samples: list, count: Any, blocks: Any) -> None:
    """Fill the last tile row with samples of weight 0: rows of the identity in M."""
    for k in range(TILE - 1):
        inside = count + k < blocks * TILE
        for slot in samples:
            slot.write(0, count + k, inside)


def _kernel_tile(samples: list, bi: Any, bj: Any, diagonal: bool, system: FitSystem) -> list:
    """Return tile (bi, bj) of M = W K W + I; only its lower triangle if it is diagonal."""
    powers = harmonics.zonal_polynomial(system.degree, system.ridge[0] > 0)
    scale = dr.rcp(system.regularizer)

    def points(block: Any) -> list:
        read = [[s[block * TILE + i] for s in samples[:4]] for i in range(TILE)]
        return [(mi.Vector3d(x, y, z), w) for x, y, z, w in read]

    a = points(bi)
    b = a if diagonal else points(bj)
    tile = [mi.Float64(0)] * (TILE * TILE)
    for i in range(TILE):
        for j in range(i + 1 if diagonal else TILE):
            kernel = harmonics.zonal_kernel(dr.dot(a[i][0], b[j][0]), powers)
            tile[i * TILE + j] = kernel * (scale * a[i][1] * b[j][1])
        if diagonal:
            tile[i * TILE + i] += 1
    return tile


def _dual_right(samples: list, bi: Any, free: bool) -> list:
    """Return rows of W f; if the constant is unpenalised, with u = W Y_00 as last column."""
    out = []
    for i in range(TILE):
        weight, *values = (mi.Float64(s[bi * TILE + i]) for s in samples[3:])
        out += [weight * value for value in values] + [weight * Y00] * free
    return out


@dr.syntax
def _free_constant(solution: list, blocks: Any, products: list) -> tuple[list, list]:
    """Remove the constant term from a solution z of the dual system.

    Returns z - v c_00 and the term c_00 = v.z / v.v, with v = L^-1 u.
    """
    norm = type(products[0])(0)
    bi = mi.UInt32(0)
    while bi < blocks:
        norm, products = _project(load(solution, bi), norm, products)
        bi += 1
    constant = [dr.select(norm > 0, p / norm, 0) for p in products]
    bi = mi.UInt32(0)
    while bi < blocks:
        z = load(solution, bi)
        store(solution, bi, _remove_constant(z, constant))
        bi += 1
    return solution, constant


def _project(z: list, norm: Any, products: list) -> tuple[Any, list]:
    columns = len(products) + 1
    out = list(products)
    for i in range(TILE):
        row = z[i * columns : (i + 1) * columns]
        norm = dr.fma(row[-1], row[-1], norm)
        out = [dr.fma(row[-1], value, p) for p, value in zip(out, row[:-1], strict=True)]
    return norm, out


def _remove_constant(z: list, constant: list) -> list:
    columns = len(constant) + 1
    out = list(z)
    for i in range(TILE):
        v = z[i * columns + columns - 1]
        for c, c00 in enumerate(constant):
            out[i * columns + c] = dr.fma(-v, c00, out[i * columns + c])
    return out


@dr.syntax
def _weigh(samples: list, solution: list, rows: list, blocks: Any) -> list:
    """Write W a, one row per sample."""
    bi = mi.UInt32(0)
    while bi < blocks:
        _weigh_block(samples[3], load(solution, bi), rows, bi)
        bi += 1
    return rows


def _weigh_block(weights: Any, a: list, rows: list, bi: Any) -> None:
    for i in range(TILE):
        w = weights[bi * TILE + i]
        for c, row in enumerate(rows):
            row[bi * TILE + i] = w * a[i * len(rows) + c]


@dr.syntax
def _sum_samples(
    directions: list, rows: list, count: Any, total: list, basis: Callable[[list], list]
) -> list:
    """Add Y^T W a to ``total``, one sample at a time to avoid register spills."""
    row = mi.UInt32(0)
    while row < count:
        wa = load(rows, row)
        total = _add_outer(total, basis(load(directions, row)), wa)
        row += 1
    return total


def _add_outer(total: list, y: list, wa: list) -> list:
    return [[dr.fma(b, v, s) for v, s in zip(wa, sums, strict=True)]
            for b, sums in zip(y, total, strict=True)]  # fmt: skip


def _scale_coefficients(
    total: list, system: FitSystem, constant: list | None, seen: Any
) -> list[list[Any]]:
    """Return c = (lambda R)^-1 Y^T W a; unpenalised coefficients are ``constant``."""
    out = []
    for l, row in zip(system.degrees, total, strict=True):
        if system.ridge[l] > 0:
            scale = dr.rcp(system.ridge[l] * system.regularizer)
            c = [scale * value for value in row]
        else:
            c = list(constant or [])
        out.append([mi.Float(dr.select(seen, value, 0)) for value in c])
    return out
