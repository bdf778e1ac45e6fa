"""Entropy of a grid, row by row in one kernel, without stored probabilities.

A row is a bin of the parameters that all channels share (roughness and metallic, or roughness).
Bins of a row differ in the last parameter (base colour or Ks). Each group of channels has a
separate value of the last parameter, independent of the other groups given the row. The entropy is
computed over (row, last parameter) for each group and averaged.
"""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.errors import OptionError, ShapeError

FAR = 1e4  # upper bound of relative energies: exp(-FAR) is 0, and FAR * 0 is not NaN
IMPOSSIBLE = 1e200  # energy of a bin that the prior excludes: above any other, and finite

RowEnergies = Callable[[Any], list[tuple[Any, list[Any]]]]
"""Row index -> for each group, the smallest energy (Float64) and all energies relative to it."""


def entropy(row_energies: RowEnergies, count: int, rows: Any, total: int) -> Any:
    """Return the entropy of Eq. 5 relative to log ``total``, (T,) in [0, 1].

    Energies are relative to the smallest one so far; sums are rescaled when a smaller one follows.
    """
    last = dr.opaque(mi.UInt32, dr.width(rows))

    def body(place: Any, low: Any, z: Any, zx: Any) -> tuple[Any, ...]:
        row = dr.gather(mi.UInt32, rows, place)
        base, weight, excess = _combine(row_energies(row))
        lowest = dr.minimum(low, base)
        # On the first row, exp(-FAR) = 0 resets the sums.
        drop = mi.Float(dr.minimum(low - lowest, FAR))
        rise = mi.Float(dr.minimum(base - lowest, FAR))
        old, new = dr.exp(-drop), dr.exp(-rise) * weight
        zx = old * dr.fma(drop, z, zx) + new * (rise + excess)
        return place + 1, lowest, dr.fma(old, z, new), zx

    sums = (dr.zeros(mi.Float, count) for _ in range(2))
    _, z, zx = fold(0, last, body, dr.full(mi.Float64, 1e300, count), *sums)
    return dr.clip(nats(z, zx) / float(np.log(total)), 0, 1)


def nats(z: Any, zx: Any) -> Any:
    """Return the entropy log Z + sum p x [nats] of p = exp(-x) / Z; zx = sum exp(-x) x."""
    return (dr.log if dr.is_array_v(z) else np.log)(z) + zx / z


def entropy_of(p: np.ndarray) -> float:
    """Return the entropy of probabilities [nats]."""
    return float(-(p * np.log(np.where(p > 0, p, 1))).sum())


def _combine(groups: list[tuple[Any, list[Any]]]) -> tuple[Any, Any, Any]:
    """Return base energy (Float64), weight w and excess of a row with groups g.

    With z_g = sum exp(-(x - min x)) and w = prod z_g, the mass of the row is w exp(-base). The
    entropy is log Z + sum over rows of p(row) (base + excess), with
    excess = mean_g (log z_g + mean of (x - min x)) - log w.
    """
    base, weight, excess = mi.Float64(0), mi.Float(1), mi.Float(0)
    for low, offsets in groups:
        terms = [dr.exp(-x) for x in offsets]
        z = sum(terms)
        zx = sum(x * term for x, term in zip(offsets, terms, strict=True))
        base += low
        weight *= z
        excess += zx / z
    if len(groups) > 1:
        excess = (excess - (len(groups) - 1) * dr.log(weight)) / len(groups)
    return base, weight, excess


def with_prior(
    energies: list[list[Any]], prior: tuple[Any, Any] | None, row: Any
) -> list[tuple[Any, list[Any]]]:
    """Add -log prior; return each group's smallest energy and all energies relative to it."""
    if prior is None:
        return [above_smallest(x) for x in energies]
    of_row, of_bin = prior
    groups = []
    for x in energies:
        place = row * len(x)
        known = [dr.gather(type(of_bin), of_bin, place + j) for j in range(len(x))]
        groups.append(above_smallest([a + b for a, b in zip(x, known, strict=True)]))
    low, offsets = groups[0]
    return [(low + dr.gather(mi.Float64, of_row, row), offsets), *groups[1:]]


def above_smallest(energies: list[Any]) -> tuple[Any, list[Any]]:
    """Return the smallest energy (Float64), and all energies relative to it (Float)."""
    low = energies[0]
    for x in energies[1:]:
        low = dr.minimum(low, x)
    return mi.Float64(low), [mi.Float(dr.minimum(x - low, FAR)) for x in energies]


def energy_tables(
    energies_of: Callable[[Any], RowEnergies], chosen: np.ndarray, rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return row minima (t, rows), float64, and energies (t, rows, G, bins) relative to them."""
    count = len(chosen)
    lane = dr.arange(mi.UInt32, count * rows)
    place = lane // dr.opaque(mi.UInt32, rows)
    texel = dr.gather(mi.UInt32, to_drjit(mi.UInt32, chosen), place)
    groups = energies_of(texel)(lane - place * rows)
    base = sum(low for low, _ in groups)
    columns = [offset for _, offsets in groups for offset in offsets]
    dr.eval(base, columns)
    table = np.stack([np.broadcast_to(c.numpy(), count * rows) for c in columns], axis=-1)
    return (
        np.broadcast_to(base.numpy(), count * rows).reshape(count, rows),
        table.reshape(count, rows, len(groups), -1),
    )


def probabilities(
    base: np.ndarray, offsets: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return bin probabilities, (t, *shape, G) float32, and best nodes, (t, axes, G) int64.

    ``base`` is the smallest energy of each row, (t, rows); ``offsets``, (t, rows, G, bins), are
    energies relative to it.
    """
    # p(row) p(bin | row) for each group, because groups are independent given the row.
    terms = np.exp(-np.swapaxes(offsets, 2, 3))
    z = terms.sum(axis=2)
    weight = np.exp(base.min(axis=1, keepdims=True) - base) * z.prod(axis=-1, dtype=np.float64)
    weight /= weight.sum(axis=1, keepdims=True)
    p = weight[:, :, None, None] * (terms / z[:, :, None])
    row = base.argmin(axis=1)
    bin_index = offsets[np.arange(len(row)), row].argmin(axis=-1)
    shared = np.unravel_index(row, shape[:-1])
    best = [np.broadcast_to(node[:, None], bin_index.shape) for node in shared]
    count = len(base)
    return (
        p.reshape(count, *shape, -1).astype(np.float32),
        np.stack([*best, bin_index], axis=1).astype(np.int64),
    )


def log_prior(
    prior: Any | None, shape: tuple[int, ...], caller: str
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return -log prior of rows, (rows,), and of bins given their row, (rows * bins,).

    ``prior`` are weights in the grid's ``shape`` or of its first axis. None (uniform) gives None.
    """
    if prior is None:
        return None
    weights = _numbers(prior, shape, caller)
    if weights.shape == shape[:1]:
        weights = np.broadcast_to(weights.reshape(-1, *(1,) * (len(shape) - 1)), shape)
    if weights.shape != shape:
        raise ShapeError(
            f"{caller}: the prior must be {shape} or ({shape[0]},), got {weights.shape}."
        )
    if not (np.isfinite(weights).all() and (weights >= 0).all() and weights.sum() > 0):
        raise OptionError(f"{caller}: the prior must be finite, non-negative and not all zero.")
    weights = weights.reshape(-1, shape[-1])
    row = weights.sum(axis=1)
    with np.errstate(divide="ignore"):
        given = np.where(row[:, None] > 0, weights / np.maximum(row[:, None], 1e-300), 1.0)
        # Finite, because infinity times 0 is NaN.
        return (
            np.minimum(-np.log(row / row.sum()), IMPOSSIBLE),
            np.minimum(-np.log(given), IMPOSSIBLE).ravel(),
        )


def _numbers(prior: Any, shape: tuple[int, ...], caller: str) -> np.ndarray:
    """Convert the prior's weights to float64; raise an error if they are not numbers."""
    try:
        weights = np.asarray(prior)
        if weights.dtype.kind not in "fiub":  # NumPy would parse text and drop imaginary parts
            raise TypeError
        return weights.astype(np.float64)
    except (TypeError, ValueError):
        raise OptionError(
            f"{caller}: the prior must be numbers, {shape} or ({shape[0]},), got a "
            f"{type(prior).__name__}."
        ) from None


def prior_table(tables: tuple[Any, Any] | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return bin probabilities, float64 of ``shape``, from ``log_prior`` tables."""
    if tables is None:
        return np.full(shape, 1 / np.prod(shape))
    of_row, of_bin = (np.array(table, np.float64) for table in tables)
    p = np.exp(-of_row)[:, None] * np.exp(-of_bin.reshape(len(of_row), -1))
    return np.asarray(p / p.sum()).reshape(shape)


def axis_value(kind: Any, nodes: np.ndarray, index: Any) -> Any:
    """Return evenly spaced nodes at indices (UInt32) as ``kind``, Float or Float64."""
    if len(nodes) == 1:  # read from memory: with a literal, each known value compiles a new kernel
        return dr.gather(kind, to_drjit(kind, nodes), index)
    return dr.fma(kind(index), float(nodes[1] - nodes[0]), float(nodes[0]))


def row_values(kind: Any, axes: list[np.ndarray], index: Any) -> list[Any]:
    """Return the nodes of a row on each axis, as ``kind``; the last axis is fastest."""
    values = []
    for axis in axes[:0:-1]:
        index, place = index // len(axis), index % len(axis)
        values.append(axis_value(kind, axis, place))
    return [axis_value(kind, axes[0], index), *values[::-1]]


def bin_values(nodes: np.ndarray) -> list[Any]:
    """Return the nodes of a row's bins: literals, or an opaque value for a single node."""
    return nodes.tolist() if len(nodes) > 1 else [dr.opaque(mi.Float64, nodes[0])]


def possible_rows(tables: tuple[np.ndarray, np.ndarray] | None, rows: int) -> Any:
    """Return the rows that ``log_prior`` tables do not exclude: UInt32."""
    kept = np.arange(rows) if tables is None else np.flatnonzero(tables[0] < IMPOSSIBLE)
    return to_drjit(mi.UInt32, kept.astype(np.uint32))
