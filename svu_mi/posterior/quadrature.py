"""Quadrature nodes of all parameters but base colour, and their prior.

The bins of a grid are nearest to each of its nodes; the outermost are half as wide. Each is cut
into parts of equal width, with a node in the middle and a uniform density. Base colour needs no
nodes: it is integrated in closed form (``truncated_normal``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MIXED_PARTS = 14  # of a parameter that mixes columns, between 0 and 1, at least
COLOR_PARTS = 42  # for intervals only
NEAR_ENOUGH = 0.02  # to the ends, where these have a probability: few 8-bit textures hold them


@dataclass(frozen=True)
class QuadratureAxis:
    """Parts of one parameter's range, ascending.

    Attributes:
        low, high: (N,) float64 ends; equal for a single value with a probability.
        bin: (N,) int64, bin of the grid.
        mass: (N,) float64, prior probability, of sum 1.
    """

    low: np.ndarray
    high: np.ndarray
    bin: np.ndarray
    mass: np.ndarray
    bins: int

    @property
    def value(self) -> np.ndarray:
        """(N,) float64, the middle of every part."""
        return (self.low + self.high) / 2

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Ends of the intervals' parts, (N,) float64; single values get a width of rounding."""
        if self.count == 1:
            return self.low, self.high
        margin = np.where(self.low == self.high, NEAR_ENOUGH, 0)
        return np.maximum(self.low - margin, 0), np.minimum(self.high + margin, 1)

    @property
    def count(self) -> int:
        """N."""
        return len(self.mass)

    @property
    def first(self) -> np.ndarray:
        """(bins + 1,) int64, where the parts of every bin begin."""
        return np.searchsorted(self.bin, np.arange(self.bins + 1))

    @property
    def part_variance(self) -> np.ndarray:
        """(N,) float64, variance of a uniform distribution over each part."""
        return (self.high - self.low) ** 2 / 12

    def of_bins(self) -> np.ndarray:
        """(bins,) float64, prior probability of every bin."""
        return np.bincount(self.bin, self.mass, self.bins)

    def subset(self, bins: np.ndarray) -> QuadratureAxis:
        """Return the parts of some bins, (bins,) bool."""
        kept = bins[self.bin]
        return QuadratureAxis(
            self.low[kept], self.high[kept], self.bin[kept], self.mass[kept], self.bins
        )


@dataclass(frozen=True)
class ProductAxis:
    """All combinations of the parts of several parameters; the last one varies fastest."""

    axes: tuple[QuadratureAxis, ...]

    def at_all(self, attribute: str) -> list[np.ndarray]:
        """Return an array of ``QuadratureAxis`` at all combinations, (N,) for each parameter."""
        of_axes = [getattr(axis, attribute) for axis in self.axes]
        return [values.ravel() for values in np.meshgrid(*of_axes, indexing="ij")]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of parts of each parameter."""
        return tuple(axis.count for axis in self.axes)

    @property
    def count(self) -> int:
        """N."""
        return int(np.prod(self.shape))

    @property
    def bins(self) -> int:
        """Number of bins of the grid, those of all combinations."""
        return int(np.prod([axis.bins for axis in self.axes]))

    @property
    def bin(self) -> np.ndarray:
        """(N,) int64, the bin of each combination."""
        places, sizes = self.at_all("bin"), [axis.bins for axis in self.axes]
        return np.asarray(np.ravel_multi_index(tuple(places), sizes))

    @property
    def mass(self) -> np.ndarray:
        """(N,) float64, prior probability, of sum 1."""
        return np.asarray(np.prod(self.at_all("mass"), axis=0))

    def of_bins(self) -> np.ndarray:
        """(bins,) float64, prior probability of every bin."""
        return np.bincount(self.bin, self.mass, self.bins)


def bin_edges(nodes: np.ndarray) -> np.ndarray:
    """Return the (N + 1,) borders of the bins of N nodes on [0, 1]; of one node twice itself."""
    if len(nodes) == 1:
        return np.repeat(nodes, 2)
    return np.concatenate([[0.0], (nodes[1:] + nodes[:-1]) / 2, [1.0]])


def bin_widths(edges: np.ndarray) -> np.ndarray:
    """Return the widths of bins, (N,); 1 for a known value."""
    return np.diff(edges) if len(edges) > 2 else np.ones(1)


def bin_axis(nodes: np.ndarray) -> QuadratureAxis:
    """Return the bins of a grid as parts, all of one probability."""
    edges, count = bin_edges(nodes), len(nodes)
    return QuadratureAxis(edges[:-1], edges[1:], np.arange(count), np.full(count, 1 / count), count)


def uniform_axis(nodes: np.ndarray, parts: int) -> QuadratureAxis:
    """Divide the bins of (N,) nodes evenly into ``parts`` or more; a single node has one part."""
    if len(nodes) == 1:
        return QuadratureAxis(nodes, nodes, np.zeros(1, np.int64), np.ones(1), 1)
    per_half = max(1, -(-parts // (2 * (len(nodes) - 1))))
    count = 2 * (len(nodes) - 1) * per_half
    edges = np.linspace(0, 1, count + 1)
    bin_index = (np.arange(count) // per_half + 1) // 2
    return QuadratureAxis(edges[:-1], edges[1:], bin_index, np.full(count, 1 / count), len(nodes))


def mixed_axis(nodes: np.ndarray, parts: int, extremes: float) -> QuadratureAxis:
    """Divide bins into ``parts`` or more; 0 and 1 share the prior probability ``extremes``."""
    between = uniform_axis(nodes, parts)
    if len(nodes) == 1 or extremes == 0:
        return between
    ends = extremes / 2
    return QuadratureAxis(
        np.concatenate([[0.0], between.low, [1.0]]),
        np.concatenate([[0.0], between.high, [1.0]]),
        np.concatenate([[0], between.bin, [between.bin[-1]]]),
        np.concatenate([[ends], (1 - extremes) * between.mass, [ends]]),
        len(nodes),
    )
