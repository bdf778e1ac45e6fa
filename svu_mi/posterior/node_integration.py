"""A walk over the nodes of roughness, and over those of the parameters that mix, of every texel.

Base colour is integrated in closed form at each node, channel by channel; nodes that explain a
texel hopelessly worse than its best one are left out. A visitor decides what is summed up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.posterior.calibrated_problem import NEAR, Problem
from svu_mi.posterior.truncated_normal import Channel, Integrals
from svu_mi.reflection.principled import Mixture, mixture
from svu_mi.statistics.cholesky_factors import FLOOR, PAIRS, apply_factor

FAR = 28.0  # nats, prior included, from which on a node is left out


@dataclass(frozen=True)
class Node:
    """One node of every texel: all parameters but base colour.

    Attributes:
        row, column: UInt32 numbers of the nodes.
        weight: Float, exp(-energy) integrated over base colour, prior included.
    """

    row: Any
    column: Any
    weight: Any
    colors: list[Integrals]


class Walker:
    """Walks over nodes of texels ``lane``; ``edges`` are cells of colours (default: the grid's),
    of the one channel of each texel in ``only`` (UInt32, not under a prior of colours) or all."""

    def __init__(
        self, problem: Problem, lane: Any | None = None, edges: np.ndarray | None = None,
        only: Any | None = None,
    ) -> None:  # fmt: skip
        self.problem, self.nodes, self._only = problem, problem.nodes, only
        everything = dr.arange(mi.UInt32, problem.factors.count)
        self.lane = everything if lane is None else lane
        self.edges = problem.edges if edges is None else edges
        self._reader = problem.factors.reader(self.lane)
        self._scale = dr.gather(mi.Float, problem.scale, self.lane)
        self._least = dr.gather(mi.Float, problem.least, self.lane)
        self._columns = dr.opaque(mi.UInt32, problem.mixed.count)
        self._slack = dr.opaque(mi.Float, problem.slack)

    def over_all(
        self, visit: Callable[..., Any], state: tuple[Any, ...],
        row_ends: Callable[..., Any] | None = None,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Fold over all nodes of roughness (see ``over_rows``)."""
        end = dr.opaque(mi.UInt32, self.problem.roughness.count)
        return self.over_rows(mi.UInt32(0), end, visit, state, row_ends)

    def over_rows(
        self, begin: Any, end: Any, visit: Callable[..., Any], state: tuple[Any, ...],
        row_ends: Callable[..., Any] | None = None,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Fold over nodes of roughness in [begin, end), and within each over columns.

        ``visit(node, *state)`` returns the new state, only where a node matters; ``row_ends(row,
        *state)`` does after all columns. Both are traced once.
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
            return (row + 1, *(row_ends(row, *state) if row_ends else state))

        return dr.while_loop(
            state=(mi.UInt32(begin), *state), cond=lambda row, *_: row < end, body=body
        )[1:]

    def entries(self, row: Any) -> list[list[Any]]:
        """Return the factors of every channel at a node of roughness, in units of noise."""
        places = [row * NEAR + k for k in range(NEAR)]
        levels = [dr.gather(mi.UInt32, self.nodes.levels, place) for place in places]
        weights = [dr.gather(mi.Float, self.nodes.weights, place) for place in places]
        found = []
        for near in zip(*(self._reader.entries(level) for level in levels), strict=True):
            U = [
                self._scale * sum(w * U[k] for w, U in zip(weights, near, strict=True))
                for k in range(len(PAIRS))
            ]
            # A square; between levels the spline may swing below zero.
            U[FLOOR] = dr.maximum(U[FLOOR], 0) * self._scale
            found.append(U)
        return found

    def channels(self, U: list[list[Any]], column: Any) -> list[Channel]:
        """Return the likelihood of every channel's base colour at a node, from their factors."""
        how = self._mixture(column)
        return [
            Channel.of(
                apply_factor(of_channel, how.slope)[:-1], apply_factor(of_channel, how.offset)[:-1],
                of_channel[FLOOR],
            )
            for of_channel in U
        ]  # fmt: skip

    def energy(self, U: list[list[Any]], column: Any) -> Any:
        """Return the energy of the best colour at a column, without any prior: Float."""
        if self._known:
            c, how = dr.opaque(mi.Float, float(self.problem.edges[0])), self._mixture(column)
            energies = [energy_at(of_channel, how.at(c)) for of_channel in U]
        else:
            energies = [channel.least for channel in self.channels(U, column)]
        return self.problem.copies * sum(energies)

    def excess(self, U: list[list[Any]], row: Any, column: Any, best: Any) -> Any:
        """Return a node's energy above ``least``, prior included, or ``best`` if less: Float."""
        energy, parts = self._channels(U, row, column)
        if self.problem.given is not None and not self._known:
            energy = dr.if_stmt(
                args=(energy, parts, best), cond=energy - self._slack < best,
                true_fn=lambda energy, parts, _: self._under(row, column, energy, parts)[0],
                false_fn=lambda _energy, _parts, best: best,
            )  # fmt: skip
        return dr.minimum(energy, best)

    def colors_at(self, row: Any, column: Any, random: list[Any]) -> list[Any]:
        """Draw base colours by channel, copies included, at a node; two ``random`` Floats each."""
        problem = self.problem
        number = problem.factors.channels * problem.copies
        if self._known:
            return [dr.opaque(mi.Float, float(problem.edges[0]), dr.width(self.lane))] * number
        channels = self.channels(self.entries(row), column)
        prior = self._color_prior(row, column)
        ends = to_drjit(mi.Float, problem.edges)
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
        """Return a node's energy above ``least``, without the prior of colours; and channels."""
        place = row * self._columns + column
        prior = dr.gather(mi.Float, self.nodes.prior, place) - self._least
        if self._known:
            return prior + self.energy(U, column), []
        channels = self.channels(U, column)
        energy = self.problem.copies * sum(one.least for one in channels)
        return prior + energy, [(c.least, c.mirrored, c.mu, c.s) for c in channels]

    def _under(
        self, row: Any, column: Any, energy: Any, parts: list[Any]
    ) -> tuple[Any, list[Integrals]]:
        """Return the energy of a node under a prior of colours, and the integrals of the cells."""
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

    def _mixture(self, column: Any) -> Mixture:
        return mixture(*(values.at(column) for values in self.nodes.columns))

    def _node(self, row: Any, column: Any, energy: Any, parts: list[Any]) -> Node:
        if not self._known and self.problem.given is not None:
            energy, found = self._under(row, column, energy, parts)
            return Node(row, column, dr.exp(-energy), found)
        weight = dr.exp(-energy)
        if self._known:
            c = dr.opaque(mi.Float, float(self.problem.edges[0]))
            one = Integrals(mi.Float(1), [mi.Float(1)], c, mi.Float(0))
            return Node(row, column, weight, [one] * self.problem.factors.channels)
        if self._only is not None:
            return self._node_of_one(row, column, weight, parts)
        edges = self.edges.tolist()
        found = [Channel(*one).integrate(edges) for one in parts]
        for one in found:
            for _ in range(self.problem.copies):
                weight *= one.mass
        return Node(row, column, weight, found)

    def _node_of_one(self, row: Any, column: Any, weight: Any, parts: list[Any]) -> Node:
        """The same with the colours of one channel, for intervals: in single precision."""
        for one in parts:
            weight *= Channel(*one).masses([0.0, 1.0])[0] ** self.problem.copies
        own = parts[0]
        for number, other in enumerate(parts[1:], 1):
            own = dr.select(self._only == number, other, own)
        mass, cells = Channel(*own).masses(self.edges.tolist())
        return Node(row, column, weight, [Integrals(mass, cells, mi.Float(0), mi.Float(0))])

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


def energy_at(U: list[Any], x: list[Any]) -> Any:
    """Return 1/2 |U x|^2 where columns count x times, the last of them once: Float."""
    energy = U[FLOOR]
    for component in reversed(apply_factor(U, x)[:-1]):
        energy = dr.fma(component, component, energy)
    return 0.5 * energy


def _picked(parts: list[Any], random: Any) -> Any:
    """Return which of K parts of sum 1 a random number in [0, 1) falls on: UInt32."""
    below, cell = mi.Float(0), dr.zeros(mi.UInt32, dr.width(random))
    for part in parts[:-1]:
        below += part
        cell += dr.select(random >= below, mi.UInt32(1), 0)
    return cell
