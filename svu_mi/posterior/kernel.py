"""Interface of kernels, which compute the posterior of given texels."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.posterior.grid import Grid
from svu_mi.posterior.intervals import shortest_interval
from svu_mi.posterior.quadrature import bin_axis
from svu_mi.posterior.row_entropy import entropy_of
from svu_mi.posterior.tables import draw_bins, marginals
from svu_mi.statistics.cholesky_factors import Factors
from svu_mi.statistics.texel_blocks import to_blocks

CHUNK = 1 << 22  # number of bins in memory at the same time

Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Prior:
    """Prior of all texels, which is also the posterior of unseen texels.

    Attributes:
        probabilities: probability of each bin, float64 in the grid's shape, of sum 1.
    """

    probabilities: np.ndarray
    axes: Mapping[str, np.ndarray]

    @property
    def max_entropy(self) -> float:
        """Normalisation of entropies [nats]: log n for the n bins of the grid (Eq. 5)."""
        return float(np.log(self.probabilities.size))

    @property
    def entropy(self) -> float:
        """Normalised entropy, in [0, 1]."""
        return min(entropy_of(self.probabilities) / self.max_entropy, 1.0)

    def marginal(self, name: str) -> np.ndarray:
        """Return the probability of each node of a parameter."""
        return marginals(self.probabilities, list(self.axes))[name]

    def moments(self, name: str) -> tuple[Any, Any]:
        """Return mean and standard deviation of a parameter: numbers, or (g,) per channel."""
        nodes, p = self.axes[name], self.marginal(name)
        mean = float(p @ nodes)
        return mean, float(np.sqrt(p @ (nodes - mean) ** 2))

    def draws(self, count: int, random: np.random.Generator) -> dict[str, np.ndarray]:
        """Sample parameters, with equal values in all channels: (count,) by name."""
        picked = random.choice(self.probabilities.size, count, p=self.probabilities.ravel())
        index = np.unravel_index(picked, self.probabilities.shape)
        return {name: nodes[k] for (name, nodes), k in zip(self.axes.items(), index, strict=True)}


class Kernel(ABC):
    """Posterior of given texels, (t,) int64 indices; all must be seen in a photograph.

    Results have a last axis of g channels: g = G for the last parameter of the grid (base colour or
    Ks), g = 1 for parameters that channels share.
    """

    grid: Grid
    continuous: bool
    spread: Mapping[str, float] = MappingProxyType({})
    """Factors by which tested error bars are widened, by parameter (``folds``); 1 if missing."""

    @property
    @abstractmethod
    def channels(self) -> int:
        """Number G of base colours or Ks per texel: 3, or 1 for grey."""

    @property
    @abstractmethod
    def prior(self) -> Prior:
        """Prior of all texels."""

    @abstractmethod
    def entropy(self, texels: np.ndarray) -> np.ndarray:
        """Return the normalised entropy, (t,) float32."""

    @abstractmethod
    def probabilities(self, texels: np.ndarray) -> np.ndarray:
        """Return bin probabilities, (t, *grid, G) float32; memory limits t (see ``chunks``)."""

    @abstractmethod
    def best(self, texels: np.ndarray) -> np.ndarray:
        """Return the indices of the most probable nodes, (t, axes, G) int64."""

    @abstractmethod
    def moments(self, name: str, texels: np.ndarray) -> Pair:
        """Return mean and standard deviation of a parameter, both (t, g) float32."""

    @abstractmethod
    def ends(self, name: str, level: float, texels: np.ndarray) -> Pair:
        """Return both ends of the shortest intervals of probability ``level``, (t, g) float32."""

    @abstractmethod
    def draws(self, count: int, seed: int, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Sample parameters, (count, t, g) float32 by name."""

    def marginals(self, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Return the marginals of all parameters, (t, nodes, G) float32 by name."""
        axes = self.grid.axes
        found = {name: np.empty((len(texels), len(nodes), self.channels), np.float32)
                 for name, nodes in axes.items()}  # fmt: skip
        for span in self.chunks(len(texels)):
            p = self.probabilities(texels[span])
            for axis, table in enumerate(found.values(), 1):
                table[span] = p.sum(axis=tuple(k for k in range(1, len(axes) + 1) if k != axis))
        return found

    def half_widths(self, name: str, level: float, texels: np.ndarray) -> np.ndarray:
        """Return half the widths of intervals, (t,), of the channel whose interval is widest."""
        low, high = self.ends(name, level, texels)
        return np.asarray((high - low).max(axis=1) / 2)

    def channels_of(self, name: str) -> int:
        """Return the number of channels g of a parameter."""
        return self.channels if name == list(self.grid.axes)[-1] else 1

    def chunks(self, count: int) -> Iterator[slice]:
        """Yield slices of texels whose bins fit into memory."""
        size = max(CHUNK // (int(np.prod(self.grid.shape)) * self.channels), 1)
        for first in range(0, count, size):
            yield slice(first, min(first + size, count))


class GridKernel(Kernel):
    """Kernel that evaluates all bins of a grid for T = ``count`` texels."""

    count: int
    continuous = False

    @abstractmethod
    def tables(self, texels: np.ndarray) -> Pair:
        """Return bin probabilities, (t, *grid, G) float32, and best nodes, (t, axes, G) int64."""

    def probabilities(self, texels: np.ndarray) -> np.ndarray:
        """Return bin probabilities (see ``Kernel``)."""
        return self.tables(texels)[0]

    def best(self, texels: np.ndarray) -> np.ndarray:
        """Return the most probable nodes (see ``Kernel``)."""
        best = np.empty((len(texels), len(self.grid.shape), self.channels), np.int64)
        for span in self.chunks(len(texels)):
            best[span] = self.tables(texels[span])[1]
        return best

    def moments(self, name: str, texels: np.ndarray) -> Pair:
        """Return mean and standard deviation of the nodes (see ``Kernel``)."""
        p = self._marginal(name)[texels].astype(np.float64)
        nodes = self.grid.axes[name][:, None]
        mean = (p * nodes).sum(axis=1)
        variance = (p * (nodes - mean[:, None]) ** 2).sum(axis=1)
        return mean.astype(np.float32), np.sqrt(variance).astype(np.float32)

    def ends(self, name: str, level: float, texels: np.ndarray) -> Pair:
        """Return the ends of the shortest runs of bins (see ``Kernel``)."""
        p, parts = self._marginal(name)[texels], bin_axis(self.grid.axes[name])
        ends = [
            shortest_interval(to_blocks(mi.Float, p[..., g].T), parts, len(texels), level)
            for g in range(p.shape[-1])
        ]
        low, high = (np.stack([np.array(end[k]) for end in ends], axis=-1) for k in range(2))
        return low, high

    def draws(self, count: int, seed: int, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Sample nodes (see ``Kernel``)."""
        random = np.random.default_rng(seed).random((1 + self.channels, count, self.count))
        found: dict[str, np.ndarray] = {}
        for span in self.chunks(len(texels)):
            part = texels[span]
            drawn = draw_bins(self.probabilities(part), self.grid.axes, random[..., part])
            for name, values in drawn.items():
                shape = (count, len(texels), values.shape[-1])
                found.setdefault(name, np.empty(shape, np.float32))[:, span] = values
        return found

    def _marginal(self, name: str) -> np.ndarray:
        return self._marginals_of_all[name][..., : self.channels_of(name)]

    @cached_property
    def _marginals_of_all(self) -> dict[str, np.ndarray]:
        return self.marginals(np.arange(self.count))


def require_scale(caller: str, scale: float) -> None:
    """Raise an error unless the radiance unit is positive and finite."""
    if not (np.isfinite(scale) and scale > 0):
        raise OptionError(f"{caller}: scale must be positive, got {scale!r}.")


def observed_by(caller: str, factors: Factors, copies: int, texels: int | None) -> np.ndarray:
    """Return a (T,) bool mask of seen texels; T: ``texels``, or the largest index plus one."""
    texel = factors.texel.numpy()
    last = int(texel.max()) if len(texel) else -1
    total = last + 1 if texels is None else texels
    if copies < 1 or total <= last:
        raise OptionError(
            f"{caller}: copies must be at least 1 and texels greater than {last}, got "
            f"{copies} and {texels}."
        )
    observed = np.zeros(total, bool)
    observed[texel] = np.array(factors.views) > 0
    return observed
