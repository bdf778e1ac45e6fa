"""The posterior of T texels: what it says, computed when asked."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError, ShapeError
from svu_mi.interop import owned, tensor
from svu_mi.posterior.cells import draw_cells, marginals_of
from svu_mi.posterior.grid import Grid
from svu_mi.posterior.intervals import shortest
from svu_mi.posterior.nodes import cell_edges, cells_of
from svu_mi.posterior.streaming import entropy_of
from svu_mi.statistics.blocks import in_blocks

CHUNK = 1 << 22  # cells per pass of everything that is not the entropy
MAX_PROBABILITIES = 1 << 29  # floats; 2 GiB


@dataclass(frozen=True, kw_only=True)
class Posterior(ABC):
    """p(psi | B, L) on a grid for each of T texels (Eq. 3, 4).

    Attributes:
        grid: the parameter grid; its ``axes`` name the parameters, in the order of the axes of
            ``probabilities``.
        observed: (T,) bool; a texel nobody saw has the prior for its posterior.
    """

    grid: Grid
    observed: np.ndarray

    @property
    def count(self) -> int:
        """Number of texels T."""
        return len(self.observed)

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes of every parameter, by name, in the order of the axes of ``probabilities``."""
        return self.grid.axes

    @property
    def groups(self) -> int:
        """Number G of distributions per texel: 3 when each colour channel has its own, else 1."""
        return 1

    @property
    def continuous(self) -> bool:
        """Whether intervals are made of finer parts than the cells of the grid."""
        return False

    @property
    def prior(self) -> np.ndarray:
        """Probability of every cell where nobody looked: float64 of the grid's shape, of sum 1."""
        return np.full(self.grid.shape, 1 / np.prod(self.grid.shape))

    @property
    def most(self) -> float:
        """Nats that entropies are a part of: log n, of the n cells of the grid (Eq. 5)."""
        return float(np.log(np.prod(self.grid.shape)))

    @property
    def prior_entropy(self) -> float:
        """Normalised entropy of a texel nobody saw, in [0, 1]: that of the prior (Eq. 5).

        1 without weights of one's own, or if all are equal. The part of log n otherwise: a prior
        that leaves k of n cells, all as likely, says log k / log n. Always 1 where entropies are
        parts of the prior's.
        """
        return min(entropy_of(self.prior) / self.most, 1.0)

    @abstractmethod
    def _entropy_of_all(self) -> Any:
        """Normalised entropy, (T,) Float, of texels as if all were observed; T > 0."""

    @abstractmethod
    def _tables(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return p and the best nodes of some texels, as if they were observed.

        Args:
            chosen: (t,) int64 indices of texels.

        Returns:
            p (t, *grid, G) float32, and the index of the best node (t, axes, G).
        """

    def entropy(self) -> Any:
        """Return H = -1/log(n) sum p log p, (T,) TensorXf in [0, 1] (Eq. 5).

        n is the number of cells of the grid, also of those that a prior excludes; a texel nobody
        saw has ``prior_entropy``. A calibrated posterior has the prior's entropy in place of
        log(n), of which more is cut off: 1 says that photographs add nothing. When each
        channel has a distribution of its own, the mean of their entropies. Computed in one kernel,
        without the probabilities.
        """
        return mi.TensorXf(self._entropy)

    @cached_property
    def _entropy(self) -> Any:
        if self.count == 0:
            return mi.Float()
        # Opaque: as a literal, every prior would compile a kernel of its own.
        unseen = dr.opaque(mi.Float, self.prior_entropy)
        value = dr.select(owned(mi.Bool, self.observed), self._entropy_of_all(), unseen)
        dr.eval(value)
        return value

    @property
    def probabilities(self) -> Any:
        """p, TensorXf ``(T, *grid)``; or ``(T, *grid, 3)`` when each channel has its own.

        The last axis then holds one distribution per channel, each with the other channels
        marginalised.

        Raises:
            OptionError: it would take more than 2 GiB; ask for ``probabilities_of`` some.
        """
        return self.probabilities_of(np.arange(self.count))

    def probabilities_of(self, chosen: Any) -> Any:
        """Return p of some texels.

        Args:
            chosen: (t,) indices of texels.

        Returns:
            TensorXf ``(t, *grid)`` or ``(t, *grid, 3)``, as ``probabilities`` has it.

        Raises:
            OptionError: an index outside [0, T), or a result of more than 2 GiB.
        """
        chosen = self._indices(chosen)
        shape = (len(chosen), *self.grid.shape, self.groups)
        if np.prod(shape, dtype=float) > MAX_PROBABILITIES:
            raise OptionError(
                f"Posterior.probabilities: {shape} values do not fit in 2 GiB; use entropy(), "
                "marginal(), map(), or probabilities_of() fewer texels."
            )
        result, seen = np.empty(shape, np.float32), np.flatnonzero(self.observed[chosen])
        result[~self.observed[chosen]] = self.prior[..., None]
        for span in self._chunks(len(seen)):
            result[seen[span]] = self._cells(chosen[seen[span]])
        return _tensor(result if self.groups > 1 else result[..., 0])

    def marginal(self, name: str, chosen: Any | None = None) -> Any:
        """Return the marginal of one parameter.

        Args:
            name: a name of ``axes``.
            chosen: (t,) indices of texels; all by default.

        Returns:
            (t, nodes); or (t, nodes, 3) when each channel has its own and they differ, which
            they do not for what channels share (roughness, metallic).

        Raises:
            OptionError: an unknown parameter, or an index outside [0, T).
        """
        self._check_parameter(name)
        found = self._marginals if chosen is None else self._marginals_of(self._indices(chosen))
        return _tensor(found[name].copy())

    def marginals(self, chosen: Any) -> dict[str, Any]:
        """Return the marginals of all parameters of some texels, as ``marginal`` has each."""
        found = self._marginals_of(self._indices(chosen))
        return {name: _tensor(table.copy()) for name, table in found.items()}

    def marginal_entropy(self, name: str) -> Any:
        """Return the normalised entropy of a marginal: (T,), or (T, 3) per channel.

        That of a parameter that is known is 0, also where nobody looked.
        """
        self._check_parameter(name)
        p = self._marginals[name].astype(np.float64)
        bits = -np.where(p > 0, p * np.log(np.where(p > 0, p, 1)), 0).sum(axis=1)
        nodes = p.shape[1]
        return _tensor(np.clip(bits / np.log(nodes), 0, 1) if nodes > 1 else 0 * bits)

    def map(self, chosen: Any | None = None) -> dict[str, Any]:
        """Return the most probable cell by parameter: (T,), or (T, 3) per channel.

        A texel nobody saw gets the most probable cell of the prior; of several that are as
        likely, that which is nearest to the middle of the grid, and the first of these.

        Args:
            chosen: (t,) indices of texels; all by default.

        Raises:
            OptionError: an index outside [0, T).
        """
        best = self._best_of_all if chosen is None else self._best_of(self._indices(chosen))
        values = {name: nodes[best[:, k]] for k, (name, nodes) in enumerate(self.axes.items())}
        return {
            name: _tensor((table[..., 0] if name in self._shared else table).copy())
            for name, table in values.items()
        }

    @cached_property
    def _best_of_all(self) -> np.ndarray:
        return self._best_of(np.arange(self.count))

    def _best_of(self, chosen: np.ndarray) -> np.ndarray:
        """Indices (t, axes, G) of the most probable nodes, of the prior's where nobody looked."""
        seen = self.observed[chosen]
        best = np.empty((len(chosen), len(self.axes), self.groups), np.int64)
        best[~seen] = _best_of_prior(self.prior)[:, None]
        if seen.any():
            best[seen] = self._best(chosen[seen])
        return best

    def _cells(self, chosen: np.ndarray) -> np.ndarray:
        """p (t, *grid, G) float32 of some texels, as if observed."""
        return self._tables(chosen)[0]

    def _best(self, chosen: np.ndarray) -> np.ndarray:
        """Indices (t, axes, G) of the most probable nodes of some texels, as if observed."""
        best = np.empty((len(chosen), len(self.axes), self.groups), np.int64)
        for span in self._chunks(len(chosen)):
            best[span] = self._tables(chosen[span])[1]
        return best

    @property
    def _shared(self) -> list[str]:
        """Parameters that all channels have in common: only the last may be a channel's own."""
        return list(self.axes) if self.groups == 1 else list(self.axes)[:-1]

    @cached_property
    def _marginals(self) -> dict[str, Any]:
        return self._marginals_of(np.arange(self.count))

    def _marginals_of(self, chosen: np.ndarray) -> dict[str, Any]:
        """All marginals of some texels, from one pass over the probabilities."""
        axes = self.axes
        marginals: dict[str, Any] = {
            name: np.broadcast_to(p[:, None], (len(chosen), len(p), self.groups)).astype(np.float32)
            for name, p in marginals_of(self.prior, list(axes)).items()
        }
        observed = self.observed[chosen]
        for span in self._chunks(len(chosen)):
            p, seen = self._cells(chosen[span]), observed[span]
            for axis, marginal in enumerate(marginals.values(), 1):
                others = tuple(k for k in range(1, len(axes) + 1) if k != axis)
                marginal[span][seen] = p.sum(axis=others)[seen]
        return marginals | {name: marginals[name][..., 0] for name in self._shared}

    def mean(self, name: str) -> Any:
        """Return the mean of a parameter: TensorXf (T,), or (T, 3) where channels have their own.

        Where nobody looked, that of the prior.

        Raises:
            OptionError: an unknown parameter.
        """
        return self._shaped(name, self._mean_and_sd(name)[0])

    def sd(self, name: str) -> Any:
        """Return the standard deviation of a parameter: TensorXf (T,) or (T, 3), as ``mean``."""
        return self._shaped(name, self._mean_and_sd(name)[1])

    def interval(
        self, name: str, level: float = 0.9, chosen: Any | None = None
    ) -> tuple[Any, Any]:
        """Return the shortest interval that holds a parameter with a probability.

        It is made of parts of the parameter's range (cells of the grid, or finer), and goes to
        the outer edges of the first and the last. Where nobody looked it is all that the prior
        allows, [0, 1] without a prior of one's own.

        Args:
            name: a name of ``axes``.
            level: the probability, in (0, 1).
            chosen: (t,) indices of texels; all by default.

        Returns:
            low and high: TensorXf (t,), or (t, 3) where channels have their own.

        Raises:
            OptionError: an unknown parameter, a level outside (0, 1), or an index outside
                [0, T).
        """
        texels, low, high = self._allowed(name, level, chosen)
        seen = self.observed[texels]
        if seen.any():
            low[seen], high[seen] = self._ends(name, level, texels[seen])
        return self._shaped(name, low), self._shaped(name, high)

    def _allowed(
        self, name: str, level: float, chosen: Any | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Texels (t,), and both ends of what the prior allows them, (t, g); errors of
        ``interval``."""
        self._check_parameter(name)
        if not 0 < level < 1:
            raise OptionError(f"Posterior.interval(): level must be in (0, 1), got {level!r}.")
        texels = np.arange(self.count) if chosen is None else self._indices(chosen)
        edges = cell_edges(self.axes[name])
        allowed = np.flatnonzero(marginals_of(self.prior, list(self.axes))[name])
        channels = 1 if name in self._shared else self.groups
        low, high = (
            np.full((len(texels), channels), edges[end], np.float32)
            for end in (allowed[0], allowed[-1] + 1)
        )
        return texels, low, high

    def half_width(self, name: str, level: float = 0.9, chosen: Any | None = None) -> Any:
        """Return half the width of ``interval``: TensorXf (t,).

        Of channels that have their own, that of the widest, which is taken to be the one of the
        largest standard deviation: no intervals are computed of the others.

        Arguments and errors are those of ``interval``.
        """
        texels, low, high = self._allowed(name, level, chosen)
        half, seen = (high - low).max(axis=1) / 2, self.observed[texels]
        if seen.any():
            half[seen] = self._half_widths(name, level, texels[seen])
        return _tensor(half)

    def _half_widths(self, name: str, level: float, texels: np.ndarray) -> np.ndarray:
        """(t,) of some texels, as if observed (see ``half_width``)."""
        low, high = self._ends(name, level, texels)
        half = (high - low) / 2
        widest = 0 if half.shape[1] == 1 else self._moments(name)[1][texels].argmax(axis=1)
        return half[np.arange(len(half)), widest]

    def draw(self, count: int = 1, seed: int = 0) -> dict[str, Any]:
        """Draw parameters of all texels, each texel for itself.

        Args:
            count: number of draws.
            seed: of the draws, a whole number that is not negative; equal seeds draw the same.

        Returns:
            By parameter TensorXf (count, T), or (count, T, 3) where channels have their own;
            parameters of one draw belong together. Where nobody looked, from the prior.

        Raises:
            OptionError: a count below 1, or a seed that is not a whole number.
        """
        for name, value, least in (("count", count, 1), ("seed", seed, 0)):
            if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
                raise OptionError(
                    f"Posterior.draw(): {name} must be a whole number >= {least}, got {value!r}."
                )
        drawn = self._draws(int(count), int(seed))
        unseen = np.flatnonzero(~self.observed)
        for number in range(int(count) if len(unseen) else 0):
            random = np.random.default_rng((int(seed), number))
            for name, values in self._prior_draws(len(unseen), random).items():
                drawn[name][number, unseen] = values[:, None]
        return {name: self._shaped(name, values) for name, values in drawn.items()}

    def _mean_and_sd(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(T, g) both; those of the prior where nobody looked."""
        self._check_parameter(name)
        mean, sd = self._moments(name)
        mean[~self.observed], sd[~self.observed] = self.prior_moments(name)
        return mean, sd

    def prior_moments(self, name: str) -> tuple[Any, Any]:
        """Return mean and standard deviation of a parameter where nobody looked: numbers, or (g,)
        by channel."""
        nodes, p = self.axes[name], marginals_of(self.prior, list(self.axes))[name]
        mean = float(p @ nodes)
        return mean, float(np.sqrt(p @ (nodes - mean) ** 2))

    def _prior_draws(self, count: int, random: np.random.Generator) -> dict[str, np.ndarray]:
        """Parameters where nobody looked, (count,) by name; grey."""
        cells = random.choice(self.prior.size, count, p=self.prior.ravel())
        index = np.unravel_index(cells, self.grid.shape)
        return {
            name: nodes[k] for (name, nodes), k in zip(self.axes.items(), index, strict=True)
        }

    def _moments(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation of a parameter, (T, g) float32, of texels that were seen."""
        p = self._grouped(name).astype(np.float64)
        nodes = self.axes[name][:, None]
        mean = (p * nodes).sum(axis=1)
        variance = (p * (nodes - mean[:, None]) ** 2).sum(axis=1)
        return mean.astype(np.float32), np.sqrt(variance).astype(np.float32)

    def _ends(
        self, name: str, level: float, texels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Ends of intervals, (t, g) float32, of texels, as if they were seen."""
        nodes, p = self.axes[name], self._grouped(name)[texels]
        parts = cells_of(nodes)
        ends = [
            shortest(in_blocks(mi.Float, p[..., g].T), parts, len(texels), level)
            for g in range(p.shape[-1])
        ]
        low, high = (np.stack([np.array(end[k]) for end in ends], axis=-1) for k in range(2))
        return low, high

    def _grouped(self, name: str) -> np.ndarray:
        """A marginal as (T, nodes, g), whether channels have their own or not."""
        p = self._marginals[name]
        return p if p.ndim == 3 else p[..., None]

    def _draws(self, count: int, seed: int) -> dict[str, np.ndarray]:
        """Draws (count, T, g) float32 by parameter, of texels that were seen: nodes of the grid."""
        random = np.random.default_rng(seed)
        found = [
            draw_cells(self._cells(np.arange(self.count)[span]), self.axes, count, random)
            for span in self._chunks(self.count)
        ]
        empty = {name: np.zeros((count, 0, 1), np.float32) for name in self.axes}
        return {
            name: np.concatenate([x[name] for x in found] or [empty[name]], axis=1)
            for name in self.axes
        }

    def _shaped(self, name: str, values: np.ndarray) -> Any:
        """Values (..., g) as a tensor; without the last axis where there is one for all."""
        own = self.groups > 1 and name == list(self.axes)[-1]
        return _tensor(values.copy() if own else values[..., 0].copy())

    def kl(self, other: Posterior) -> Any:
        """Return KL(p || q) of every texel p to every texel q of another: (T, T') (Sec. 5.2).

        sum p log p - p . log q, one matrix product; the mean over channels when each has its
        own distribution. Probabilities below 1e-30 count as 1e-30.

        Raises:
            ShapeError: the grids differ.
        """
        cells = int(np.prod(self.grid.shape)) * self.groups
        if self.grid != other.grid or self.groups != other.groups:
            raise ShapeError(f"Posterior.kl(): the grids differ: {self.grid} and {other.grid}.")
        p = np.array(self.probabilities, np.float64).reshape(self.count, cells)
        q = np.array(other.probabilities, np.float64).reshape(other.count, cells)
        log_p, log_q = np.log(np.maximum(p, 1e-30)), np.log(np.maximum(q, 1e-30))
        divergence = (p * log_p).sum(axis=1)[:, None] - p @ log_q.T
        return _tensor(np.maximum(divergence, 0) / self.groups)

    def _chunks(self, count: int) -> Iterator[slice]:
        size = max(CHUNK // (int(np.prod(self.grid.shape)) * self.groups), 1)
        for first in range(0, count, size):
            yield slice(first, min(first + size, count))

    def _indices(self, chosen: Any) -> np.ndarray:
        indices = np.array(chosen, np.int64).reshape(-1)
        if len(indices) and not (indices.min() >= 0 and indices.max() < self.count):
            raise OptionError(
                f"Posterior: texels are numbered 0 to {self.count - 1}, got "
                f"{indices.min()} to {indices.max()}."
            )
        return indices

    def _check_parameter(self, name: str) -> None:
        if name not in self.axes:
            known = " or ".join(self.axes)
            raise OptionError(f"Posterior: there is no parameter {name!r}; use {known}.")


def _best_of_prior(prior: np.ndarray) -> np.ndarray:
    """Return the index (axes,) of the cell that stands for a prior; see ``Posterior.map``."""
    # The tables that a prior is kept in are rounded, some in single precision.
    likely = np.argwhere(prior >= (1 - 1e-5) * prior.max())
    away = likely - (np.array(prior.shape) // 2 if len(likely) == prior.size
                     else (np.array(prior.shape) - 1) / 2)  # fmt: skip
    return np.asarray(likely[(away**2).sum(axis=1).argmin()])


def _tensor(values: np.ndarray) -> Any:
    return tensor(values, "Posterior", "a result", ["n"] * values.ndim)
