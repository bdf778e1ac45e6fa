"""Integrals over the parameters of a texel: entropy, moments, marginals, probabilities, draws.

Each is one walk over the nodes of all but base colour (``walk``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.parameters import MIXED
from svu_mi.posterior.calibrated_problem import Problem
from svu_mi.posterior.node_integration import Node, Walker
from svu_mi.posterior.quadrature import Axis
from svu_mi.posterior.tables import color_of_rows
from svu_mi.statistics.texel_blocks import BLOCK, block_size, texel_offset


def least(problem: Problem, *, excess: bool = False) -> Any:
    """Return the energy of the best node, (S,) Float; or its ``excess`` over ``problem.least``."""
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
    """Results of one walk over all nodes of S texels.

    Attributes:
        entropy: (S,) Float, nats, of the masses of the cells; mean over channels.
        total: (S,) Float, integral of the posterior before normalisation.
        mean, sd: Floats (S,) of roughness, the mixing parameters, and base colour by channel.
        best: (S,) UInt32, the first of the R M cells of largest mass.
        best_colors: UInt32s (S,), the best of the K cells of base colour, given that.
    """

    entropy: Any
    total: Any
    mean: list[Any]
    sd: list[Any]
    best: Any
    best_colors: list[Any]


@dataclass
class Moments:
    """Sums of parameters and of their squares over nodes, Float64 for each parameter."""

    sums: list[Any]
    squares: list[Any]

    @staticmethod
    def zeros(number: int, count: int) -> Moments:
        """Begin with so many parameters of so many lanes."""
        first, second = ([dr.zeros(mi.Float64, count) for _ in range(number)] for _ in range(2))
        return Moments(first, second)

    def add(self, weight: Any, values: list[tuple[Any, Any]]) -> None:
        """Add a node, of which each parameter has a mean and a mean square."""
        w = mi.Float64(weight)
        means, squares = zip(*values, strict=True)
        self.sums = [dr.fma(w, x, old) for x, old in zip(means, self.sums, strict=True)]
        self.squares = [dr.fma(w, x, old) for x, old in zip(squares, self.squares, strict=True)]

    def finish(self, total: Any) -> tuple[list[Any], list[Any]]:
        """Return means and standard deviations: Floats."""
        mean = [x / total for x in self.sums]
        sd = [dr.sqrt(dr.maximum(x / total - dr.square(m), 0))
              for x, m in zip(self.squares, mean, strict=True)]  # fmt: skip
        return [mi.Float(x) for x in mean], [mi.Float(x) for x in sd]


@dataclass
class BestCell:
    """Cell of the largest mass so far: of all parameters but base colour, then of base colours."""

    mass: Any
    row: Any
    colors: list[Any]

    @staticmethod
    def zeros(channels: int, count: int) -> BestCell:
        """Begin with none."""
        row, *colors = (dr.zeros(mi.UInt32, count) for _ in range(1 + channels))
        return BestCell(dr.zeros(mi.Float, count), row, colors)

    def add(self, mass: Any, row: Any, colors: list[Any]) -> None:
        """Compare with another."""
        more = mass > self.mass
        self.colors = [dr.select(more, new, old)
                       for new, old in zip(colors, self.colors, strict=True)]  # fmt: skip
        self.row = dr.select(more, row, self.row)
        self.mass = dr.maximum(mass, self.mass)


@dataclass
class CellMasses:
    """Masses of (column, channel, base colour) of one cell of roughness, in local memory.

    Attributes:
        logs: Float, sum of a log a over the masses a of all finished cells.
    """

    memory: Any
    logs: Any

    @staticmethod
    def zeros(problem: Problem, count: int) -> CellMasses:
        """Begin with empty cells."""
        _, of_column, of_color = problem.shape
        number = of_column * problem.factors.channels * of_color
        return CellMasses(cleared(number), dr.zeros(mi.Float, count))

    def add(self, problem: Problem, node: Node) -> None:
        """Add a node to its cells."""
        of_color = problem.shape[2]
        of_row = problem.factors.channels * of_color
        column = dr.gather(mi.UInt32, problem.nodes.column, node.column) * of_row
        for channel, color in enumerate(node.colors):
            for k, part in enumerate(color.cells):
                place = column + (channel * of_color + k)
                self.memory[place] = self.memory[place] + node.weight * part

    def finish_row(self, problem: Problem, row: Any, best: BestCell) -> tuple[Any, Any]:
        """Empty all cells if a node of roughness is the last of its cell, and compare them."""
        channels, of_color = problem.factors.channels, dr.opaque(mi.UInt32, problem.shape[2])
        end = dr.gather(mi.UInt32, problem.nodes.last, row)
        first = dr.gather(mi.UInt32, problem.nodes.row, row) * problem.shape[1]

        def of_column(column: Any, cells: CellMasses, best: BestCell) -> tuple[Any, ...]:
            places = [(column * channels + channel) * of_color for channel in range(channels)]
            found = [cells.finish(place, of_color) for place in places]
            # All channels have the same total.
            best.add(found[0][0], first + column, [color for _, color in found])
            return column + 1, cells, best

        return dr.while_loop(
            (mi.UInt32(0), self, best), lambda column, *_: column < end, of_column
        )[1:]

    def finish(self, place: Any, number: Any) -> tuple[Any, Any]:
        """Empty so many cells; return the sum of their masses, and which has most."""

        def take(k: Any, cells: CellMasses, total: Any, top: Any, best: Any) -> tuple[Any, ...]:
            a = cells.memory[place + k]
            cells.memory[place + k] = mi.Float(0)
            cells.logs = dr.fma(a, dr.log(dr.maximum(a, 1e-37)), cells.logs)
            return k + 1, cells, total + a, dr.maximum(top, a), dr.select(a > top, k, best)

        count = dr.width(self.logs)
        zero, none = dr.zeros(mi.Float, count), dr.zeros(mi.UInt32, count)
        _, found, total, _, best = dr.while_loop(
            (mi.UInt32(0), self, zero, zero, none), lambda k, *_: k < number, take
        )
        self.memory, self.logs = found.memory, found.logs
        return total, best


@dataclass
class Sums:
    """Sums of ``summarize``: of the present node and cell of roughness, and of all finished."""

    cells: CellMasses
    of_row: Any
    total: Any
    roughness: Moments
    others: Moments
    best: BestCell

    @staticmethod
    def zeros(problem: Problem) -> Sums:
        """Begin with nothing."""
        count, channels = problem.factors.count, problem.factors.channels
        others = Moments.zeros(len(problem.nodes.columns) + channels, count)
        return Sums(
            CellMasses.zeros(problem, count), dr.zeros(mi.Float, count),
            dr.zeros(mi.Float64, count), Moments.zeros(1, count), others,
            BestCell.zeros(channels, count),
        )  # fmt: skip

    def add(self, problem: Problem, node: Node) -> None:
        """Add a node."""
        self.cells.add(problem, node)
        self.of_row = self.of_row + node.weight
        values = [of_column.moments(node.column) for of_column in problem.nodes.columns]
        for color in node.colors:
            mean = mi.Float64(color.mean)
            values.append((mean, dr.fma(mean, mean, mi.Float64(color.variance))))
        self.others.add(node.weight, values)

    def finish_row(self, problem: Problem, row: Any) -> None:
        """Add the mass of a node of roughness."""
        self.total = self.total + mi.Float64(self.of_row)
        self.roughness.add(self.of_row, [problem.nodes.rows.moments(row)])
        self.of_row = mi.Float(0)
        self.cells, self.best = self.cells.finish_row(problem, row, self.best)


def summarize(problem: Problem) -> Summary:
    """Walk once over all nodes of all texels."""

    def visit(node: Node, sums: Sums) -> tuple[Sums]:
        sums.add(problem, node)
        return (sums,)

    def row_ends(row: Any, sums: Sums) -> tuple[Sums]:
        sums.finish_row(problem, row)
        return (sums,)

    (sums,) = Walker(problem).over_all(visit, (Sums.zeros(problem),), row_ends)
    total = dr.select(sums.total > 0, sums.total, 1)
    roughness, others = sums.roughness.finish(total), sums.others.finish(total)
    mean, sd = (roughness[k] + others[k] for k in range(2))
    total = mi.Float(total)
    entropy = dr.log(total) - sums.cells.logs / (total * problem.factors.channels)
    dr.eval(entropy, total, mean, sd, sums.best)
    return Summary(entropy, total, mean, sd, sums.best.row, sums.best.colors)


def tables(problem: Problem, chosen: np.ndarray) -> np.ndarray:
    """Return cell masses of t texels, (t, R, M, K, C) float32, of sum 1 per texel and channel."""
    rows, of_column, of_color = problem.shape
    shape = (len(chosen), rows, of_column, problem.factors.channels, of_color)
    found = _cell_masses(problem, chosen).numpy().reshape(shape)
    total = found.sum(axis=(1, 2, 4), keepdims=True, dtype=np.float64)
    found = found * (1 / np.where(total > 0, total, 1)).astype(np.float32)
    return np.moveaxis(found, 3, 4)


def rows(problem: Problem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the masses of ``tables`` summed over base colour, not normalised, (t, R M) float64;
    and the colour that stands for each (``color_of_rows``), (t, R M, C) float64."""
    shape = (len(chosen), -1, problem.factors.channels, problem.shape[2])
    found = _cell_masses(problem, chosen).numpy().reshape(shape)
    # All channels have the same masses.
    masses = np.einsum("trk->tr", found[:, :, 0], dtype=np.float64)
    return masses, color_of_rows(np.moveaxis(found, 2, 3), problem.edges)


def _cell_masses(problem: Problem, chosen: np.ndarray) -> Any:
    """Return the masses of all cells of some texels, not normalised: (t R M C K,) Float."""
    masses, first = _walked(problem, chosen)
    size_of_row = problem.shape[1] * problem.factors.channels * problem.shape[2]
    result = dr.empty(mi.Float, len(chosen) * problem.shape[0] * size_of_row)  # all is written
    result = _write(masses, size_of_row, result, first * size_of_row)
    dr.eval(result)
    return result


def _walked(problem: Problem, chosen: np.ndarray) -> tuple[Any, Any]:
    """Return masses in local memory and cell numbers of some texels; a lane per roughness cell."""
    rows, nodes = problem.shape[0], problem.nodes
    launch = dr.arange(mi.UInt32, len(chosen) * rows)
    # A packet is about one cell of roughness of many texels, which leave out the same nodes.
    number = dr.opaque(mi.UInt32, len(chosen))
    texel, cell = launch % number, launch // number
    walker = Walker(problem, dr.gather(mi.UInt32, to_drjit(mi.UInt32, chosen), texel))

    def visit(node: Node, masses: CellMasses) -> tuple[CellMasses]:
        masses.add(problem, node)
        return (masses,)

    (masses,) = walker.over_rows(
        dr.gather(mi.UInt32, nodes.first, cell), dr.gather(mi.UInt32, nodes.first, cell + 1),
        visit, (CellMasses.zeros(problem, 1),),
    )  # fmt: skip
    return masses.memory, texel * dr.opaque(mi.UInt32, rows) + cell


def node_masses(problem: Problem, name: str, chosen: np.ndarray) -> Any:
    """Return unnormalised masses of a parameter's N nodes: a Float in blocks, N rows, t texels."""
    number, place = problem.axis(name).count, None
    if name in MIXED:
        nodes = np.unravel_index(np.arange(problem.mixed.count), problem.mixed.shape)
        place = to_drjit(mi.UInt32, nodes[MIXED.index(name)].astype(np.uint32))

    def visit(node: Node, masses: Any) -> tuple[Any]:
        k = node.row if place is None else dr.gather(mi.UInt32, place, node.column)
        masses[k] = masses[k] + node.weight
        return (masses,)

    walker = Walker(problem, to_drjit(mi.UInt32, chosen))
    (masses,) = walker.over_all(visit, (cleared(number),))
    return _in_blocks(masses, number, len(chosen))


def color_masses(
    problem: Problem, parts: Axis, chosen: np.ndarray, channel: np.ndarray | None = None
) -> list[Any]:
    """Return the masses of K parts of base colour (see ``node_masses``), for each channel, or for
    one of each texel, ``channel`` (t,) int64, where the prior leaves colours alike."""
    edges = np.append(parts.low, parts.high[-1])
    only = None if channel is None else to_drjit(mi.UInt32, channel.astype(np.uint32))
    walker = Walker(problem, to_drjit(mi.UInt32, chosen), edges, only)
    K, channels = parts.count, problem.factors.channels if only is None else 1

    def visit(node: Node, masses: Any) -> tuple[Any]:
        for number, color in enumerate(node.colors):
            for k, part in enumerate(color.cells):
                masses[number * K + k] = masses[number * K + k] + node.weight * part
        return (masses,)

    (masses,) = walker.over_all(visit, (cleared(channels * K),))
    found = [_in_blocks(masses, K, len(chosen), number * K) for number in range(channels)]
    dr.eval(found)
    return found


def draw(
    problem: Problem, lanes: np.ndarray, total: Any, random: list[Any]
) -> tuple[list[Any], list[Any]]:
    """Draw roughness, the mixing parameters, and base colour by channel of t texels: Floats (t,).

    ``random`` are Floats (t,) in [0, 1): one, one for each mixing parameter, two per channel.
    """
    walker = Walker(problem, to_drjit(mi.UInt32, lanes.astype(np.uint32)))
    nodes, count = problem.nodes, len(lanes)
    wanted = random[0] * total

    def visit(node: Node, below: Any, row: Any, column: Any) -> tuple[Any, ...]:
        here = below <= wanted
        return (below + node.weight, dr.select(here, node.row, row),
                dr.select(here, node.column, column))  # fmt: skip

    zero = dr.zeros(mi.UInt32, count)
    _, row, column = walker.over_all(visit, (dr.zeros(mi.Float, count), zero, zero))
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
    """Return zeroed local memory, written in a loop (Dr.Jit 1.5 unrolls a literal start).

    The loop's end is a literal: otherwise Dr.Jit 1.5 reuses a kernel of another size.
    """

    def clear(k: Any, memory: Any) -> tuple[Any, Any]:
        memory[k] = mi.Float(0)
        return k + 1, memory

    start = (mi.UInt32(0), dr.alloc_local(mi.Float, number))
    return dr.while_loop(start, lambda k, _: k < number, clear)[1]


def _in_blocks(masses: Any, number: int, count: int, first: int = 0) -> Any:
    """Return local memory in blocks, written within the kernel that computes it."""
    target = dr.zeros(mi.Float, block_size(number, count))
    dr.eval(target)
    place = texel_offset(dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, number))
    return _write(masses, number, target, place, BLOCK, first)


def _write(
    masses: Any, number: int, target: Any, place: Any, stride: int = 1, first: int = 0
) -> Any:
    """Write local memory to ``target``, from ``place`` on."""
    end, first = dr.opaque(mi.UInt32, number), mi.UInt32(first)

    def write(k: Any, masses: Any) -> tuple[Any, Any]:
        dr.scatter(target, masses[first + k], place + k * stride, mode=dr.ReduceMode.NoConflicts)
        return k + 1, masses

    dr.while_loop((mi.UInt32(0), masses), lambda k, _: k < end, write)
    return target
