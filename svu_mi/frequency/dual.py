"""Eq. 12 in its dual form: one unknown per visible view.

M a = W f with M = W K W + I, K_ij = k(d_i . d_j) and k the zonal kernel of (lambda R)^-1;
then c = (lambda R)^-1 Y^T W a. With R_00 = 0 the constant is an extra, unpenalised unknown:
for u = W Y_00, c_00 = u^T M^-1 W f / u^T M^-1 u and a = M^-1 (W f - u c_00).
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import cholesky, harmonics
from svu_mi.frequency.system import Sample, System, unit

TILE = 4
"""Edge of a tile: 16 double precision values stay in registers while it is updated."""

Y00 = 1 / math.sqrt(4 * math.pi)


def fit_dual(sample: Sample, views: Any, system: System, capacity: int) -> list[list[Any]]:
    """Compact the visible samples of the lane, solve for them, and go back to coefficients."""
    free = system.ridge[0] == 0
    columns = system.channels + free
    size = TILE
    held = -(-max(capacity, 1) // size)  # tile rows
    # One local array per number of a sample: x, y, z, w, values.
    types = [mi.Float64] * 4 + [mi.Float] * system.channels
    samples = [dr.alloc_local(Type, held * size) for Type in types]
    samples, count = _compact(sample, views, samples, held * size)
    blocks = (count + (size - 1)) // size
    _pad(samples, count, blocks, size)

    lower = cholesky.allocate(mi.Float64, size * size, cholesky.packed_count(held))
    solution = cholesky.allocate(mi.Float64, size * columns, held)
    lower, solution = cholesky.factor_and_forward(
        lower, solution, blocks, size,
        matrix=lambda bi, bj, diagonal: _kernel_tile(samples, bi, bj, diagonal, system),
        right=lambda bi: _dual_right(samples, bi, free),
    )  # fmt: skip
    constant = None
    if free:
        solution, constant = _free_constant(solution, blocks, system.channels)
        solution = [s for q, s in enumerate(solution) if q % columns < system.channels]
    solution = cholesky.backward(lower, solution, blocks, size)
    total = _sum_samples(samples, solution, blocks, system.degree, system.channels)
    return _scale_coefficients(total, system, constant, count > 0)


@dr.syntax
def _compact(sample: Sample, views: Any, samples: list, capacity: int) -> tuple[list, Any]:
    """Store the visible samples of each lane one after the other."""
    count = mi.UInt32(0)
    view = mi.UInt32(0)
    while view < views:
        direction, weight, values = sample(view)
        held = (weight > 0) & (count < capacity)
        # Local memory takes an index of width 1 (such as a counter that starts from a literal)
        # for the same in all lanes; the select gives it the width of the lanes.
        slot = dr.select(held, count, 0)
        _append(samples, slot, [*unit(direction), mi.Float64(weight), *values], held)
        count += dr.select(held, mi.UInt32(1), mi.UInt32(0))
        view += 1
    return samples, count


def _append(samples: list, index: Any, numbers: list, held: Any) -> None:
    for memory, number in zip(samples, numbers, strict=True):
        memory.write(number, index, held)


def _pad(samples: list, count: Any, blocks: Any, size: int) -> None:
    """Fill the last tile row with samples of weight 0: rows of the identity in M."""
    for k in range(size - 1):
        inside = count + k < blocks * size
        for slot in samples:
            slot.write(0, count + k, inside)


def _kernel_tile(samples: list, bi: Any, bj: Any, diagonal: bool, system: System) -> list:
    """Return tile (bi, bj) of M = W K W + 1; only its lower triangle if it is diagonal."""
    size = TILE
    weights = harmonics.zonal_weights(system.degree, system.ridge[0] > 0)
    scale = dr.rcp(system.regularizer)

    def points(block: Any) -> list:
        read = [[s[block * size + i] for s in samples[:4]] for i in range(size)]
        return [(mi.Vector3d(x, y, z), w) for x, y, z, w in read]

    a = points(bi)
    b = a if diagonal else points(bj)
    tile = [mi.Float64(0)] * (size * size)
    for i in range(size):
        for j in range(i + 1 if diagonal else size):
            kernel = harmonics.zonal_kernel(dr.dot(a[i][0], b[j][0]), weights)
            tile[i * size + j] = kernel * (scale * a[i][1] * b[j][1])
        if diagonal:
            tile[i * size + i] += 1
    return tile


def _dual_right(samples: list, bi: Any, free: bool) -> list:
    """Return rows of W f and, if the constant is free, of u = W Y_00 as the last column."""
    out = []
    for i in range(TILE):
        weight, *values = (mi.Float64(s[bi * TILE + i]) for s in samples[3:])
        out += [weight * value for value in values] + [weight * Y00] * free
    return out


@dr.syntax
def _free_constant(solution: list, blocks: Any, channels: int) -> tuple[list, list]:
    """Solve for the unpenalised c_00 and take it out of the right-hand sides.

    With z = L^-1 W f and v = L^-1 u: c_00 = v.z / v.v, and W f - u c_00 becomes z - v c_00.
    """
    columns = channels + 1
    norm = mi.Float64(0)
    products = [mi.Float64(0) for _ in range(channels)]
    bi = mi.UInt32(0)
    while bi < blocks:
        norm, products = _project(cholesky.load(solution, bi), norm, products)
        bi += 1
    constant = [dr.select(norm > 0, p / norm, 0) for p in products]
    bi = mi.UInt32(0)
    while bi < blocks:
        z = cholesky.load(solution, bi)
        cholesky.store(solution, bi, _remove_constant(z, constant, columns))
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


def _remove_constant(z: list, constant: list, columns: int) -> list:
    out = list(z)
    for i in range(TILE):
        v = z[i * columns + columns - 1]
        for c, c00 in enumerate(constant):
            out[i * columns + c] = dr.fma(-v, c00, out[i * columns + c])
    return out


@dr.syntax
def _sum_samples(samples: list, solution: list, blocks: Any, degree: int, channels: int) -> list:
    """Return Y^T W a, channels of one coefficient next to each other."""
    total = [mi.Float64(0) for _ in range((degree + 1) ** 2 * channels)]
    bi = mi.UInt32(0)
    while bi < blocks:
        total = _add_samples(total, samples, cholesky.load(solution, bi), bi, degree)
        bi += 1
    return total


def _add_samples(total: list, samples: list, a: list, bi: Any, degree: int) -> list:
    channels = len(a) // TILE
    out = list(total)
    for i in range(TILE):
        x, y, z, w = (s[bi * TILE + i] for s in samples[:4])
        basis = harmonics.basis(mi.Vector3d(x, y, z), degree)
        wa = [w * value for value in a[i * channels : (i + 1) * channels]]
        out = [dr.fma(basis[q // channels], wa[q % channels], out[q]) for q in range(len(out))]
    return out


def _scale_coefficients(
    total: list, system: System, constant: list | None, seen: Any
) -> list[list[Any]]:
    """c = (lambda R)^-1 Y^T W a; the constant itself where it is free."""
    channels, out = system.channels, []
    for i, l in enumerate(system.degrees):
        row = total[i * channels : (i + 1) * channels]
        if system.ridge[l] > 0:
            row = [value / (system.ridge[l] * system.regularizer) for value in row]
        else:
            row = list(constant or [])
        out.append([mi.Float(dr.select(seen, value, 0)) for value in row])
    return out
