"""A walk over the nodes of roughness and metallic of every texel.

Base colour is integrated in closed form at each node, channel by channel; nodes that explain a
texel hopelessly worse than its best one are left out. A visitor decides what is summed up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.posterior.nodes import Axis
from svu_mi.posterior.truncated import GENTLE, Channel, Integrals
from svu_mi.statistics import Factors
from svu_mi.statistics.factors import FLOOR, PAIRS
from svu_mi.statistics.spline import catmull_rom

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
        given: (R * M * tables * K,) Float, density of base colour in a cell, given roughness and
            metallic; or None: 1 everywhere.
        scale: Float of S values or one, sqrt(W / (s^2 tau)): errors in units of noise, per unit of
            weight.
        least: (S,) Float, energy of the best node, less what no node explains.
        tables: of ``given``: 1 for all channels, or one for each.
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
    tables: int = 1

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells (R, M, K)."""
        return self.roughness.cells, self.metallic.cells, len(self.edges) - 1

    @cached_property
    def nodes(self) -> Nodes:
        """Tables that kernels read."""
        return Nodes.of(self)

    @cached_property
    def slack(self) -> float:
        """Nats that a prior of colours may take off a node's energy, at most."""
        if self.given is None:
            return 0.0
        most = float(dr.max(self.given)[0])
        return self.copies * self.factors.channels * float(np.log(max(most, 1.0)))

    @cached_property
    def gentle(self) -> bool:
        """Whether the prior of colours excludes nothing (see ``Channel.weighed``)."""
        return self.given is not None and float(dr.min(self.given)[0]) > GENTLE

    def some(self, chosen: np.ndarray) -> Problem:
        """Return the problem of some texels, by their numbers among S."""
        lanes = owned(mi.UInt32, chosen)
        return replace(
            self, factors=self.factors.some(chosen),
            scale=dr.gather(mi.Float, self.scale, lanes),
            least=dr.gather(mi.Float, self.least, lanes),
        )  # fmt: skip


@dataclass(frozen=True)
class Nodes:
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
    def of(problem: Problem) -> Nodes:
        r, m = problem.roughness, problem.metallic
        levels, weights = spline(r.value, problem.factors.roughness)
        ends = np.diff(r.cell, append=r.cells) != 0
        cells = problem.shape[1] * problem.factors.channels * problem.shape[2]
        inside = [axis.mass / axis.of_cells()[axis.cell] for axis in (r, m)]
        rows = problem.rows.reshape(problem.shape[:2])[r.cell][:, m.cell]
        prior = np.minimum(rows - np.log(inside[0])[:, None] - np.log(inside[1]), NEVER)
        return Nodes(
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
    weights = catmull_rom(place - begin)
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
        self._slack = dr.opaque(mi.Float, problem.slack)

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
                energy, parts = self._channels(U, row, column)
                state = dr.if_stmt(
                    args=(energy, parts, *state), cond=energy < FAR + self._slack,
                    true_fn=lambda energy, parts, *state: visit(
                        self._node(row, column, energy, parts), *state
                    ),
                    false_fn=lambda _energy, _parts, *state: state,
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
        """Return the energy of the best colour at a node of metallic, without any prior: Float."""
        m = dr.gather(mi.Float, self.nodes.metallic, column)
        if self._known:
            return self._at_known(U, m)
        return self.problem.copies * sum(self.channel(of_channel, m).least for of_channel in U)

    def excess(self, U: list[list[Any]], row: Any, column: Any, best: Any) -> Any:
        """Return what a node's energy, prior included, has above ``least``, or ``best`` if that
        is less: Float."""
        energy, parts = self._channels(U, row, column)
        if self.problem.given is not None and not self._known:
            energy = dr.if_stmt(
                args=(energy, parts, best), cond=energy - self._slack < best,
                true_fn=lambda energy, parts, _: self._under(row, column, energy, parts)[0],
                false_fn=lambda _energy, _parts, best: best,
            )  # fmt: skip
        return dr.minimum(energy, best)

    def colors_at(self, row: Any, column: Any, random: list[Any]) -> list[Any]:
        """Draw the base colour of every channel, copies included, at a node.

        Args:
            row: UInt32, node of roughness.
            column: UInt32, node of metallic.
            random: two Floats in [0, 1) for each channel.
        """
        problem = self.problem
        number = problem.factors.channels * problem.copies
        if self._known:
            return [dr.opaque(mi.Float, float(problem.edges[0]), dr.width(self.lane))] * number
        m = dr.gather(mi.Float, self.nodes.metallic, column)
        channels = [self.channel(U, m) for U in self.entries(row)]
        prior = self._color_prior(row, column)
        ends = owned(mi.Float, problem.edges)
        found = []
        for k in range(number):
            channel, u, v = channels[k // problem.copies], random[2 * k], random[2 * k + 1]
            low, high = mi.Float(0), mi.Float(1)
            if prior is not None:
                table = prior[k // problem.copies]
                cell = _picked(channel.under(problem.edges.tolist(), table)[1].cells, v)
                low, high = (dr.gather(mi.Float, ends, cell + step) for step in (0, 1))
            found.append(channel.quantile(u, low, high))
        return found

    def _channels(self, U: list[list[Any]], row: Any, column: Any) -> tuple[Any, list[Any]]:
        """Return the energy of the best colour at a node above ``least``, with the prior of the
        node but not of colours; and the channels."""
        place = row * self._columns + column
        prior = dr.gather(mi.Float, self.nodes.prior, place) - self._least
        if self._known:
            return prior + self.energy(U, column), []
        m = dr.gather(mi.Float, self.nodes.metallic, column)
        channels = [self.channel(of_channel, m) for of_channel in U]
        energy = self.problem.copies * sum(one.least for one in channels)
        return prior + energy, [(c.least, c.mirrored, c.mu, c.s) for c in channels]

    def _under(
        self, row: Any, column: Any, energy: Any, parts: list[Any]
    ) -> tuple[Any, list[Integrals]]:
        """Return the energy of a node under a prior of colours, of all that it allows, and what is
        in the cells."""
        density, edges = self._color_prior(row, column), self.edges.tolist()
        assert density is not None
        way = Channel.weighed if self.problem.gentle else Channel.under
        found = [way(Channel(*c), edges, g) for c, g in zip(parts, density, strict=True)]
        return energy - self.problem.copies * sum(log_mass for log_mass, _ in found), [
            integrals for _, integrals in found
        ]

    @property
    def _known(self) -> bool:
        return bool(self.problem.edges[0] == self.problem.edges[-1])

    def _at_known(self, U: list[list[Any]], metallic: Any) -> Any:
        """Energy of the base colour that is known."""
        c = dr.opaque(mi.Float, float(self.problem.edges[0]))
        return self.problem.copies * sum(energy_at(of_channel, metallic, c) for of_channel in U)

    def _node(self, row: Any, column: Any, energy: Any, parts: list[Any]) -> Node:
        if not self._known and self.problem.given is not None:
            energy, found = self._under(row, column, energy, parts)
            return Node(row, column, dr.exp(-energy), found)
        weight = dr.exp(-energy)
        if self._known:
            c = dr.opaque(mi.Float, float(self.problem.edges[0]))
            one = Integrals(mi.Float(1), [mi.Float(1)], c, mi.Float(0))
            return Node(row, column, weight, [one] * self.problem.factors.channels)
        found = [Channel(*one).integrate(self.edges.tolist()) for one in parts]
        for one in found:
            for _ in range(self.problem.copies):
                weight *= one.mass
        return Node(row, column, weight, found)

    def _color_prior(self, row: Any, column: Any) -> list[list[Any]] | None:
        """Density of every channel's base colour in every cell of ``edges``, given a node."""
        problem, nodes = self.problem, self.nodes
        if problem.given is None:
            return None
        _, columns, cells = problem.shape
        place = dr.gather(mi.UInt32, nodes.row, row) * columns
        place = (place + dr.gather(mi.UInt32, nodes.column, column)) * (problem.tables * cells)
        middle = (self.edges[1:] + self.edges[:-1]) / 2
        own = np.searchsorted(problem.edges, middle) - 1
        tables = [
            [dr.gather(mi.Float, problem.given, place + (table * cells + k)) for k in range(cells)]
            for table in range(problem.tables)
        ]
        of_channels = tables if problem.tables > 1 else tables * problem.factors.channels
        return [[density[k] for k in own] for density in of_channels]


def energy_at(U: list[Any], metallic: Any, color: Any) -> Any:
    """Return 1/2 |U x|^2 at x = (c (1 - m), c m, m, 1): Float."""
    ee, ep, eg, et, pp, pg, pt, gg, gt, floor = U
    a, b = color * (1 - metallic), color * metallic
    x = dr.fma(ee, a, dr.fma(ep, b, dr.fma(eg, metallic, et)))
    y = dr.fma(pp, b, dr.fma(pg, metallic, pt))
    z = dr.fma(gg, metallic, gt)
    return 0.5 * dr.fma(x, x, dr.fma(y, y, dr.fma(z, z, floor)))


def _picked(parts: list[Any], random: Any) -> Any:
    """Return which of K parts of sum 1 a random number in [0, 1) falls on: UInt32."""
    below, cell = mi.Float(0), dr.zeros(mi.UInt32, dr.width(random))
    for part in parts[:-1]:
        below += part
        cell += dr.select(random >= below, mi.UInt32(1), 0)
    return cell
