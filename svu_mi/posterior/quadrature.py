"""Quadrature nodes of roughness and the mixing parameters, and their prior.

A bin of the grid contains all values nearest to its node; the outermost bins are half as wide. Bins
are divided into parts of equal width, with a quadrature node in the middle and uniform density.
Base colour needs no nodes: it is integrated in closed form (``truncated_normal``).
"""

from dataclasses import dataclass

import numpy as np

MIXED_PARTS = 14  # minimum number of parts of a mixing parameter, without point masses at 0 and 1
COLOR_PARTS = 42  # minimum number of parts of base colour, used for intervals only
NEAR_ENOUGH = 0.02  # width of point masses in intervals: 8-bit textures rarely contain exact 0 or 1


@dataclass(frozen=True)
class QuadratureAxis:
    """N parts of one parameter's range, ascending.

    Attributes:
        low, high: (N,) float64, ends of each part; equal for a point mass.
        bin: (N,) int64, bin of the grid that contains each part.
        mass: (N,) float64, prior probability of each part, of sum 1.
    """

    low: np.ndarray
    high: np.ndarray
    bin: np.ndarray
    mass: np.ndarray
    bins: int

    @property
    def value(self) -> np.ndarray:
        """(N,) float64, middle of each part."""
        return (self.low + self.high) / 2

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Low and high ends of parts, (N,) float64; point masses are widened by NEAR_ENOUGH."""
        if self.count == 1:
            return self.low, self.high
        margin = np.where(self.low == self.high, NEAR_ENOUGH, 0)
        return np.maximum(self.low - margin, 0), np.minimum(self.high + margin, 1)

    @property
    def count(self) -> int:
        """Number of parts N."""
        return len(self.mass)

    @property
    def first(self) -> np.ndarray:
        """(bins + 1,) int64, index of the first part of each bin."""
        return np.searchsorted(self.bin, np.arange(self.bins + 1))

    @property
    def part_variance(self) -> np.ndarray:
        """(N,) float64, variance of a uniform distribution over each part."""
        return (self.high - self.low) ** 2 / 12

    def of_bins(self) -> np.ndarray:
        """Return the prior probability of each bin, (bins,) float64."""
        return np.bincount(self.bin, self.mass, self.bins)

    def subset(self, bins: np.ndarray) -> "QuadratureAxis":
        """Return the parts in bins selected by a (bins,) bool mask."""
        kept = bins[self.bin]
        return QuadratureAxis(
            self.low[kept], self.high[kept], self.bin[kept], self.mass[kept], self.bins
        )


@dataclass(frozen=True)
class ProductAxis:
    """Product of the parts of several parameters; N combinations, the last axis fastest."""

    axes: tuple[QuadratureAxis, ...]

    def at_all(self, attribute: str) -> list[np.ndarray]:
        """Return an attribute of ``QuadratureAxis`` at all combinations: (N,) per parameter."""
        of_axes = [getattr(axis, attribute) for axis in self.axes]
        return [values.ravel() for values in np.meshgrid(*of_axes, indexing="ij")]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of parts of each parameter."""
        return tuple(axis.count for axis in self.axes)

    @property
    def count(self) -> int:
        """Number of combinations N."""
        return int(np.prod(self.shape))

    @property
    def bins(self) -> int:
        """Number of bins of the product grid."""
        return int(np.prod([axis.bins for axis in self.axes]))

    @property
    def bin(self) -> np.ndarray:
        """(N,) int64, bin of each combination."""
        places, sizes = self.at_all("bin"), [axis.bins for axis in self.axes]
        return np.asarray(np.ravel_multi_index(tuple(places), sizes))

    @property
    def mass(self) -> np.ndarray:
        """(N,) float64, prior probability of each combination, of sum 1."""
        return np.asarray(np.prod(self.at_all("mass"), axis=0))

    def of_bins(self) -> np.ndarray:
        """Return the prior probability of each bin, (bins,) float64."""
        return np.bincount(self.bin, self.mass, self.bins)


def bin_edges(nodes: np.ndarray) -> np.ndarray:
    """Return the (N + 1,) edges of N bins on [0, 1]; two equal edges if N is 1."""
    if len(nodes) == 1:
        return np.repeat(nodes, 2)
    return np.concatenate([[0.0], (nodes[1:] + nodes[:-1]) / 2, [1.0]])


def bin_widths(edges: np.ndarray) -> np.ndarray:
    """Return the widths of bins, (N,); 1 for a single bin."""
    return np.diff(edges) if len(edges) > 2 else np.ones(1)


def bin_axis(nodes: np.ndarray) -> QuadratureAxis:
    """Return the bins of a grid as parts with equal probabilities."""
    edges, count = bin_edges(nodes), len(nodes)
    return QuadratureAxis(edges[:-1], edges[1:], np.arange(count), np.full(count, 1 / count), count)


def uniform_axis(nodes: np.ndarray, parts: int) -> QuadratureAxis:
    """Divide the bins of N nodes into at least ``parts`` parts; into one part if N is 1."""
    if len(nodes) == 1:
        return QuadratureAxis(nodes, nodes, np.zeros(1, np.int64), np.ones(1), 1)
    per_half = max(1, -(-parts // (2 * (len(nodes) - 1))))
    count = 2 * (len(nodes) - 1) * per_half
    edges = np.linspace(0, 1, count + 1)
    bin_index = (np.arange(count) // per_half + 1) // 2
    return QuadratureAxis(edges[:-1], edges[1:], bin_index, np.full(count, 1 / count), len(nodes))


def mixed_axis(
    nodes: np.ndarray, parts: int, extremes: float, upper: float = 0.5
) -> QuadratureAxis:
    """Divide bins as ``uniform_axis``; add point masses at 0 and 1 with sum ``extremes``.

    ``upper`` is the share of the point mass at 1.
    """
    between = uniform_axis(nodes, parts)
    if len(nodes) == 1 or extremes == 0:
        return between
    below, above = extremes * (1 - upper), extremes * upper
    return QuadratureAxis(
        np.concatenate([[0.0], between.low, [1.0]]),
        np.concatenate([[0.0], between.high, [1.0]]),
        np.concatenate([[0], between.bin, [between.bin[-1]]]),
        np.concatenate([[below], (1 - extremes) * between.mass, [above]]),
        len(nodes),
    )
