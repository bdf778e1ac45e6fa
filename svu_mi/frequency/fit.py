"""Regularised spherical harmonic fit of scattered samples, one system per lane (Eq. 12).

    (Y^T W^2 Y + lambda R) c = Y^T W^2 f,    R = diag(e^l),    W = diag(w)

The paper penalises l = 0 as well (R_00 = 1), which leaks a constant signal into l > 0;
``penalize_constant=False`` leaves it free (R_00 = 0). Two equivalent ways to solve it:

* ``primal``: the (degree + 1)^2 normal equations. Any number of views, no memory for samples.
* ``dual``: one equation per *visible* view, M a = W f with M = W K W + I,
  K_ij = k(d_i . d_j), k the zonal kernel of (lambda R)^-1, and c = (lambda R)^-1 Y^T W a.
  With R_00 = 0 the constant is an extra unknown: with u = W Y_00,
  c_00 = u^T M^-1 W f / u^T M^-1 u and a = M^-1 (W f - u c_00).

Both are computed in double precision inside the kernel: lambda is a millionth of the trace of
Y^T W^2 Y for a few hundred views, and single precision then loses a degree altogether.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import cholesky, harmonics

TILE = 4
"""Edge of a tile in the dual."""

Method = Literal["primal", "dual"]
Sample = Callable[[Any], tuple[Any, Any, list[Any]]]
"""``view -> (direction, weight, values)``: see ``fit_lanes``."""

Y00 = 1 / math.sqrt(4 * math.pi)


@dataclass(frozen=True)
class _System:
    """What both ways of solving Eq. 12 need to know."""

    degree: int
    channels: int
    ridge: list[float]  # e^l, 0 where a degree is free
    regularizer: Any  # lambda, an opaque double: a new value must not mean a new kernel

    @property
    def degrees(self) -> list[int]:
        """The degree of every coefficient."""
        return [l for l in range(self.degree + 1) for _ in range(2 * l + 1)]


def fit_lanes(
    sample: Sample,
    views: Any,
    *,
    degree: int,
    channels: int,
    regularizer: float,
    penalize_constant: bool,
    method: Method,
    capacity: int,
) -> list[list[Any]]:
    """Fit Eq. 12 in every lane, inside the kernel that produces the samples.

    Args:
        sample: called once, while the loop over views is traced, with a UInt32 view index;
            returns the unit direction (Vector3f), the weight w of ``W = diag(w)`` (Float, 0
            where the lane does not see the view) and the values (``channels`` Floats). What
            it returns for a weight of 0 is not used.
        views: number of views, an opaque UInt32.
        degree: l*, in [0, 9].
        channels: number of right-hand sides; they share one factorisation.
        regularizer: lambda > 0.
        penalize_constant: R_00 = 1 as printed (True) or 0 (False).
        method: ``primal`` or ``dual``, the same to rounding. Dual is cheaper when a lane sees
            fewer views than there are coefficients.
        capacity: ``dual`` only: the most visible views a lane can hold; more are dropped.
            Local memory is about 4 capacity^2 bytes per lane.

    Returns:
        (degree + 1)^2 coefficients in the order l*l + l + m, each a list of ``channels``
        Floats; 0 in a lane that sees no view.
    """
    system = _System(
        degree=harmonics.check_degree(degree, "fit_lanes()"),
        channels=channels,
        ridge=harmonics.ridge(degree, penalize_constant),
        regularizer=dr.opaque(mi.Float64, regularizer),
    )
    if method == "dual":
        return _fit_dual(sample, views, system, capacity)
    return _fit_primal(sample, views, system)


# --- primal ----------------------------------------------------------------------------


def _fit_primal(sample: Sample, views: Any, system: _System) -> list[list[Any]]:
    """Accumulate the normal equations view by view, then solve them in place."""
    count = (system.degree + 1) ** 2
    size = system.degree + 1  # tiles of this edge fill the matrix without padding
    blocks = dr.opaque(mi.UInt32, count // size)
    memory = cholesky.packed_count(count // size)
    gram = cholesky.allocate(mi.Float64, size * size, memory)
    right = cholesky.allocate(mi.Float64, size * system.channels, count // size)
    rows = cholesky.allocate(mi.Float64, size, count // size)
    gram, right = _clear(gram, right, dr.opaque(mi.UInt32, memory), blocks)
    _add_ridge(gram, system, size)
    gram, right, seen = _accumulate(sample, views, gram, right, rows, blocks, system.degree)
    gram, right = cholesky.factor_and_forward(gram, right, blocks, size)
    right = cholesky.backward(gram, right, blocks, size)
    return [
        [
            dr.select(seen, mi.Float(right[i % size * system.channels + c][i // size]), 0)
            for c in range(system.channels)
        ]
        for i in range(count)
    ]


@dr.syntax
def _clear(gram: list, right: list, tiles: Any, blocks: Any) -> tuple[list, list]:
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


def _add_ridge(gram: list, system: _System, size: int) -> None:
    """Write lambda R on the diagonal."""
    for i, l in enumerate(system.degrees):
        tile = cholesky.packed_count(i // size) + i // size
        gram[i % size * (size + 1)][tile] = system.ridge[l] * system.regularizer


@dr.syntax
def _accumulate(
    sample: Sample, views: Any, gram: list, right: list, rows: list, blocks: Any, degree: int
) -> tuple[list, list, Any]:
    """Add Y^T W^2 Y and Y^T W^2 f, and say which lanes saw anything."""
    size = len(rows)
    seen = mi.Bool(False)
    view = mi.UInt32(0)
    while view < views:
        direction, weight, values = sample(view)
        if weight > 0:
            _write_row(rows, direction, weight, degree)
            scaled = [mi.Float64(weight) * mi.Float64(value) for value in values]
            I = mi.UInt32(0)
            while I < blocks:
                a = cholesky.load(rows, I)
                J = mi.UInt32(0)
                while J <= I:
                    tile = cholesky.packed_count(I) + J
                    b = cholesky.load(rows, J)
                    cholesky.store(gram, tile, _add_outer(cholesky.load(gram, tile), a, b))
                    J += 1
                cholesky.store(right, I, _add_outer(cholesky.load(right, I), a, scaled))
                I += 1
            seen |= True
        view += 1
    return gram, right, seen


def _write_row(rows: list, direction: Any, weight: Any, degree: int) -> None:
    """Write w Y_lm(d) of one sample as blocks of len(rows)."""
    y = harmonics.basis(mi.Vector3d(direction), degree)
    for i, value in enumerate(y):
        rows[i % len(rows)][i // len(rows)] = mi.Float64(weight) * value


def _add_outer(tile: list, a: list, b: list) -> list:
    """Return tile + a b^T."""
    return [dr.fma(a[q // len(b)], b[q % len(b)], value) for q, value in enumerate(tile)]


# --- dual ------------------------------------------------------------------------------


def _fit_dual(sample: Sample, views: Any, system: _System, capacity: int) -> list[list[Any]]:
    """Compact the visible samples of the lane, solve for them, and go back to coefficients."""
    free = system.ridge[0] == 0
    columns = system.channels + free
    size = TILE
    held = -(-max(capacity, 1) // size)  # tile rows
    # One local array per number of a sample: x, y, z, w, values.
    samples = [dr.alloc_local(mi.Float, held * size) for _ in range(4 + system.channels)]
    samples, count = _compact(sample, views, samples, held * size)
    blocks = (count + (size - 1)) // size
    _pad(samples, count, blocks, size)

    lower = cholesky.allocate(mi.Float64, size * size, cholesky.packed_count(held))
    solution = cholesky.allocate(mi.Float64, size * columns, held)
    lower, solution = cholesky.factor_and_forward(
        lower, solution, blocks, size,
        matrix=lambda I, J, diagonal: _kernel_tile(samples, I, J, diagonal, system),
        right=lambda I: _dual_right(samples, I, free, system.channels),
    )  # fmt: skip
    constant = None
    if free:
        solution, constant = _free_constant(solution, blocks, system.channels)
        solution = [s for q, s in enumerate(solution) if q % columns < system.channels]
    solution = cholesky.backward(lower, solution, blocks, size)
    total = _sum_samples(samples, solution, blocks, system.degree, system.channels)
    return _scale_coefficients(total, system, constant, count > 0)


@dr.syntax
def _compact(
    sample: Sample, views: Any, samples: list, capacity: int
) -> tuple[list, Any]:
    """Store the visible samples of each lane one after the other."""
    count = mi.UInt32(0)
    view = mi.UInt32(0)
    while view < views:
        direction, weight, values = sample(view)
        if (weight > 0) & (count < capacity):
            cholesky.store(samples, count, [*direction, weight, *values])
            count += 1
        view += 1
    return samples, count


def _pad(samples: list, count: Any, blocks: Any, size: int) -> None:
    """Fill the last tile row with samples of weight 0: rows of the identity in M."""
    for k in range(size - 1):
        inside = count + k < blocks * size
        for slot in samples:
            slot.write(mi.Float(0), count + k, inside)


def _kernel_tile(samples: list, I: Any, J: Any, diagonal: bool, system: _System) -> list:
    """Return tile (I, J) of M = W K W + 1; only its lower triangle if it is diagonal."""
    size = TILE
    weights = harmonics.zonal_weights(system.degree, system.ridge[0] > 0)
    scale = dr.rcp(system.regularizer)

    def points(block: Any) -> list:
        read = [[mi.Float64(s[block * size + i]) for s in samples[:4]] for i in range(size)]
        return [(mi.Vector3d(x, y, z), w) for x, y, z, w in read]

    a = points(I)
    b = a if diagonal else points(J)
    tile = [mi.Float64(0)] * (size * size)
    for i in range(size):
        for j in range(i + 1 if diagonal else size):
            kernel = harmonics.zonal_kernel(dr.dot(a[i][0], b[j][0]), weights)
            tile[i * size + j] = kernel * (scale * a[i][1] * b[j][1])
        if diagonal:
            tile[i * size + i] += 1
    return tile


def _dual_right(samples: list, I: Any, free: bool, channels: int) -> list:
    """Return rows of W f and, if the constant is free, of u = W Y_00 as the last column."""
    out = []
    for i in range(TILE):
        weight, *values = (mi.Float64(s[I * TILE + i]) for s in samples[3:])
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
    I = mi.UInt32(0)
    while I < blocks:
        norm, products = _project(cholesky.load(solution, I), norm, products)
        I += 1
    constant = [dr.select(norm > 0, p / norm, 0) for p in products]
    I = mi.UInt32(0)
    while I < blocks:
        z = cholesky.load(solution, I)
        cholesky.store(solution, I, _remove_constant(z, constant, columns))
        I += 1
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
def _sum_samples(
    samples: list, solution: list, blocks: Any, degree: int, channels: int
) -> list:
    """Return Y^T W a, channels of one coefficient next to each other."""
    total = [mi.Float64(0) for _ in range((degree + 1) ** 2 * channels)]
    I = mi.UInt32(0)
    while I < blocks:
        total = _add_samples(total, samples, cholesky.load(solution, I), I, degree)
        I += 1
    return total


def _add_samples(total: list, samples: list, a: list, I: Any, degree: int) -> list:
    channels = len(a) // TILE
    out = list(total)
    for i in range(TILE):
        x, y, z, w = (mi.Float64(s[I * TILE + i]) for s in samples[:4])
        basis = harmonics.basis(mi.Vector3d(x, y, z), degree)
        wa = [w * value for value in a[i * channels : (i + 1) * channels]]
        out = [dr.fma(basis[q // channels], wa[q % channels], out[q]) for q in range(len(out))]
    return out


def _scale_coefficients(
    total: list, system: _System, constant: list | None, seen: Any
) -> list[list[Any]]:
    """c = (lambda R)^-1 Y^T W a; the constant itself where it is free."""
    channels, out = system.channels, []
    for i, l in enumerate(system.degrees):
        row = total[i * channels : (i + 1) * channels]
        if system.ridge[l] > 0:
            row = [value / (system.ridge[l] * system.regularizer) for value in row]
        else:
            row = list(constant)
        out.append([mi.Float(dr.select(seen, value, 0)) for value in row])
    return out
