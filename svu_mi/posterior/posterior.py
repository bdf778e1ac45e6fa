"""The posterior of T texels, computed when asked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import Any, Generic, TypeVar

import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import tensor, to_drjit
from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior.grid import Grid
from svu_mi.posterior.kernel import Kernel
from svu_mi.posterior.quadrature import bin_edges

MAX_PROBABILITIES = 1 << 29  # floats; 2 GiB

K = TypeVar("K", bound=Kernel)


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior(Generic[K]):
    """p(psi | B, L) on a grid for each of T texels (Eq. 3, 4).

    Attributes:
        kernel: computes what is asked of texels that are observed.
        observed: (T,) bool; a texel nobody saw has the prior for its posterior.
    """

    kernel: K
    observed: np.ndarray

    @property
    def grid(self) -> Grid:
        """The parameter grid; its ``axes`` name the parameters, in the order of the axes of
        ``probabilities``."""
        return self.kernel.grid

    @property
    def count(self) -> int:
        """Number of texels T."""
        return len(self.observed)

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes of every parameter, by name, in the order of the axes of ``probabilities``."""
        return self.grid.axes

    @property
    def channels(self) -> int:
        """Number G of distributions per texel: 3 when each colour channel has its own, else 1."""
        return self.kernel.channels

    @property
    def continuous(self) -> bool:
        """Whether intervals are made of finer parts than the bins of the grid."""
        return self.kernel.continuous

    @property
    def prior(self) -> np.ndarray:
        """Probability of every bin where nobody looked: float64 of the grid's shape, of sum 1."""
        return self.kernel.prior.probabilities

    @property
    def max_entropy(self) -> float:
        """Nats that entropies are a part of: log n, of the n bins of the grid (Eq. 5); those of
        the prior if it is calibrated."""
        return self.kernel.prior.max_entropy

    @property
    def prior_entropy(self) -> float:
        """Normalised entropy of a texel nobody saw, in [0, 1]: that of the prior (Eq. 5).

        1 without weights of one's own, or if all are equal. The part of log n otherwise: a prior
        that leaves k of n bins, all as likely, says log k / log n. Always 1 where entropies are
        parts of the prior's.
        """
        return self.kernel.prior.entropy

    def entropy(self) -> Any:
        """Return H = -1/log(n) sum p log p, (T,) TensorXf in [0, 1] (Eq. 5).

        n is the number of bins of the grid, also of those that a prior excludes; a texel nobody
        saw has ``prior_entropy``. A calibrated posterior has the prior's entropy in place of
        log(n), of which more is cut off: 1 says that photographs add nothing. When each
        channel has a distribution of its own, the mean of their entropies. Computed in one kernel,
        without the probabilities.
        """
        return mi.TensorXf(self._entropy)

    @cached_property
    def _entropy(self) -> Any:
        values = np.full(self.count, self.prior_entropy, np.float32)
        if len(self._seen):
            values[self._seen] = self.kernel.entropy(self._seen)
        return to_drjit(mi.Float, values)

    @cached_property
    def _seen(self) -> np.ndarray:
        return np.flatnonzero(self.observed)

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
        shape = (len(chosen), *self.grid.shape, self.channels)
        if np.prod(shape, dtype=float) > MAX_PROBABILITIES:
            raise OptionError(
                f"Posterior.probabilities: {shape} values do not fit in 2 GiB; use entropy(), "
                "marginal(), map(), or probabilities_of() fewer texels."
            )
        result = np.empty(shape, np.float32)
        seen = self.observed[chosen]
        result[~seen] = self.prior[..., None]
        places = np.flatnonzero(seen)
        for span in self.kernel.chunks(len(places)):
            result[places[span]] = self.kernel.probabilities(chosen[places[span]])
        return _tensor(result if self.channels > 1 else result[..., 0])

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
        return self._shaped(name, found[name])

    def marginals(self, chosen: Any) -> dict[str, Any]:
        """Return the marginals of all parameters of some texels, as ``marginal`` has each."""
        found = self._marginals_of(self._indices(chosen))
        return {name: self._shaped(name, table) for name, table in found.items()}

    def marginal_entropy(self, name: str) -> Any:
        """Return the normalised entropy of a marginal: (T,), or (T, 3) per channel.

        That of a parameter that is known is 0, also where nobody looked.
        """
        self._check_parameter(name)
        p = np.array(self.marginal(name), np.float64)
        bits = -np.where(p > 0, p * np.log(np.where(p > 0, p, 1)), 0).sum(axis=1)
        nodes = p.shape[1]
        return _tensor(np.clip(bits / np.log(nodes), 0, 1) if nodes > 1 else 0 * bits)

    def map(self, chosen: Any | None = None) -> dict[str, Any]:
        """Return the most probable bin by parameter: (T,), or (T, 3) per channel.

        A texel nobody saw gets the most probable bin of the prior; of several that are as
        likely, that which is nearest to the middle of the grid, and the first of these.

        Args:
            chosen: (t,) indices of texels; all by default.

        Raises:
            OptionError: an index outside [0, T).
        """
        best = self._best if chosen is None else self._best_of(self._indices(chosen))
        values = {name: nodes[best[:, k]] for k, (name, nodes) in enumerate(self.axes.items())}
        return {
            name: self._shaped(name, table[..., : self.kernel.channels_of(name)])
            for name, table in values.items()
        }

    @cached_property
    def _best(self) -> np.ndarray:
        return self._best_of(np.arange(self.count))

    def _best_of(self, chosen: np.ndarray) -> np.ndarray:
        """Indices (t, axes, G) of the most probable nodes, of the prior's where nobody looked."""
        seen = self.observed[chosen]
        best = np.empty((len(chosen), len(self.axes), self.channels), np.int64)
        best[~seen] = _best_of_prior(self.prior)[:, None]
        if seen.any():
            best[seen] = self.kernel.best(chosen[seen])
        return best

    @cached_property
    def _marginals(self) -> dict[str, np.ndarray]:
        return self._marginals_of(np.arange(self.count))

    def _marginals_of(self, chosen: np.ndarray) -> dict[str, np.ndarray]:
        """All marginals (t, nodes, g) of some texels, from one pass over the probabilities."""
        seen, found = self.observed[chosen], {}
        known = self.kernel.marginals(chosen[seen]) if seen.any() else {}
        for name, nodes in self.axes.items():
            g = self.kernel.channels_of(name)
            table = np.empty((len(chosen), len(nodes), g), np.float32)
            table[~seen] = self.kernel.prior.marginal(name)[:, None]
            if known:
                table[seen] = known[name][..., :g]
            found[name] = table
        return found

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

    def interval(self, name: str, level: float = 0.9, chosen: Any | None = None) -> tuple[Any, Any]:
        """Return the shortest interval that holds a parameter with a probability.

        It is made of parts of the parameter's range (bins of the grid, or finer), and goes to
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
            low[seen], high[seen] = self.kernel.ends(name, level, texels[seen])
        return self._shaped(name, low), self._shaped(name, high)

    def _allowed(
        self, name: str, level: float, chosen: Any | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return texels (t,) and both ends of the prior's support, (t, g)."""
        self._check_parameter(name)
        if not 0 < level < 1:
            raise OptionError(f"Posterior.interval(): level must be in (0, 1), got {level!r}.")
        texels = np.arange(self.count) if chosen is None else self._indices(chosen)
        edges = bin_edges(self.axes[name])
        allowed = np.flatnonzero(self.kernel.prior.marginal(name))
        low, high = (
            np.full((len(texels), self.kernel.channels_of(name)), edges[end], np.float32)
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
            half[seen] = self.kernel.half_widths(name, level, texels[seen])
        return _tensor(half)

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
        count, seed, unseen = int(count), int(seed), np.flatnonzero(~self.observed)
        drawn = {name: np.empty((count, self.count, self.kernel.channels_of(name)), np.float32)
                 for name in self.axes}  # fmt: skip
        known = self.kernel.draws(count, seed, self._seen) if len(self._seen) else {}
        for name, values in known.items():
            drawn[name][:, self._seen] = values
        for number in range(count if len(unseen) else 0):
            random = np.random.default_rng((seed, number))
            for name, values in self.kernel.prior.draws(len(unseen), random).items():
                drawn[name][number, unseen] = values[:, None]
        return {name: self._shaped(name, values) for name, values in drawn.items()}

    def prior_moments(self, name: str) -> tuple[Any, Any]:
        """Return mean and standard deviation of a parameter where nobody looked: numbers, or (g,)
        by channel."""
        return self.kernel.prior.moments(name)

    def _mean_and_sd(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(T, g) both; those of the prior where nobody looked."""
        self._check_parameter(name)
        shape = (self.count, self.kernel.channels_of(name))
        mean, sd = (np.broadcast_to(np.asarray(x, np.float32), shape).copy()
                    for x in self.prior_moments(name))  # fmt: skip
        if len(self._seen):
            mean[self._seen], sd[self._seen] = self.kernel.moments(name, self._seen)
        return mean, sd

    def _shaped(self, name: str, values: np.ndarray) -> Any:
        """Values (..., g) as a tensor; without the last axis where there is one for all."""
        own = self.kernel.channels_of(name) > 1
        return _tensor(values.copy() if own else values[..., 0].copy())

    def kl(self, other: Posterior) -> Any:
        """Return KL(p || q) of every texel p to every texel q of another: (T, T') (Sec. 5.2).

        sum p log p - p . log q, one matrix product; the mean over channels when each has its
        own distribution. Probabilities below 1e-30 count as 1e-30.

        Raises:
            ShapeError: the grids differ.
        """
        bins = int(np.prod(self.grid.shape)) * self.channels
        if self.grid != other.grid or self.channels != other.channels:
            raise ShapeError(f"Posterior.kl(): the grids differ: {self.grid} and {other.grid}.")
        p = np.array(self.probabilities, np.float64).reshape(self.count, bins)
        q = np.array(other.probabilities, np.float64).reshape(other.count, bins)
        log_p, log_q = np.log(np.maximum(p, 1e-30)), np.log(np.maximum(q, 1e-30))
        divergence = (p * log_p).sum(axis=1)[:, None] - p @ log_q.T
        return _tensor(np.maximum(divergence, 0) / self.channels)

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
    """Return the index (axes,) of the bin that stands for a prior; see ``Posterior.map``."""
    # The tables that a prior is kept in are rounded, some in single precision.
    likely = np.argwhere(prior >= (1 - 1e-5) * prior.max())
    away = likely - (np.array(prior.shape) // 2 if len(likely) == prior.size
                     else (np.array(prior.shape) - 1) / 2)  # fmt: skip
    return np.asarray(likely[(away**2).sum(axis=1).argmin()])


def _tensor(values: np.ndarray) -> Any:
    return tensor(values, "Posterior", "a result", ["n"] * values.ndim)
