"""Integration over nodes of roughness ("rows") and the mixing parameters ("columns").

At each node, base colour is integrated in closed form per channel. Nodes of negligible weight are
skipped. A callback accumulates results over the nodes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.core.local_memory import filled, load
from svu_mi.posterior.calibrated_problem import CalibratedProblem
from svu_mi.posterior.truncated_normal import FULL_SUPPORT, ChannelLikelihood, ColorIntegrals
from svu_mi.reflection.principled import Mixture, mixture
from svu_mi.reflection.roughness_levels import SPLINE_LEVELS
from svu_mi.statistics.cholesky_factors import FLOOR, PAIRS, apply_factor, squared_length

FAR = 23.0  # energy above the best node [nats], prior included, from which a node is skipped


@dataclass(frozen=True)
class Node:
    """One node of each texel.

    Attributes:
        row, column: UInt32, indices of the nodes of roughness and the mixing parameters.
        weight: Float, exp(-energy) integrated over base colour, prior included.
    """

    row: Any
    column: Any
    weight: Any
    colors: list[ColorIntegrals]


class NodeIntegrator:
    """Integrator over the nodes of texels ``lane`` (UInt32, default: all S).

    ``edges`` are the edges of base colour bins (default: the grid's).
    """

    def __init__(
        self, problem: CalibratedProblem, lane: Any | None = None, edges: np.ndarray | None = None
    ) -> None:
        self.problem, self.nodes = problem, problem.nodes
        self.lane = dr.arange(mi.UInt32, problem.factors.count) if lane is None else lane
        self.edges = problem.edges if edges is None else edges
        reader, (rows, columns, bins) = problem.factors.reader(self.lane), problem.shape
        # In local memory, reading at an index that lanes share costs no gather.
        self._factors = filled(problem.factors.levels, lambda k: sum(reader.entries(k), []))
        if problem.color_prior is not None:
            number, prior = problem.tables * bins, problem.color_prior
            self._densities = filled(rows * columns, lambda k: [
                dr.gather(mi.Float, prior, k * number + place) for place in range(number)
            ])  # fmt: skip
        self._scale = dr.gather(mi.Float, problem.scale, self.lane)
        self._min_energy = dr.gather(mi.Float, problem.min_energy, self.lane)
        self._columns = dr.opaque(mi.UInt32, problem.mixed.count)
        self._max_log_prior = dr.opaque(mi.Float, problem.max_log_prior)

    def fold_all(
        self, visit: Callable[..., Any], state: tuple[Any, ...],
        end_row: Callable[..., Any] | None = None,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Fold over all nodes (see ``fold_rows``)."""
        end = dr.opaque(mi.UInt32, self.problem.roughness.count)
        return self.fold_rows(0, end, visit, state, end_row)

    def fold_rows(
        self, begin: Any, end: Any, visit: Callable[..., Any], state: tuple[Any, ...],
        end_row: Callable[..., Any] | None = None,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Fold over the rows in [begin, end), and over all columns of each row.

        ``visit(node, *state)`` returns the new state; it is called for nodes that are not skipped.
        ``end_row(row, *state)`` returns the new state after the last column. Both are traced once.
        """

        def body(row: Any, *state: Any) -> tuple[Any, ...]:
            U = self.entries(row)

            def of_column(column: Any, *state: Any) -> tuple[Any, ...]:
                energy, parts = self._channels(U, row, column)
                state = dr.if_stmt(
                    args=(energy, parts, *state), cond=energy < FAR + self._max_log_prior,
                    true_fn=lambda energy, parts, *state: visit(
                        self._node(row, column, energy, parts), *state
                    ),
                    false_fn=lambda _energy, _parts, *state: state,
                )  # fmt: skip
                return (column + 1, *state)

            state = fold(0, self._columns, of_column, *state)
            return (row + 1, *(end_row(row, *state) if end_row else state))

        return fold(begin, end, body, *state)

    def entries(self, row: Any) -> list[list[Any]]:
        """Return the factors of each channel at a row, in units of noise."""
        places = [row * SPLINE_LEVELS + k for k in range(SPLINE_LEVELS)]
        levels = [dr.gather(mi.UInt32, self.nodes.levels, place) for place in places]
        weights = [dr.gather(mi.Float, self.nodes.weights, place) for place in places]
        factors = []
        entries = [load(self._factors, level) for level in levels]
        for first in range(0, len(entries[0]), len(PAIRS)):
            U = [
                self._scale * sum(w * U[k] for w, U in zip(weights, entries, strict=True))
                for k in range(first, first + len(PAIRS))
            ]
            # This entry is a square, but the spline can be negative between levels.
            U[FLOOR] = dr.maximum(U[FLOOR], 0) * self._scale
            factors.append(U)
        return factors

    def channels(self, U: list[list[Any]], column: Any) -> list[ChannelLikelihood]:
        """Return the likelihood of each channel's base colour at a column, from factors ``U``."""
        mix = self._mixture(column)
        return [
            ChannelLikelihood.of(
                apply_factor(of_channel, mix.slope)[:-1], apply_factor(of_channel, mix.offset)[:-1],
                of_channel[FLOOR],
            )
            for of_channel in U
        ]  # fmt: skip

    def energy(self, U: list[list[Any]], column: Any) -> Any:
        """Return the energy of the best colour at a column, without prior: Float."""
        if self._color_is_known:
            c, mix = dr.opaque(mi.Float, float(self.problem.edges[0])), self._mixture(column)
            energies = [energy_at(of_channel, mix.at(c)) for of_channel in U]
        else:
            energies = [channel.min_energy for channel in self.channels(U, column)]
        return self.problem.copies * sum(energies)

    def excess(self, U: list[list[Any]], row: Any, column: Any, best: Any) -> Any:
        """Return the smaller of ``best`` and energy - log prior - ``min_energy`` of a node."""

        def with_colors(energy: Any, parts: list[Any], _: Any) -> Any:
            colors = self._colors(row, column, parts)
            return energy - self.problem.copies * sum(c.log_scale + dr.log(c.mass) for c in colors)

        energy, parts = self._channels(U, row, column)
        if self.problem.color_prior is not None and not self._color_is_known:
            energy = dr.if_stmt(
                args=(energy, parts, best), cond=energy - self._max_log_prior < best,
                true_fn=with_colors, false_fn=lambda _energy, _parts, best: best,
            )  # fmt: skip
        return dr.minimum(energy, best)

    def draw_colors(self, row: Any, column: Any, random: list[Any]) -> list[Any]:
        """Sample base colours at a node, per channel and copy; ``random``: two Floats each."""
        problem = self.problem
        number = problem.factors.channels * problem.copies
        if self._color_is_known:
            return [dr.opaque(mi.Float, float(problem.edges[0]), dr.width(self.lane))] * number
        channels = self.channels(self.entries(row), column)
        prior = self._color_prior(row, column)
        ends = to_drjit(mi.Float, problem.edges)
        colors = []
        for k in range(number):
            channel, u, v = channels[k // problem.copies], random[2 * k], random[2 * k + 1]
            low, high = mi.Float(0), mi.Float(1)
            if prior is not None:
                table = prior[k // problem.copies]
                integrals = channel.integrate_with_prior(problem.edges.tolist(), table)
                bin_index = _sample_index(integrals.bins, v)
                low, high = (dr.gather(mi.Float, ends, bin_index + step) for step in (0, 1))
            colors.append(channel.quantile(u, low, high))
        return colors

    def _channels(self, U: list[list[Any]], row: Any, column: Any) -> tuple[Any, list[Any]]:
        """Return a node's energy above ``min_energy`` without colour prior, and the fields of each
        channel's likelihood."""
        place = row * self._columns + column
        prior = dr.gather(mi.Float, self.nodes.prior, place) - self._min_energy
        if self._color_is_known:
            return prior + self.energy(U, column), []
        channels = self.channels(U, column)
        energy = self.problem.copies * sum(one.min_energy for one in channels)
        return prior + energy, [(c.min_energy, c.mirrored, c.mu, c.s) for c in channels]

    def _colors(self, row: Any, column: Any, parts: list[Any]) -> list[ColorIntegrals]:
        """Return the colour integrals of a node."""
        density = self._color_prior(row, column)
        certain = density is None or self.problem.least_color_prior > FULL_SUPPORT
        return [ChannelLikelihood(*one).integrate(self.edges.tolist(), g, certain)
                for one, g in zip(parts, density or len(parts) * [[]], strict=True)]  # fmt: skip

    @property
    def _color_is_known(self) -> bool:
        return bool(self.problem.edges[0] == self.problem.edges[-1])

    def _mixture(self, column: Any) -> Mixture:
        return mixture(*(values.at(column) for values in self.nodes.columns))

    def _node(self, row: Any, column: Any, energy: Any, parts: list[Any]) -> Node:
        if self._color_is_known:
            c = dr.opaque(mi.Float, float(self.problem.edges[0]))
            one = ColorIntegrals(mi.Float(1), [mi.Float(1)], c, mi.Float(0))
            return Node(row, column, dr.exp(-energy), [one] * self.problem.factors.channels)
        colors, copies = self._colors(row, column, parts), self.problem.copies
        mass = dr.prod([color.mass for color in colors])
        scale = copies * sum(color.log_scale for color in colors)
        return Node(row, column, dr.exp(scale - energy) * mass**copies, colors)

    def _color_prior(self, row: Any, column: Any) -> list[list[Any]] | None:
        """Return each channel's prior density in each bin of ``edges``, given a node."""
        problem, nodes = self.problem, self.nodes
        if problem.color_prior is None:
            return None
        _, columns, bins = problem.shape
        place = dr.gather(mi.UInt32, nodes.row, row) * columns
        place = place + dr.gather(mi.UInt32, nodes.column, column)
        middle = (self.edges[1:] + self.edges[:-1]) / 2
        own = np.searchsorted(problem.edges, middle) - 1
        row = load(self._densities, place)
        tables = [row[k : k + bins] for k in range(0, len(row), bins)]
        of_channels = tables if problem.tables > 1 else tables * problem.factors.channels
        return [[density[k] for k in own] for density in of_channels]


def energy_at(U: list[Any], x: list[Any]) -> Any:
    """Return 1/2 |U x|^2: Float."""
    return 0.5 * squared_length(apply_factor(U, x)[:-1], U[FLOOR])


def _sample_index(parts: list[Any], random: Any) -> Any:
    """Sample an index of K probabilities; ``random`` is in [0, 1). Returns UInt32."""
    below, bin_index = mi.Float(0), dr.zeros(mi.UInt32, dr.width(random))
    for part in parts[:-1]:
        below += part
        bin_index += dr.select(random >= below, mi.UInt32(1), 0)
    return bin_index
