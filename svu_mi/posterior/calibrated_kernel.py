"""Integrals over the parameters of a texel: entropy, moments, marginals, probabilities, draws.

Each is one walk over the nodes of all but base colour (``walk``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.parameters import MIXED
from svu_mi.posterior.nodes import Axis
from svu_mi.posterior.problem import Problem
from svu_mi.posterior.walk import Node, Walker
from svu_mi.statistics.blocks import BLOCK, size, start

SPAN = 2**17  # texels at a time, of whose nodes the masses are in memory


def spans(count: int) -> Iterator[slice]:
    """Yield the numbers from 0 to ``count``, ``SPAN`` at a time."""
    for first in range(0, count, SPAN):
        yield slice(first, min(first + SPAN, count))


def least(problem: Problem, *, excess: bool = False) -> Any:
    """Return the energy of the best node, (S,) Float.

    Args:
        problem: of S texels.
        excess: what it has, prior included, above ``problem.least``, which else is not used.
    """
    walker, columns = Walker(problem), dr.opaque(mi.UInt32, problem.mixed.count)
    nodes = dr.opaque(mi.UInt32, problem.roughness.count)

    def of_row(row: Any, best: Any) -> tuple[Any, Any]:
        U = walker.entries(row)

        def of_column(column: Any, best: Any) -> tuple[Any, Any]:
            if excess:
                return column + 1, walker.excess(U, row, column, best)
            return column + 1, dr.minimum(best, walker.energy(U, column))

        inner = dr.while_loop((mi.UInt32(0), best), lambda k, _: k < columns, of_column)
        return row + 1, inner[1]

    start = dr.full(mi.Float, dr.inf, problem.factors.count)
    best = dr.while_loop((mi.UInt32(0), start), lambda row, _: row < nodes, of_row)[1]
    dr.eval(best)
    return best


@dataclass(frozen=True)
class Summary:
    """What is asked of every texel.

    Attributes:
        entropy: (S,) Float, nats, of the masses of the cells; the mean over channels.
        total: (S,) Float, integral of the posterior before it is normalised.
        mean, sd: Floats (S,) of roughness, the parameters that mix, and the base colour of every
            channel.
        best: (S,) UInt32, which of the R M cells of all but base colour has most mass, the first
            of several.
        best_colors: UInt32s (S,), which of K is that of every channel's base colour, given that.
        rows, columns: Floats in blocks (statistics/blocks.py), not normalised: the masses of N
            nodes of roughness, and of L columns; None where more than ``SPAN`` texels are summed
            up, of which they would take more than all else.
    """

    entropy: Any
    total: Any
    mean: list[Any]
    sd: list[Any]
    best: Any
    best_colors: list[Any]
    rows: Any | None
    columns: Any | None

    @staticmethod
    def joined(parts: list[Summary]) -> Summary:
        """Return what is asked of the texels of all parts, without the masses of nodes."""

        def all_of(name: str) -> Any:
            columns = zip(*(getattr(part, name) for part in parts), strict=True)
            return [dr.concat(list(column)) for column in columns]

        entropy, total, best = (
            dr.concat([getattr(part, name) for part in parts])
            for name in ("entropy", "total", "best")
        )
        mean, sd, best_colors = (all_of(name) for name in ("mean", "sd", "best_colors"))
        dr.eval(entropy, total, mean, sd, best, best_colors)
        return Summary(entropy, total, mean, sd, best, best_colors, None, None)

    def masses(self, problem: Problem, name: str) -> Any:
        """Return the masses of the nodes of a parameter that is walked over, in blocks."""
        assert self.rows is not None and self.columns is not None
        if name not in MIXED:
            return self.rows
        which, shape = MIXED.index(name), problem.mixed.shape
        if shape[which] == problem.mixed.count:
            return self.columns  # there is nothing else to sum over
        table = self.columns.numpy().reshape(-1, *shape, BLOCK)
        others = tuple(1 + k for k in range(len(shape)) if k != which)
        return owned(mi.Float, table.sum(axis=others).ravel())


def summarize(problem: Problem) -> Summary:
    """Sum all texels up."""
    count = problem.factors.count
    if count <= SPAN:
        return summary_of(problem, dr.arange(mi.UInt32, count))
    parts = []
    for span in spans(count):
        first = dr.opaque(mi.UInt32, span.start)
        lanes = dr.arange(mi.UInt32, span.stop - span.start) + first
        parts.append(replace(summary_of(problem, lanes), rows=None, columns=None))
    return Summary.joined(parts)


def summary_of(problem: Problem, lanes: Any) -> Summary:
    """Walk once over all nodes of some texels.

    Args:
        problem: of S texels.
        lanes: UInt32, which of them; no more than ``SPAN``.
    """
    walker, count = Walker(problem, lanes), dr.width(lanes)
    channels, nodes = problem.factors.channels, problem.nodes
    rows, columns = problem.roughness.count, problem.mixed.count
    _, of_column, of_color = problem.shape
    cells = of_column * channels * of_color
    masses = cleared(cells + columns)
    first = dr.opaque(mi.UInt32, cells)  # of the columns, behind the cells
    by_row, by_column = (dr.zeros(mi.Float, size(n, count)) for n in (rows, columns))
    dr.eval(by_row, by_column)
    launch = dr.arange(mi.UInt32, count)
    place = start(launch, dr.opaque(mi.UInt32, rows))
    moments = 2 * (len(nodes.columns) + channels)
    ahead = moments + 3  # sums in double precision, before all else

    def visit(node: Node, masses: Any, of_row: Any, *sums: Any) -> tuple[Any, ...]:
        _add_cells(problem, masses, node)
        masses[first + node.column] = masses[first + node.column] + node.weight
        w = mi.Float64(node.weight)
        added = [x for values in nodes.columns for x in values.moments(node.column)]
        for color in node.colors:
            mean = mi.Float64(color.mean)
            added += [mean, dr.fma(mean, mean, mi.Float64(color.variance))]
        sums = tuple(dr.fma(w, x, old) for x, old in zip(added, sums, strict=True))
        return (masses, of_row + node.weight, *sums)

    def row_ends(row: Any, masses: Any, of_row: Any, *state: Any) -> tuple[Any, ...]:
        (*sums, total, r1, r2), found = state[:ahead], state[ahead:]
        dr.scatter(by_row, of_row, place + row * BLOCK, mode=dr.ReduceMode.NoConflicts)
        w = mi.Float64(of_row)
        mean, square = nodes.rows.moments(row)
        closed = _close(problem, masses, row, *found)
        return (closed[0], mi.Float(0), *sums, total + w, dr.fma(w, mean, r1),
                dr.fma(w, square, r2), *closed[1:])  # fmt: skip

    def visit_all(node: Node, masses: Any, of_row: Any, *state: Any) -> tuple[Any, ...]:
        return (*visit(node, masses, of_row, *state[:moments]), *state[moments:])

    masses, _, *state = walker.over_rows(
        mi.UInt32(0), dr.opaque(mi.UInt32, rows), visit_all, row_ends,
        (masses, dr.zeros(mi.Float, count), *(dr.zeros(mi.Float64, count) for _ in range(ahead)),
         *(dr.zeros(mi.Float, count) for _ in range(2)),
         *(dr.zeros(mi.UInt32, count) for _ in range(1 + channels))),
    )  # fmt: skip
    (*summed, total, r1, r2), (zx, _, best, *best_colors) = state[:ahead], state[ahead:]
    by_column = _write(masses, first, columns, launch, by_column)
    total = dr.select(total > 0, total, 1)
    sums = [r1, r2, *summed]
    mean = [x / total for x in sums[::2]]
    sd = [dr.sqrt(dr.maximum(x / total - dr.square(m), 0))
          for x, m in zip(sums[1::2], mean, strict=True)]  # fmt: skip
    mean, sd = [mi.Float(x) for x in mean], [mi.Float(x) for x in sd]
    total = mi.Float(total)
    entropy = dr.log(total) - zx / (total * channels)
    dr.eval(entropy, total, mean, sd, best, best_colors, by_row, by_column)
    return Summary(entropy, total, mean, sd, best, best_colors, by_row, by_column)


def tables(problem: Problem, chosen: np.ndarray) -> np.ndarray:
    """Return the masses of all cells of a few texels, for everything that is not the hot path.

    Args:
        problem: of S texels.
        chosen: (t,) int64, which of them.

    Returns:
        (t, R, M, K, C) float32, of sum 1 for every texel and channel, the others marginalised.
    """
    rows, of_column, of_color = problem.shape
    shape = (len(chosen), rows, of_column, problem.factors.channels, of_color)
    found = _cell_masses(problem, chosen).numpy().reshape(shape)
    total = found.sum(axis=(1, 2, 4), keepdims=True, dtype=np.float64)
    found = found * (1 / np.where(total > 0, total, 1)).astype(np.float32)
    return np.moveaxis(found, 3, 4)


def rows(problem: Problem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum ``tables`` over base colour, without making them.

    Args:
        problem: of S texels.
        chosen: (t,) int64, which of them.

    Returns:
        The masses of all N = R M cells of all but base colour, (t, N) float64, and the colour that
        stands for each (``cells.color_of_rows``), (t, N, C) float64.
    """
    (levels, of_column, of_color), channels = problem.shape, problem.factors.channels
    masses, first = _walked(problem, chosen)
    number = len(chosen) * levels * of_column
    mass, colors = dr.empty(mi.Float64, number), dr.empty(mi.Float, number * channels)
    end, mode = dr.opaque(mi.UInt32, of_column), dr.ReduceMode.NoConflicts

    def write(column: Any, masses: Any) -> tuple[Any, Any]:
        row = first * of_column + column
        for channel in range(channels):
            place = (column * channels + channel) * of_color
            p = [masses[place + k] for k in range(of_color)]
            dr.scatter(colors, _standing(p, problem.edges), row * channels + channel, mode=mode)
            if channel == 0:  # all channels have the same
                dr.scatter(mass, sum(mi.Float64(one) for one in p), row, mode=mode)
        return column + 1, masses

    dr.while_loop((mi.UInt32(0), masses), lambda column, _: column < end, write)
    dr.eval(mass, colors)
    found = mass.numpy().reshape(len(chosen), -1)
    total = found.sum(axis=1, keepdims=True)
    shape = (*found.shape, channels)
    return found / np.where(total > 0, total, 1), colors.numpy().reshape(shape).astype(np.float64)


def _standing(p: list[Any], edges: np.ndarray) -> Any:
    """Return what ``cells.color_of_rows`` does, of the K cells of a row and channel: Float."""
    middle = ((edges[1:] + edges[:-1]) / 2).tolist()
    mean = sum(one * c for one, c in zip(p, middle, strict=True)) / dr.maximum(sum(p), 1e-30)
    there, most, best = p[0], p[0], mi.Float(middle[0])
    for one, low, c in zip(p[1:], edges[1:-1].tolist(), middle[1:], strict=True):
        there = dr.select(mean >= low, one, there)
        most, best = dr.maximum(most, one), dr.select(one > most, mi.Float(c), best)
    return dr.select(there > 0, mean, best)


def _cell_masses(problem: Problem, chosen: np.ndarray) -> Any:
    """Return the masses of all cells of some texels, not normalised: (t R M C K,) Float."""
    masses, first = _walked(problem, chosen)
    size_of_row = problem.shape[1] * problem.factors.channels * problem.shape[2]
    result = dr.empty(mi.Float, len(chosen) * problem.shape[0] * size_of_row)  # all is written
    result = _write(masses, mi.UInt32(0), size_of_row, None, result, first * size_of_row)
    dr.eval(result)
    return result


def _walked(problem: Problem, chosen: np.ndarray) -> tuple[Any, Any]:
    """Walk over the nodes of some texels, a lane for every cell of roughness.

    Returns:
        Masses of (column, channel, base colour) in local memory, and the number of every lane's
        cell among those of all texels, UInt32.
    """
    (rows, of_column, of_color), nodes = problem.shape, problem.nodes
    launch = dr.arange(mi.UInt32, len(chosen) * rows)
    # A packet is about one cell of roughness of many texels, which leave out the same nodes.
    number = dr.opaque(mi.UInt32, len(chosen))
    texel, cell = launch % number, launch // number
    walker = Walker(problem, dr.gather(mi.UInt32, owned(mi.UInt32, chosen), texel))

    def visit(node: Node, masses: Any) -> tuple[Any, ...]:
        _add_cells(problem, masses, node)
        return (masses,)

    (masses,) = walker.over_rows(
        dr.gather(mi.UInt32, nodes.first, cell), dr.gather(mi.UInt32, nodes.first, cell + 1),
        visit, lambda _, masses: (masses,),
        (cleared(of_column * problem.factors.channels * of_color),),
    )  # fmt: skip
    return masses, texel * dr.opaque(mi.UInt32, rows) + cell


def color_masses(
    problem: Problem, parts: Axis, chosen: np.ndarray, channel: np.ndarray | None = None
) -> list[Any]:
    """Return the masses of parts of every channel's base colour, not normalised.

    Args:
        problem: of S texels.
        parts: K of them.
        chosen: (t,) int64, which of the texels.
        channel: (t,) int64, the only channel of each that is asked for; all by default. Not under
            a prior of colours.

    Returns:
        A Float in blocks for each of C channels, or for the one of each texel, of K rows and t
        texels.
    """
    edges, only = np.append(parts.low, parts.high[-1]), None
    if channel is not None:
        only = owned(mi.UInt32, channel.astype(np.uint32))
    walker = Walker(problem, owned(mi.UInt32, chosen), edges, only)
    count, K = len(chosen), parts.count
    channels = problem.factors.channels if only is None else 1

    def visit(node: Node, masses: Any) -> tuple[Any, ...]:
        for number, color in enumerate(node.colors):
            for k, part in enumerate(color.cells):
                masses[number * K + k] = masses[number * K + k] + node.weight * part
        return (masses,)

    (masses,) = walker.over_rows(
        mi.UInt32(0), dr.opaque(mi.UInt32, problem.roughness.count), visit,
        lambda _, masses: (masses,), (cleared(channels * K),),
    )  # fmt: skip
    found = []
    for number in range(channels):
        target = dr.zeros(mi.Float, size(K, count))
        dr.eval(target)
        lane = dr.arange(mi.UInt32, count)
        found.append(_write(masses, mi.UInt32(number * K), K, lane, target))
    dr.eval(found)
    return found


def draw(problem: Problem, total: Any, random: list[Any]) -> tuple[list[Any], list[Any]]:
    """Draw parameters of all texels.

    Args:
        problem: of S texels.
        total: (S,) Float, of their ``Summary``.
        random: Floats (S,) in [0, 1): one, one for every parameter but base colour, and two for
            each of its channels, copies included.

    Returns:
        Roughness and the parameters that mix; and base colour by channel, copies included: Floats
        (S,).
    """
    walker, nodes, count = Walker(problem), problem.nodes, problem.factors.count
    wanted = random[0] * total

    def visit(node: Node, below: Any, row: Any, column: Any) -> tuple[Any, ...]:
        here = below <= wanted
        return (below + node.weight, dr.select(here, node.row, row),
                dr.select(here, node.column, column))  # fmt: skip

    zero = dr.zeros(mi.UInt32, count)
    _, row, column = walker.over_rows(
        mi.UInt32(0), dr.opaque(mi.UInt32, problem.roughness.count), visit,
        lambda _, *state: state, (dr.zeros(mi.Float, count), zero, zero),
    )  # fmt: skip
    dr.eval(row, column)
    places = [(nodes.rows, row), *((values, column) for values in nodes.columns)]
    colors = walker.colors_at(row, column, random[1 + len(places) :])
    shared = [
        values.anywhere(place, u)
        for (values, place), u in zip(places, random[1 : 1 + len(places)], strict=True)
    ]
    dr.eval(colors, shared)
    return shared, colors


def cleared(number: int) -> Any:
    """Return local memory of zeros, written in a loop (Dr.Jit 1.5 unrolls a literal start).

    The loop's end is a literal, which makes the size part of the kernel: Dr.Jit 1.5 otherwise
    takes the kernel of another size for this one, and writes beyond its memory.
    """

    def clear(k: Any, memory: Any) -> tuple[Any, Any]:
        memory[k] = mi.Float(0)
        return k + 1, memory

    start = (mi.UInt32(0), dr.alloc_local(mi.Float, number))
    return dr.while_loop(start, lambda k, _: k < number, clear)[1]


def _add_cells(problem: Problem, masses: Any, node: Node) -> None:
    """Add a node to the masses of (column, channel, base colour)."""
    of_color = problem.shape[2]
    of_row = problem.factors.channels * of_color
    column = dr.gather(mi.UInt32, problem.nodes.column, node.column) * of_row
    for channel, color in enumerate(node.colors):
        for k, part in enumerate(color.cells):
            place = column + (channel * of_color + k)
            masses[place] = masses[place] + node.weight * part


def _close(
    problem: Problem, masses: Any, row: Any, zx: Any, most: Any, best: Any, *best_colors: Any
) -> tuple[Any, ...]:  # fmt: skip
    """After the last node of a cell of roughness, add a log a of its masses, clear them, and see
    whether one of its cells has more mass than all before."""
    channels, of_color = problem.factors.channels, dr.opaque(mi.UInt32, problem.shape[2])
    end = dr.gather(mi.UInt32, problem.nodes.last, row)
    first = dr.gather(mi.UInt32, problem.nodes.row, row) * problem.shape[1]

    def of_column(column: Any, masses: Any, zx: Any, most: Any, best: Any, *old: Any) -> Any:
        totals, colors = [], []
        for channel in range(channels):
            place = (column * channels + channel) * of_color
            masses, zx, total, color = _close_channel(place, of_color, masses, zx)
            totals.append(total)
            colors.append(color)
        more = totals[0] > most  # all channels have the same
        chosen = (dr.select(more, new, color) for new, color in zip(colors, old, strict=True))
        best = dr.select(more, first + column, best)
        return column + 1, masses, zx, dr.maximum(totals[0], most), best, *chosen

    state = (mi.UInt32(0), masses, zx, most, best, *best_colors)
    return dr.while_loop(state, lambda column, *_: column < end, of_column)[1:]


def _close_channel(place: Any, number: Any, masses: Any, zx: Any) -> tuple[Any, ...]:
    """Add a log a of so many masses, and clear them; also returns their sum, and the largest."""

    def take(k: Any, masses: Any, zx: Any, total: Any, top: Any, color: Any) -> tuple[Any, ...]:
        a = masses[place + k]
        masses[place + k] = mi.Float(0)
        color = dr.select(a > top, k, color)
        zx = dr.fma(a, dr.log(dr.maximum(a, 1e-37)), zx)
        return k + 1, masses, zx, total + a, dr.maximum(top, a), color

    zero, none = dr.zeros(mi.Float, dr.width(zx)), dr.zeros(mi.UInt32, dr.width(zx))
    found = dr.while_loop(
        (mi.UInt32(0), masses, zx, zero, zero, none), lambda k, *_: k < number, take
    )
    return found[1], found[2], found[3], found[5]


def _write(
    masses: Any, first: Any, number: int, lane: Any | None, target: Any, place: Any | None = None
) -> Any:
    """Write local memory out, within the kernel that computes it: in blocks, or from ``place``."""
    stride = 1 if lane is None else BLOCK
    begin = place if lane is None else start(lane, dr.opaque(mi.UInt32, number))
    end = dr.opaque(mi.UInt32, number)

    def write(k: Any, masses: Any) -> tuple[Any, Any]:
        dr.scatter(target, masses[first + k], begin + k * stride, mode=dr.ReduceMode.NoConflicts)
        return k + 1, masses

    dr.while_loop((mi.UInt32(0), masses), lambda k, _: k < end, write)
    return target
