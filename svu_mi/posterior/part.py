"""A posterior of some of the texels of another."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.posterior.record import Posterior


@dataclass(frozen=True, kw_only=True)
class LikeAnother(Posterior):
    """A posterior that has what all texels have in common from another one."""

    @property
    @abstractmethod
    def _another(self) -> Posterior:
        """The other."""

    @property
    def groups(self) -> int:
        """Number of distributions per texel (see ``Posterior``)."""
        return self._another.groups

    @property
    def continuous(self) -> bool:
        """Whether intervals are made of finer parts than cells (see ``Posterior``)."""
        return self._another.continuous

    @property
    def prior(self) -> np.ndarray:
        """Probability of every cell where nobody looked (see ``Posterior``)."""
        return self._another.prior

    @property
    def most(self) -> float:
        """Nats that entropies are a part of (see ``Posterior``)."""
        return self._another.most

    @property
    def prior_entropy(self) -> float:
        """Normalised entropy of a texel nobody saw (see ``Posterior``)."""
        return self._another.prior_entropy

    def prior_moments(self, name: str) -> tuple[Any, Any]:
        """Return mean and standard deviation where nobody looked (see ``Posterior``)."""
        return self._another.prior_moments(name)


@dataclass(frozen=True, kw_only=True)
class PartOfPosterior(LikeAnother):
    """What a posterior says of some of its texels; nothing is computed for the others.

    Attributes:
        whole: of all texels.
        chosen: (t,) int64, which of them.
    """

    whole: Posterior
    chosen: np.ndarray

    @staticmethod
    def of(whole: Posterior, chosen: np.ndarray) -> PartOfPosterior:
        """Take some texels, by their indices."""
        return PartOfPosterior(
            grid=whole.grid, observed=whole.observed[chosen], whole=whole, chosen=chosen
        )

    @property
    def _another(self) -> Posterior:
        return self.whole

    def _entropy_of_all(self) -> Any:
        return dr.gather(mi.Float, self.whole._entropy, owned(mi.UInt32, self.chosen))

    def _tables(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.whole._tables(self.chosen[chosen])

    def _cells(self, chosen: np.ndarray) -> np.ndarray:
        return self.whole._cells(self.chosen[chosen])

    def _best(self, chosen: np.ndarray) -> np.ndarray:
        return self.whole._best(self.chosen[chosen])

    def _moments(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        mean, sd = self.whole._moments(name)
        return mean[self.chosen], sd[self.chosen]

    def _ends(
        self, name: str, level: float, texels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        return self.whole._ends(name, level, self.chosen[texels])

    def _half_widths(self, name: str, level: float, texels: np.ndarray) -> np.ndarray:
        return self.whole._half_widths(name, level, self.chosen[texels])

    def _draws(self, count: int, seed: int) -> dict[str, np.ndarray]:
        drawn = self.whole._draws(count, seed)
        return {name: values[:, self.chosen] for name, values in drawn.items()}

    def _prior_draws(self, count: int, random: np.random.Generator) -> dict[str, np.ndarray]:
        return self.whole._prior_draws(count, random)
