"""Posterior of T texels; results are computed on request."""

from dataclasses import dataclass
from functools import cached_property
from numbers import Integral, Real
from typing import Any, Generic, TypeVar

import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import tensor, to_drjit
from svu_mi.core.validation import indices_of
from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior.grid import Grid
from svu_mi.posterior.kernel import Kernel
from svu_mi.posterior.quadrature import bin_edges

MAX_PROBABILITIES = 1 << 29  # floats; 2 GiB

K = TypeVar("K", bound=Kernel)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Posterior(Generic[K]):
    """Posterior p(psi | B, L) of each of T texels (Eq. 3, 4).

    Attributes:
        kernel: kernel that computes the results of seen texels.
        observed: (T,) bool, mask of seen texels; the posterior of all others is the prior.

    Example:
        >>> posterior = estimate.posterior
        >>> low, high = posterior.interval("roughness", level=0.9)
        >>> draws = posterior.draw(count=4)
        >>> draws["base_color"].shape == (4, texels.count, 3)
        True
    """

    kernel: K
    observed: np.ndarray

    def __repr__(self) -> str:
        return f"<Posterior of {self.count} texels, {self.observed.sum()} seen: {self.grid}>"

    @property
    def grid(self) -> Grid:
        """Parameter grid; its ``axes`` are in the order of the axes of ``probabilities``."""
        return self.kernel.grid

    @property
    def count(self) -> int:
        """Number of texels T."""
        return len(self.observed)

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes of each parameter by name, in the order of the axes of ``probabilities``."""
        return self.grid.axes

    @property
    def channels(self) -> int:
        """Number G of base colours or Ks per texel: 3, or 1 for grey."""
        return self.kernel.channels

    @property
    def continuous(self) -> bool:
        """True if parameters are continuous; False if intervals consist of the grid's bins."""
        return self.kernel.continuous

    @property
    def prior(self) -> np.ndarray:
        """Prior probability of each bin, float64 in the grid's shape, of sum 1."""
        return self.kernel.prior.probabilities

    @property
    def max_entropy(self) -> float:
        """Normalisation of entropies [nats]: log n (Eq. 5); the prior's entropy if calibrated."""
        return self.kernel.prior.max_entropy

    @property
    def prior_entropy(self) -> float:
        """Normalised entropy of unseen texels, in [0, 1]: the prior's entropy (Eq. 5).

        1 if the prior is uniform or the posterior calibrated.
        """
        return self.kernel.prior.entropy

    def entropy(self) -> Any:
        """Return the entropy H = -1/log(n) sum p log p, (T,) TensorXf in [0, 1] (Eq. 5).

        n is the number of bins, including bins that the prior excludes. A calibrated posterior is
        normalised by the prior's entropy instead of log(n), and larger values are clipped to 1:
        the photographs add no information. Entropies of channels are averaged. Unseen texels have
        ``prior_entropy``. The probabilities are not stored.
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
        """Bin probabilities, TensorXf ``(T, *grid)``; ``(T, *grid, 3)`` if base colour has 3
        channels, with the other channels marginalised.

        Raises:
            OptionError: a result of more than 2 GiB; use ``probabilities_of`` for fewer texels.
        """
        return self.probabilities_of(np.arange(self.count))

    def probabilities_of(self, chosen: Any) -> Any:
        """Return the bin probabilities of some texels.

        Args:
            chosen: (t,) indices of texels, or (T,) flags.

        Returns:
            TensorXf ``(t, *grid)`` or ``(t, *grid, 3)``, as ``probabilities``.

        Raises:
            OptionError: an index outside [0, T), or a result of more than 2 GiB.
        """
        chosen = self._indices(chosen)
        shape = (len(chosen), *self.grid.shape, self.channels)
        if np.prod(shape, dtype=float) > MAX_PROBABILITIES:
            raise OptionError(
                f"Posterior.probabilities: {shape} values exceed 2 GiB; use entropy(), "
                "marginal(), map(), or probabilities_of() with fewer texels."
            )
        result = np.empty(shape, np.float32)
        seen = self.observed[chosen]
        result[~seen] = self.prior[..., None]
        places = np.flatnonzero(seen)
        for span in self.kernel.chunks(len(places)):
            result[places[span]] = self.kernel.probabilities(chosen[places[span]])
        return _tensor(result if self.channels > 1 else result[..., 0])

    def marginal(self, name: str, chosen: Any | None = None) -> Any:
        """Return the marginal probabilities of one parameter.

        Args:
            name: name of the parameter.
            chosen: (t,) indices of texels, or (T,) flags; default: all.

        Returns:
            (t, nodes); (t, nodes, 3) for base colour (or Ks) if it has 3 channels.

        Raises:
            OptionError: an unknown parameter, or an index outside [0, T).
        """
        self._check_parameter(name)
        found = self._marginals if chosen is None else self._marginals_of(self._indices(chosen))
        return self._shaped(name, found[name])

    def marginals(self, chosen: Any) -> dict[str, Any]:
        """Return the marginals of all parameters of some texels by name (see ``marginal``)."""
        found = self._marginals_of(self._indices(chosen))
        return {name: self._shaped(name, table) for name, table in found.items()}

    def marginal_entropy(self, name: str) -> Any:
        """Return the normalised entropy of a marginal, (T,), or (T, 3) per channel.

        0 for known parameters, also in unseen texels.
        """
        self._check_parameter(name)
        p = np.array(self.marginal(name), np.float64)
        bits = -np.where(p > 0, p * np.log(np.where(p > 0, p, 1)), 0).sum(axis=1)
        nodes = p.shape[1]
        return _tensor(np.clip(bits / np.log(nodes), 0, 1) if nodes > 1 else 0 * bits)

    def map(self, chosen: Any | None = None) -> dict[str, Any]:
        """Return the most probable bin, by parameter: (t,), or (t, 3) per channel.

        Unseen texels get the most probable bin of the prior. If several are equally probable,
        the one nearest to the middle of the grid is used.

        Args:
            chosen: (t,) indices of texels, or (T,) flags; default: all.

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
        """Return (t, axes, G) indices of the most probable nodes (see ``map``)."""
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
        """Return all marginals, (t, nodes, g), from one pass over the probabilities."""
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
        """Return the posterior mean of a parameter: TensorXf (T,), or (T, 3) per channel.

        Unseen texels have the prior's mean.

        Raises:
            OptionError: an unknown parameter.
        """
        return self._shaped(name, self._mean_and_sd(name)[0])

    def sd(self, name: str) -> Any:
        """Return the standard deviation of a parameter, in the shape of ``mean``."""
        return self._shaped(name, self._mean_and_sd(name)[1])

    def interval(self, name: str, level: float = 0.9, chosen: Any | None = None) -> tuple[Any, Any]:
        """Return the shortest interval that contains a parameter with probability ``level``.

        Interval ends are edges of the grid's bins, or of finer parts (``continuous``). For unseen
        texels, the interval is the support of the prior, by default [0, 1].

        Args:
            name: name of the parameter.
            level: probability, in (0, 1).
            chosen: (t,) indices of texels, or (T,) flags; default: all.

        Returns:
            Lower and upper ends: TensorXf (t,), or (t, 3) per channel.

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
        if not (isinstance(level, Real) and 0 < level < 1):
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
        """Return half the width of ``interval``, TensorXf (t,).

        Of three channels, the one with the widest interval is used. Arguments and errors are as for
        ``interval``.
        """
        texels, low, high = self._allowed(name, level, chosen)
        half, seen = (high - low).max(axis=1) / 2, self.observed[texels]
        if seen.any():
            half[seen] = self.kernel.half_widths(name, level, texels[seen])
        return _tensor(half)

    def draw(self, count: int = 1, seed: int = 0) -> dict[str, Any]:
        """Sample parameters from the posterior, independently for each texel.

        Args:
            count: number of draws.
            seed: seed, a whole number >= 0.

        Returns:
            TensorXf (count, T), or (count, T, 3) per channel, by parameter name. Each draw is a
            joint sample of all parameters. Unseen texels are sampled from the prior. Errors of the
            light, which ``sd`` and ``interval`` of base colour include, are not sampled.

        Raises:
            OptionError: a count below 1, or a seed that is not a whole number >= 0.
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
        """Return the prior's mean and standard deviation: numbers, or (g,) per channel."""
        self._check_parameter(name)
        return self.kernel.prior.moments(name)

    def _mean_and_sd(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation, (T, g); the prior's for unseen texels."""
        shape = (self.count, self.kernel.channels_of(name))
        mean, sd = (np.broadcast_to(np.asarray(x, np.float32), shape).copy()
                    for x in self.prior_moments(name))  # fmt: skip
        if len(self._seen):
            mean[self._seen], sd[self._seen] = self.kernel.moments(name, self._seen)
        return mean, sd

    def _shaped(self, name: str, values: np.ndarray) -> Any:
        """Return values (..., g) as a tensor, without the last axis if channels share values."""
        own = self.kernel.channels_of(name) > 1
        return _tensor(values.copy() if own else values[..., 0].copy())

    def kl(self, other: "Posterior") -> Any:
        """Return KL(p || q) of each texel p to each texel q of ``other``, (T, T').

        Channels are averaged (Sec. 5.2); probabilities below 1e-30 count as 1e-30.

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
        return indices_of(chosen, self.count, "Posterior", "texel")

    def _check_parameter(self, name: str) -> None:
        if name not in list(self.axes):
            known = " or ".join(self.axes)
            raise OptionError(f"Posterior: unknown parameter {name!r}; use {known}.")


def _best_of_prior(prior: np.ndarray) -> np.ndarray:
    """Return the index, (axes,), of a prior's best bin (see ``Posterior.map``)."""
    # Equal probabilities can differ by rounding to single precision.
    likely = np.argwhere(prior >= (1 - 1e-5) * prior.max())
    away = likely - (np.array(prior.shape) // 2 if len(likely) == prior.size
                     else (np.array(prior.shape) - 1) / 2)  # fmt: skip
    return np.asarray(likely[(away**2).sum(axis=1).argmin()])


def _tensor(values: np.ndarray) -> Any:
    return tensor(values, "Posterior", "a result", ["n"] * values.ndim)
