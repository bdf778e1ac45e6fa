"""Integrals over the parameters of a texel: entropy, moments, marginals, probabilities, draws.

One walk over the nodes of roughness and metallic, in which base colour is integrated in closed
form, channel by channel; nodes that explain a texel hopelessly worse than its best one are left
out. A visitor of the walk decides what is summed up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.posterior.nodes import Axis
from svu_mi.posterior.truncated import Channel, Integrals
from svu_mi.statistics import Factors
from svu_mi.statistics.blocks import BLOCK, size, start
from svu_mi.statistics.factors import FLOOR, PAIRS

NEAR = 4  # levels that a roughness is interpolated from
FAR = 28.0  # nats, prior included, from which on a node is left out
NEVER = 1e30  # -log of the prior of what it excludes


@dataclass(frozen=True)
class Problem:
    """Everything a posterior depends on.

    Attributes:
        factors: of S texels and C channels.
        copies: how many equal channels each stands for.
        roughness, metallic: nodes.
        edges: (K + 1,) of the cells of base colour; or two equal ones, what is known of it.
        rows: (R * M,) float64, -log of the prior of a row of cells, a roughness and a metallic.
        given: (R * M * K,) Float, prior of a cell over that of all colours alike; or None.
        scale: (S,) Float, sqrt(W / (s^2 tau)): errors in units of noise, per unit of weight.
        least: (S,) Float, energy of the best node, less what no node explains.
    """

    factors: Factors
    copies: int
    roughness: Axis
    metallic: Axis
    edges: np.ndarray
    rows: np.ndarray
    given: Any | None
    scale: Any
    least: Any

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells (R, M, K)."""
        return self.roughness.cells, self.metallic.cells, len(self.edges) - 1

    @cached_property
    def nodes(self) -> _Nodes:
        """Tables that kernels read."""
        return _Nodes.of(self)


@dataclass(frozen=True)
class _Nodes:
    """Nodes in memory: N of roughness, L of metallic.

    Attributes:
        levels, weights: (N * 4,) UInt32 and Float: what a roughness is interpolated from.
        roughness, metallic: (N,) and (L,) Float, the values.
        spread: (N,), (L,) Floats, variances within a part.
        row, column: (N,), (L,) UInt32, cells.
        prior: (N * L,) Float, -log of the prior.
        first: (R + 1,) UInt32, nodes of roughness where a cell begins.
        last: (N,) UInt32, number of cells of (metallic, channel, base colour) if a node of
            roughness is the last of its cell, else 0.
    """

    levels: Any
    weights: Any
    roughness: Any
    metallic: Any
    spread: tuple[Any, Any]
    row: Any
    column: Any
    prior: Any
    first: Any
    last: Any

    @staticmethod
    def of(problem: Problem) -> _Nodes:
        r, m = problem.roughness, problem.metallic
        levels, weights = spline(r.value, problem.factors.roughness)
        ends = np.diff(r.cell, append=r.cells) != 0
        cells = problem.shape[1] * problem.factors.channels * problem.shape[2]
        inside = [axis.mass / axis.of_cells()[axis.cell] for axis in (r, m)]
        rows = problem.rows.reshape(problem.shape[:2])[r.cell][:, m.cell]
        prior = np.minimum(rows - np.log(inside[0])[:, None] - np.log(inside[1]), NEVER)
        return _Nodes(
            levels=owned(mi.UInt32, levels.ravel().astype(np.uint32)),
            weights=owned(mi.Float, weights.ravel()),
            roughness=owned(mi.Float, r.value),
            metallic=owned(mi.Float, m.value),
            spread=(owned(mi.Float, r.spread), owned(mi.Float, m.spread)),
            row=owned(mi.UInt32, r.cell.astype(np.uint32)),
            column=owned(mi.UInt32, m.cell.astype(np.uint32)),
            prior=owned(mi.Float, prior.ravel()),
            first=owned(mi.UInt32, r.first.astype(np.uint32)),
            last=owned(mi.UInt32, (ends * cells).astype(np.uint32)),
        )


def spline(values: np.ndarray, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return four levels around every value and their weights [Catmull and Rom 1974].

    Args:
        values: (N,).
        levels: (R,) ascending at equal distances; values beyond them take the nearest. One level
            is all there is.

    Returns:
        (N, 4) int64 and (N, 4) float64.
    """
    last = len(levels) - 1
    if last == 0:
        return np.zeros((len(values), NEAR), int), np.tile([1.0, 0, 0, 0], (len(values), 1))
    place = np.clip((values - levels[0]) / (levels[-1] - levels[0]), 0, 1) * last
    begin = np.minimum(np.floor(place), last - 1)
    t = place - begin
    weights = [
        0.5 * t * (-1 + t * (2 - t)), 0.5 * (2 + t * t * (-5 + 3 * t)),
        0.5 * t * (1 + t * (4 - 3 * t)), 0.5 * t * t * (t - 1),
    ]  # fmt: skip
    near = np.clip(begin[:, None] + np.arange(-1, 3), 0, last).astype(int)
    return near, np.stack(weights, axis=1)


@dataclass(frozen=True)
class Node:
    """One roughness and metallic of every texel.

    Attributes:
        row, column: UInt32, numbers of the nodes.
        weight: Float, exp(-energy) integrated over base colour, prior included.
        colors: of C channels, given this node.
    """

    row: Any
    column: Any
    weight: Any
    colors: list[Integrals]


class Walker:
    """Walks over nodes of the texels of a launch.

    Args:
        problem: of S texels.
        lane: UInt32, which of the texels; all in order by default.
        edges: of the cells that colours are summed in; by default those of the grid.
    """

    def __init__(
        self, problem: Problem, lane: Any | None = None, edges: np.ndarray | None = None
    ) -> None:
        self.problem, self.nodes = problem, problem.nodes
        everything = dr.arange(mi.UInt32, problem.factors.count)
        self.lane = everything if lane is None else lane
        self.edges = problem.edges if edges is None else edges
        self._reader = problem.factors.at(self.lane)
        self._scale = dr.gather(mi.Float, problem.scale, self.lane)
        self._least = dr.gather(mi.Float, problem.least, self.lane)
        self._columns = dr.opaque(mi.UInt32, problem.metallic.count)

    def over_rows(
        self, begin: Any, end: Any, visit: Callable[..., Any], row_ends: Callable[..., Any],
        state: tuple[Any, ...],
    ) -> tuple[Any, ...]:  # fmt: skip
        """Fold over nodes of roughness, and within each over those of metallic.

        Args:
            begin: UInt32, the first node of roughness.
            end: UInt32, the one after the last.
            visit: ``visit(node, *state)`` returns the new state; only called where a node
                matters; traced once.
            row_ends: ``row_ends(row, *state)`` returns the new state after all metallic nodes.
            state: Dr.Jit arrays and local memory.
        """

        def body(row: Any, *state: Any) -> tuple[Any, ...]:
            U = self.entries(row)

            def of_column(column: Any, *state: Any) -> tuple[Any, ...]:
                energy, colors = self._channels(U, row, column)
                state = dr.if_stmt(
                    args=(energy, colors, *state), cond=energy < FAR,
                    true_fn=lambda energy, colors, *state: visit(
                        self._node(row, column, energy, colors), *state
                    ),
                    false_fn=lambda _energy, _colors, *state: state,
                )  # fmt: skip
                return (column + 1, *state)

            state = dr.while_loop(
                state=(mi.UInt32(0), *state), body=of_column,
                cond=lambda column, *_: column < self._columns,
            )[1:]  # fmt: skip
            return (row + 1, *row_ends(row, *state))

        return dr.while_loop(
            state=(mi.UInt32(begin), *state), cond=lambda row, *_: row < end, body=body
        )[1:]

    def entries(self, row: Any) -> list[list[Any]]:
        """Return the factors of every channel at a node of roughness, in units of noise."""
        places = [row * NEAR + k for k in range(NEAR)]
        levels = [dr.gather(mi.UInt32, self.nodes.levels, place) for place in places]
        weights = [dr.gather(mi.Float, self.nodes.weights, place) for place in places]
        found = []
        for channel in range(self.problem.factors.channels):
            near = [self._reader.entries(level, channel) for level in levels]
            U = [
                self._scale * sum(w * U[k] for w, U in zip(weights, near, strict=True))
                for k in range(len(PAIRS))
            ]
            # A square; between levels the spline may swing below zero.
            U[FLOOR] = dr.maximum(U[FLOOR], 0) * self._scale
            found.append(U)
        return found

    def channel(self, U: list[Any], metallic: Any) -> Channel:
        """Return the likelihood of a base colour at a metallic, from the factor of a channel."""
        ee, ep, eg, et, pp, pg, pt, gg, gt, floor = U
        m = metallic
        u = [dr.lerp(ee, ep, m), m * pp]
        v = [dr.fma(m, eg, et), dr.fma(m, pg, pt), dr.fma(m, gg, gt)]
        return Channel.of(u, v, floor)

    def energy(self, U: list[list[Any]], column: Any) -> Any:
        """Return the energy of the best colour at a node of metallic: Float."""
        m = dr.gather(mi.Float, self.nodes.metallic, column)
        if self._known:
            return self._at_known(U, m)
        return self.problem.copies * sum(self.channel(of_channel, m).least for of_channel in U)

    def colors_at(self, row: Any, metallic: Any, random: list[Any]) -> list[Any]:
        """Draw the base colour of every channel at a node of roughness."""
        if self._known:
            known = dr.opaque(mi.Float, float(self.problem.edges[0]), dr.width(self.lane))
            return [known] * self.problem.factors.channels
        return [
            self.channel(U, metallic).quantile(u)
            for U, u in zip(self.entries(row), random, strict=True)
        ]

    def _channels(
        self, U: list[list[Any]], row: Any, column: Any
    ) -> tuple[Any, list[tuple[Any, ...]]]:
        """Return the energy of the best colour, prior included, above that of the best node, and
        the likelihood of all channels."""
        prior = dr.gather(mi.Float, self.nodes.prior, row * self._columns + column) - self._least
        if self._known:
            return prior + self.energy(U, column), []
        m = dr.gather(mi.Float, self.nodes.metallic, column)
        found = [self.channel(of_channel, m) for of_channel in U]
        energy = self.problem.copies * sum(one.least for one in found)
        return prior + energy, [(c.least, c.mirrored, c.mu, c.s) for c in found]

    @property
    def _known(self) -> bool:
        return bool(self.problem.edges[0] == self.problem.edges[-1])

    def _at_known(self, U: list[list[Any]], metallic: Any) -> Any:
        """Energy of the base colour that is known."""
        c = dr.opaque(mi.Float, float(self.problem.edges[0]))
        return self.problem.copies * sum(energy_at(of_channel, metallic, c) for of_channel in U)

    def _node(self, row: Any, column: Any, energy: Any, colors: list[Any]) -> Node:
        weight = dr.exp(-energy)
        if self._known:
            c = dr.opaque(mi.Float, float(self.problem.edges[0]))
            one = Integrals(mi.Float(1), [mi.Float(1)], c, mi.Float(0))
            return Node(row, column, weight, [one] * self.problem.factors.channels)
        prior = self._color_prior(row, column)
        found = [Channel(*color).integrate(self.edges.tolist(), prior) for color in colors]
        for one in found:
            for _ in range(self.problem.copies):
                weight *= one.mass
        return Node(row, column, weight, found)

    def _color_prior(self, row: Any, column: Any) -> list[Any] | None:
        """Density of a base colour in every cell of ``edges``, given a node."""
        problem, nodes = self.problem, self.nodes
        if problem.given is None:
            return None
        _, columns, cells = problem.shape
        place = dr.gather(mi.UInt32, nodes.row, row) * columns
        place = (place + dr.gather(mi.UInt32, nodes.column, column)) * cells
        middle = (self.edges[1:] + self.edges[:-1]) / 2
        own = np.searchsorted(problem.edges, middle) - 1
        density = [dr.gather(mi.Float, problem.given, place + k) for k in range(cells)]
        return [density[k] for k in own]


def energy_at(U: list[Any], metallic: Any, color: Any) -> Any:
    """Return 1/2 |U x|^2 at x = (c (1 - m), c m, m, 1): Float."""
    ee, ep, eg, et, pp, pg, pt, gg, gt, floor = U
    a, b = color * (1 - metallic), color * metallic
    x = dr.fma(ee, a, dr.fma(ep, b, dr.fma(eg, metallic, et)))
    y = dr.fma(pp, b, dr.fma(pg, metallic, pt))
    z = dr.fma(gg, metallic, gt)
    return 0.5 * dr.fma(x, x, dr.fma(y, y, dr.fma(z, z, floor)))


def least(problem: Problem, *, prior: bool = False) -> Any:
    """Return the energy of the best node, (S,) Float; ``problem.least`` is not used.

    Args:
        problem: of S texels.
        prior: whether the prior of the nodes is part of it.
    """
    walker, columns = Walker(problem), dr.opaque(mi.UInt32, problem.metallic.count)
    nodes = dr.opaque(mi.UInt32, problem.roughness.count)

    def of_row(row: Any, best: Any) -> tuple[Any, Any]:
        U = walker.entries(row)

        def of_column(column: Any, best: Any) -> tuple[Any, Any]:
            energy = walker.energy(U, column)
            if prior:
                energy += dr.gather(mi.Float, problem.nodes.prior, row * columns + column)
            return column + 1, dr.minimum(best, energy)

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
        mean, sd: Floats (S,) of roughness, metallic, and the base colour of every channel.
        roughness, metallic: Floats in blocks (statistics/blocks.py), not normalised: the
            masses of N and L parts.
    """

    entropy: Any
    total: Any
    mean: list[Any]
    sd: list[Any]
    roughness: Any
    metallic: Any


def summarize(problem: Problem) -> Summary:
    """Walk once over all nodes of all texels."""
    walker, count = Walker(problem), problem.factors.count
    channels, nodes = problem.factors.channels, problem.nodes
    rows, columns = problem.roughness.count, problem.metallic.count
    _, of_metallic, of_color = problem.shape
    cells = of_metallic * channels * of_color
    masses = _cleared(cells + columns)
    first = dr.opaque(mi.UInt32, cells)  # of the metallic nodes, behind the cells
    by_roughness, by_metallic = (dr.zeros(mi.Float, size(n, count)) for n in (rows, columns))
    dr.eval(by_roughness, by_metallic)
    place = start(walker.lane, dr.opaque(mi.UInt32, rows))

    def visit(node: Node, masses: Any, of_row: Any, *sums: Any) -> tuple[Any, ...]:
        _add_cells(problem, masses, node)
        masses[first + node.column] = masses[first + node.column] + node.weight
        w = mi.Float64(node.weight)
        m = mi.Float64(dr.gather(mi.Float, nodes.metallic, node.column))
        within = mi.Float64(dr.gather(mi.Float, nodes.spread[1], node.column))
        values = [(m, within)] + [(mi.Float64(c.mean), mi.Float64(c.variance)) for c in node.colors]
        added = [x for mean, v in values for x in (mean, dr.fma(mean, mean, v))]
        sums = tuple(dr.fma(w, x, old) for x, old in zip(added, sums, strict=True))
        return (masses, of_row + node.weight, *sums)

    def row_ends(row: Any, masses: Any, of_row: Any, *state: Any) -> tuple[Any, ...]:
        *sums, total, r1, r2, zx = state
        dr.scatter(by_roughness, of_row, place + row * BLOCK, mode=dr.ReduceMode.NoConflicts)
        w = mi.Float64(of_row)
        r = mi.Float64(dr.gather(mi.Float, nodes.roughness, row))
        within = mi.Float64(dr.gather(mi.Float, nodes.spread[0], row))
        masses, zx = _close(problem, masses, row, zx)
        return (masses, mi.Float(0), *sums, total + w, dr.fma(w, r, r1),
                dr.fma(w, dr.fma(r, r, within), r2), zx)  # fmt: skip

    def visit_all(node: Node, masses: Any, of_row: Any, *sums: Any) -> tuple[Any, ...]:
        return (*visit(node, masses, of_row, *sums[:-4]), *sums[-4:])

    zeros = (*(dr.zeros(mi.Float64, count) for _ in range(2 + 2 * channels + 3)),
             dr.zeros(mi.Float, count))  # fmt: skip
    masses, _, *sums, total, r1, r2, zx = walker.over_rows(
        mi.UInt32(0), dr.opaque(mi.UInt32, rows), visit_all, row_ends,
        (masses, dr.zeros(mi.Float, count), *zeros),
    )  # fmt: skip
    by_metallic = _write(masses, first, columns, walker.lane, by_metallic)
    total = dr.select(total > 0, total, 1)
    moments = [r1, r2, *sums]
    mean = [x / total for x in moments[::2]]
    sd = [dr.sqrt(dr.maximum(x / total - dr.square(m), 0))
          for x, m in zip(moments[1::2], mean, strict=True)]  # fmt: skip
    mean, sd = [mi.Float(x) for x in mean], [mi.Float(x) for x in sd]
    total = mi.Float(total)
    entropy = dr.log(total) - zx / (total * channels)
    dr.eval(entropy, total, mean, sd, by_roughness, by_metallic)
    return Summary(entropy, total, mean, sd, by_roughness, by_metallic)


def tables(problem: Problem, chosen: np.ndarray) -> np.ndarray:
    """Return the masses of all cells of a few texels, for everything that is not the hot path.

    Args:
        problem: of S texels.
        chosen: (t,) int64, which of them.

    Returns:
        (t, R, M, K, C) float64, of sum 1 for every texel and channel, the others marginalised.
    """
    rows, of_metallic, of_color = problem.shape
    channels, nodes = problem.factors.channels, problem.nodes
    launch = dr.arange(mi.UInt32, len(chosen) * rows)
    number = dr.opaque(mi.UInt32, rows)
    texel, cell = launch // number, launch % number
    walker = Walker(problem, dr.gather(mi.UInt32, owned(mi.UInt32, chosen), texel))
    size_of_row = of_metallic * channels * of_color

    def visit(node: Node, masses: Any) -> tuple[Any, ...]:
        _add_cells(problem, masses, node)
        return (masses,)

    (masses,) = walker.over_rows(
        dr.gather(mi.UInt32, nodes.first, cell), dr.gather(mi.UInt32, nodes.first, cell + 1),
        visit, lambda _, masses: (masses,), (_cleared(size_of_row),),
    )  # fmt: skip
    result = dr.zeros(mi.Float, len(chosen) * rows * size_of_row)
    dr.eval(result)
    result = _write(masses, mi.UInt32(0), size_of_row, None, result, launch * size_of_row)
    dr.eval(result)
    found = result.numpy().reshape(len(chosen), rows, of_metallic, channels, of_color)
    found = np.moveaxis(found, 3, 4).astype(np.float64)
    total = found.sum(axis=(1, 2, 3), keepdims=True)
    return found / np.where(total > 0, total, 1)


def color_masses(problem: Problem, parts: Axis) -> list[Any]:
    """Return the masses of parts of every channel's base colour, not normalised.

    Args:
        problem: of S texels.
        parts: K of them.

    Returns:
        A Float in blocks for each of C channels, of K rows.
    """
    edges = np.append(parts.low, parts.high[-1])
    walker, count, K = Walker(problem, edges=edges), problem.factors.count, parts.count
    channels = problem.factors.channels

    def visit(node: Node, masses: Any) -> tuple[Any, ...]:
        for channel, color in enumerate(node.colors):
            for k, part in enumerate(color.cells):
                masses[channel * K + k] = masses[channel * K + k] + node.weight * part
        return (masses,)

    (masses,) = walker.over_rows(
        mi.UInt32(0), dr.opaque(mi.UInt32, problem.roughness.count), visit,
        lambda _, masses: (masses,), (_cleared(channels * K),),
    )  # fmt: skip
    found = []
    for channel in range(channels):
        target = dr.zeros(mi.Float, size(K, count))
        dr.eval(target)
        found.append(_write(masses, mi.UInt32(channel * K), K, walker.lane, target))
    dr.eval(found)
    return found


def draw(problem: Problem, total: Any, lane: Any, random: list[Any]) -> tuple[list[Any], Any, Any]:
    """Draw parameters.

    Args:
        problem: of S texels.
        total: (S,) Float, of their ``Summary``.
        lane: (N,) UInt32, which texel each draw is of.
        random: 3 + C Floats (N,) in [0, 1).

    Returns:
        Base colour by channel, roughness and metallic: Floats (N,).
    """
    walker, nodes = Walker(problem, lane), problem.nodes
    wanted = random[0] * dr.gather(mi.Float, total, lane)

    def visit(node: Node, below: Any, row: Any, column: Any) -> tuple[Any, ...]:
        here = below <= wanted
        return (below + node.weight, dr.select(here, node.row, row),
                dr.select(here, node.column, column))  # fmt: skip

    zero = dr.zeros(mi.UInt32, dr.width(lane))
    _, row, column = walker.over_rows(
        mi.UInt32(0), dr.opaque(mi.UInt32, problem.roughness.count), visit,
        lambda _, *state: state, (dr.zeros(mi.Float, dr.width(lane)), zero, zero),
    )  # fmt: skip
    dr.eval(row, column)
    m = dr.gather(mi.Float, nodes.metallic, column)
    colors = walker.colors_at(row, m, random[3:])
    # Anywhere within a part.
    r, m = (
        value + (u - 0.5) * dr.sqrt(12 * dr.gather(mi.Float, spread, index))
        for value, u, spread, index in (
            (dr.gather(mi.Float, nodes.roughness, row), random[1], nodes.spread[0], row),
            (m, random[2], nodes.spread[1], column),
        )
    )
    dr.eval(colors, r, m)
    return colors, r, m


def _cleared(number: int) -> Any:
    """Local memory of zeros, written in a loop (Dr.Jit 1.5 unrolls a literal start)."""
    memory, end = dr.alloc_local(mi.Float, number), dr.opaque(mi.UInt32, number)

    def clear(k: Any, memory: Any) -> tuple[Any, Any]:
        memory[k] = mi.Float(0)
        return k + 1, memory

    return dr.while_loop((mi.UInt32(0), memory), lambda k, _: k < end, clear)[1]


def _add_cells(problem: Problem, masses: Any, node: Node) -> None:
    """Add a node to the masses of (metallic, channel, base colour)."""
    of_color = problem.shape[2]
    of_row = problem.factors.channels * of_color
    column = dr.gather(mi.UInt32, problem.nodes.column, node.column) * of_row
    for channel, color in enumerate(node.colors):
        for k, part in enumerate(color.cells):
            place = column + (channel * of_color + k)
            masses[place] = masses[place] + node.weight * part


def _close(problem: Problem, masses: Any, row: Any, zx: Any) -> tuple[Any, Any]:
    """After the last node of a cell of roughness, add a log a of its masses, and clear them."""
    end = dr.gather(mi.UInt32, problem.nodes.last, row)

    def close(k: Any, masses: Any, zx: Any) -> tuple[Any, ...]:
        a = masses[k]
        masses[k] = mi.Float(0)
        return k + 1, masses, dr.fma(a, dr.log(dr.maximum(a, 1e-37)), zx)

    return dr.while_loop((mi.UInt32(0), masses, zx), lambda k, *_: k < end, close)[1:]


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
