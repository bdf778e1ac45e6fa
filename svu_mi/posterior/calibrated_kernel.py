"""Posterior integrals of a texel: entropy, moments, marginals, probabilities, draws.

Each result needs one pass over the nodes of roughness and the mixing parameters
(``node_integration``).
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.core.local_memory import load, scatter_strided, store, zeros
from svu_mi.parameters import MIXED
from svu_mi.posterior.calibrated_problem import CalibratedProblem
from svu_mi.posterior.node_integration import Node, NodeIntegrator
from svu_mi.posterior.quadrature import QuadratureAxis
from svu_mi.posterior.tables import row_colors
from svu_mi.statistics.texel_blocks import BLOCK, block_size, texel_offset


def min_energy(problem: CalibratedProblem, *, excess: bool = False) -> Any:
    """Return the least energy of all nodes, (S,) Float.

    With ``excess``, energies include the prior and are relative to ``problem.min_energy``.
    """
    integrator, columns = NodeIntegrator(problem), dr.opaque(mi.UInt32, problem.mixed.count)
    nodes = dr.opaque(mi.UInt32, problem.roughness.count)

    def of_row(row: Any, best: Any) -> tuple[Any, Any]:
        U = integrator.entries(row)

        def of_column(column: Any, best: Any) -> tuple[Any, Any]:
            if excess:
                return column + 1, integrator.excess(U, row, column, best)
            return column + 1, dr.minimum(best, integrator.energy(U, column))

        return row + 1, *fold(0, columns, of_column, best)

    (best,) = fold(0, nodes, of_row, dr.full(mi.Float, dr.inf, problem.factors.count))
    dr.eval(best)
    return best


@dataclass(frozen=True)
class PosteriorSummary:
    """Results of one pass over all nodes of S texels.

    Attributes:
        entropy: (S,) Float, entropy of the bins [nats], mean over channels.
        total: (S,) Float, integral of the unnormalised posterior.
        mean, sd: (S,) Floats for roughness, each mixing parameter, and base colour per channel.
        best: (S,) UInt32, index of the best bin of roughness and mixing parameters, in [0, R M).
        best_colors: (S,) UInt32 per channel, index of the best bin of base colour given ``best``.
    """

    entropy: Any
    total: Any
    mean: list[Any]
    sd: list[Any]
    best: Any
    best_colors: list[Any]


@dataclass
class MomentSums:
    """Weighted sums of parameters and of their squares, one Float64 per parameter."""

    sums: list[Any]
    squares: list[Any]

    @staticmethod
    def zeros(number: int, count: int) -> "MomentSums":
        """Return zero sums of ``number`` parameters in ``count`` lanes."""
        first, second = ([dr.zeros(mi.Float64, count) for _ in range(number)] for _ in range(2))
        return MomentSums(first, second)

    def add(self, weight: Any, values: list[tuple[Any, Any]]) -> None:
        """Add a node; ``values`` are the mean and mean square of each parameter."""
        w = mi.Float64(weight)
        means, squares = zip(*values, strict=True)
        self.sums = [dr.fma(w, x, old) for x, old in zip(means, self.sums, strict=True)]
        self.squares = [dr.fma(w, x, old) for x, old in zip(squares, self.squares, strict=True)]

    def finish(self, total: Any) -> tuple[list[Any], list[Any]]:
        """Return means and standard deviations, Floats, given the sum of weights."""
        mean = [x / total for x in self.sums]
        sd = [dr.sqrt(dr.maximum(x / total - dr.square(m), 0))
              for x, m in zip(self.squares, mean, strict=True)]  # fmt: skip
        return [mi.Float(x) for x in mean], [mi.Float(x) for x in sd]


@dataclass
class BestBin:
    """Bin of largest mass so far: row (all parameters but base colour), and base colours."""

    mass: Any
    row: Any
    colors: list[Any]

    @staticmethod
    def zeros(channels: int, count: int) -> "BestBin":
        """Return the initial best bin, with mass 0."""
        row, *colors = (dr.zeros(mi.UInt32, count) for _ in range(1 + channels))
        return BestBin(dr.zeros(mi.Float, count), row, colors)

    def add(self, mass: Any, row: Any, colors: list[Any]) -> None:
        """Replace the best bin in lanes where ``mass`` is larger."""
        more = mass > self.mass
        self.colors = [dr.select(more, new, old)
                       for new, old in zip(colors, self.colors, strict=True)]  # fmt: skip
        self.row = dr.select(more, row, self.row)
        self.mass = dr.maximum(mass, self.mass)


@dataclass
class BinMasses:
    """Masses of the bins (mixing parameters, channel, base colour) of one roughness bin.

    Attributes:
        memory: masses in local memory, by bin of the mixing parameters: an array for each channel
            and bin of base colour.
        logs: Float, sum of a log a over the masses a of all finished bins.
    """

    memory: list[Any]
    logs: Any

    @staticmethod
    def zeros(problem: CalibratedProblem, count: int) -> "BinMasses":
        """Return empty bins."""
        _, of_column, of_color = problem.shape
        memory = zeros(mi.Float, problem.factors.channels * of_color, of_column)
        return BinMasses(memory, dr.zeros(mi.Float, count))

    def add(self, problem: CalibratedProblem, node: Node) -> None:
        """Add a node to its bins."""
        place = dr.gather(mi.UInt32, problem.nodes.column, node.column)
        parts = [node.weight * part for color in node.colors for part in color.bins]
        sums = [a + part for a, part in zip(load(self.memory, place), parts, strict=True)]
        store(self.memory, place, sums)

    def finish_row(self, problem: CalibratedProblem, row: Any, best: BestBin) -> tuple[Any, Any]:
        """Clear the bins after the last node of a roughness bin, and update the best bin."""
        channels, of_color = problem.factors.channels, problem.shape[2]
        end = dr.gather(mi.UInt32, problem.nodes.last, row)
        first = dr.gather(mi.UInt32, problem.nodes.row, row) * problem.shape[1]

        def of_column(column: Any, bins: BinMasses, best: BestBin) -> tuple[Any, ...]:
            masses = bins.finish(column)
            groups = [masses[k : k + of_color] for k in range(0, channels * of_color, of_color)]
            # The total mass is equal for all channels.
            best.add(sum(groups[0]), first + column, [_largest(group) for group in groups])
            return column + 1, bins, best

        bins, best = fold(0, end, of_column, self, best)
        return bins, best

    def finish(self, column: Any) -> list[Any]:
        """Clear the bins of a bin of the mixing parameters; return their masses."""
        masses = load(self.memory, column)
        store(self.memory, column, [mi.Float(0)] * len(masses))
        for a in masses:
            self.logs = dr.fma(a, dr.log(dr.maximum(a, 1e-37)), self.logs)
        return masses


def _largest(masses: list[Any]) -> Any:
    """Return the index of the largest mass (UInt32), the first if several are equal."""
    top, index = masses[0], mi.UInt32(0)
    for k, mass in enumerate(masses[1:], 1):
        index = dr.select(mass > top, mi.UInt32(k), index)
        top = dr.maximum(top, mass)
    return index


@dataclass
class SummarySums:
    """Accumulators of ``summarize``; ``of_row`` is the mass of the current roughness node."""

    bins: BinMasses
    of_row: Any
    total: Any
    roughness: MomentSums
    others: MomentSums
    best: BestBin

    @staticmethod
    def zeros(problem: CalibratedProblem) -> "SummarySums":
        """Return zero sums."""
        count, channels = problem.factors.count, problem.factors.channels
        others = MomentSums.zeros(len(problem.nodes.columns) + channels, count)
        return SummarySums(
            BinMasses.zeros(problem, count), dr.zeros(mi.Float, count),
            dr.zeros(mi.Float64, count), MomentSums.zeros(1, count), others,
            BestBin.zeros(channels, count),
        )  # fmt: skip

    def add(self, problem: CalibratedProblem, node: Node) -> None:
        """Add a node."""
        self.bins.add(problem, node)
        self.of_row = self.of_row + node.weight
        values = [of_column.moments(node.column) for of_column in problem.nodes.columns]
        for color in node.colors:
            mean = mi.Float64(color.mean)
            values.append((mean, dr.fma(mean, mean, mi.Float64(color.variance))))
        self.others.add(node.weight, values)

    def finish_row(self, problem: CalibratedProblem, row: Any) -> None:
        """Add the mass of the current roughness node to the totals."""
        self.total = self.total + mi.Float64(self.of_row)
        self.roughness.add(self.of_row, [problem.nodes.rows.moments(row)])
        self.of_row = mi.Float(0)
        self.bins, self.best = self.bins.finish_row(problem, row, self.best)


def summarize(problem: CalibratedProblem) -> PosteriorSummary:
    """Return entropy, moments and best bins of all texels, in one pass over the nodes."""

    def visit(node: Node, sums: SummarySums) -> tuple[SummarySums]:
        sums.add(problem, node)
        return (sums,)

    def end_row(row: Any, sums: SummarySums) -> tuple[SummarySums]:
        sums.finish_row(problem, row)
        return (sums,)

    (sums,) = NodeIntegrator(problem).fold_all(visit, (SummarySums.zeros(problem),), end_row)
    total = dr.select(sums.total > 0, sums.total, 1)
    roughness, others = sums.roughness.finish(total), sums.others.finish(total)
    mean, sd = (roughness[k] + others[k] for k in range(2))
    total = mi.Float(total)
    entropy = dr.log(total) - sums.bins.logs / (total * problem.factors.channels)
    dr.eval(entropy, total, mean, sd, sums.best)
    return PosteriorSummary(entropy, total, mean, sd, sums.best.row, sums.best.colors)


def bin_probabilities(problem: CalibratedProblem, chosen: np.ndarray) -> np.ndarray:
    """Return bin probabilities of t texels, (t, R, M, K, C) float32, of sum 1 per channel."""
    rows, of_column, of_color = problem.shape
    shape = (len(chosen), rows, of_column, problem.factors.channels, of_color)
    masses = _bin_masses(problem, chosen).numpy().reshape(shape)
    total = masses.sum(axis=(1, 2, 4), keepdims=True, dtype=np.float64)
    masses = masses * (1 / np.where(total > 0, total, 1)).astype(np.float32)
    return np.moveaxis(masses, 3, 4)


def row_masses_and_colors(
    problem: CalibratedProblem, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return unnormalised masses of rows (bins of all parameters but base colour), (t, R M), and
    their mean colours (``row_colors``), (t, R M, C), float64."""
    shape = (len(chosen), -1, problem.factors.channels, problem.shape[2])
    masses = _bin_masses(problem, chosen).numpy().reshape(shape)
    # The mass of a row is equal for all channels.
    totals = np.einsum("trk->tr", masses[:, :, 0], dtype=np.float64)
    return totals, row_colors(np.moveaxis(masses, 2, 3), problem.edges)


def _bin_masses(problem: CalibratedProblem, chosen: np.ndarray) -> Any:
    """Return unnormalised bin masses of t texels, (t R M C K,) Float."""
    rows, nodes = problem.shape[0], problem.nodes
    launch = dr.arange(mi.UInt32, len(chosen) * rows)
    # Lanes of a packet share a roughness bin, so they skip nearly the same nodes.
    number = dr.opaque(mi.UInt32, len(chosen))
    texel, bin_index = launch % number, launch // number
    integrator = NodeIntegrator(problem, dr.gather(mi.UInt32, to_drjit(mi.UInt32, chosen), texel))

    def visit(node: Node, masses: BinMasses) -> tuple[BinMasses]:
        masses.add(problem, node)
        return (masses,)

    begin, end = (dr.gather(mi.UInt32, nodes.first, bin_index + step) for step in (0, 1))
    (masses,) = integrator.fold_rows(begin, end, visit, (BinMasses.zeros(problem, 1),))
    first = texel * dr.opaque(mi.UInt32, rows) + bin_index
    size_of_row = problem.shape[1] * problem.factors.channels * problem.shape[2]
    result = dr.empty(mi.Float, len(chosen) * rows * size_of_row)  # every value is written below
    result = _write(masses.memory, problem.shape[1], result, first * size_of_row)
    dr.eval(result)
    return result


def node_masses(problem: CalibratedProblem, name: str, chosen: np.ndarray) -> Any:
    """Return masses of a parameter's N nodes for t texels, in the layout of ``texel_blocks``."""
    number, place = problem.axis(name).count, None
    if name in MIXED:
        nodes = np.unravel_index(np.arange(problem.mixed.count), problem.mixed.shape)
        place = to_drjit(mi.UInt32, nodes[MIXED.index(name)].astype(np.uint32))

    def visit(node: Node, masses: Any) -> tuple[Any]:
        k = node.row if place is None else dr.gather(mi.UInt32, place, node.column)
        masses[k] = masses[k] + node.weight
        return (masses,)

    integrator = NodeIntegrator(problem, to_drjit(mi.UInt32, chosen))
    (masses,) = integrator.fold_all(visit, (zeros(mi.Float, 1, number)[0],))
    return _to_blocks(masses, number, len(chosen))


def color_masses(
    problem: CalibratedProblem, parts: QuadratureAxis, chosen: np.ndarray
) -> list[Any]:
    """Return masses of K parts of base colour, for each channel (see ``node_masses``)."""
    edges = np.append(parts.low, parts.high[-1])
    integrator = NodeIntegrator(problem, to_drjit(mi.UInt32, chosen), edges)
    K, channels = parts.count, problem.factors.channels

    def visit(node: Node, masses: Any) -> tuple[Any]:
        for number, color in enumerate(node.colors):
            for k, part in enumerate(color.bins):
                masses[number * K + k] = masses[number * K + k] + node.weight * part
        return (masses,)

    (masses,) = integrator.fold_all(visit, (zeros(mi.Float, 1, channels * K)[0],))
    blocks = [_to_blocks(masses, K, len(chosen), number * K) for number in range(channels)]
    dr.eval(blocks)
    return blocks


def draw(
    problem: CalibratedProblem, lanes: np.ndarray, total: Any, random: np.ndarray, count: int
) -> tuple[list[Any], list[Any]]:
    """Sample roughness, mixing parameters, and base colour per channel, ``count`` times.

    ``random`` are D >= ``count`` draws of t texels in [0, 1), (K, D, t) float32: K = one for the
    node, one for each shared parameter, and two for each channel. One pass over the nodes finds
    those of all draws. ``total`` is the mass of each texel. Returns (count * t,) Floats.
    """
    integrator = NodeIntegrator(problem, to_drjit(mi.UInt32, lanes))
    nodes, columns = problem.nodes, dr.opaque(mi.UInt32, problem.mixed.count)
    targets = [to_drjit(mi.Float, first) * total for first in random[0]]

    def visit(node: Node, below: Any, *found: Any) -> tuple[Any, ...]:
        here = node.row * columns + node.column
        several = [dr.select(below <= target, here, old)
                   for target, old in zip(targets, found, strict=True)]  # fmt: skip
        return below + node.weight, *several

    size, zero = dr.opaque(mi.UInt32, len(lanes)), dr.zeros(mi.UInt32, len(lanes))
    start = (dr.zeros(mi.Float, len(lanes)), *[zero] * len(targets))
    _, *found = integrator.fold_all(visit, start)
    drawn = dr.zeros(mi.UInt32, len(targets) * len(lanes))
    drawn = scatter_strided(drawn, found, dr.arange(mi.UInt32, len(lanes)), size)
    dr.eval(drawn)
    place = dr.gather(mi.UInt32, drawn, dr.arange(mi.UInt32, count * len(lanes)))
    row, rest = place // columns, [to_drjit(mi.Float, x[:count].ravel()) for x in random[1:]]
    places = [(nodes.rows, row), *((values, place % columns) for values in nodes.columns)]
    again = NodeIntegrator(problem, to_drjit(mi.UInt32, np.tile(lanes, count)))
    colors = again.draw_colors(row, place % columns, rest[len(places) :])
    shared = [values.sample(node, u) for (values, node), u in zip(places, rest, strict=False)]
    dr.eval(colors, shared)
    return shared, colors


def _to_blocks(masses: Any, number: int, count: int, first: int = 0) -> Any:
    """Copy local memory to the layout of ``texel_blocks``, in the kernel that computes it."""
    target = dr.zeros(mi.Float, block_size(number, count))
    dr.eval(target)
    place = texel_offset(dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, number))
    return _write([masses], number, target, place, BLOCK, first)


def _write(
    memory: list[Any], number: int, target: Any, place: Any, stride: int = 1, first: int = 0
) -> Any:
    """Write ``number`` blocks of local memory to ``target``, starting at ``place``."""
    end, first = dr.opaque(mi.UInt32, number), mi.UInt32(first)

    def write(k: Any, memory: list[Any]) -> tuple[Any, Any]:
        for j, value in enumerate(load(memory, first + k)):
            index = place + (k * len(memory) + j) * stride
            dr.scatter(target, value, index, mode=dr.ReduceMode.NoConflicts)
        return k + 1, memory

    fold(0, end, write, memory)
    return target
