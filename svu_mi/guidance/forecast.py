"""Expected entropy of texels with additional photographs: the interface of both methods.

Eq. 13 averages over truths drawn from the posterior of each texel: bins of a grid, or rows with
the colour that the photographs give (``objectives.py``). Small grids are enumerated. From large
ones, K bins are drawn by systematic sampling; all candidates share the draws.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.guidance.objectives import Measure
from svu_mi.guidance.predicted_responses import Responses
from svu_mi.posterior.grid import Grid


@dataclass(frozen=True)
class Hypotheses:
    """Cells psi_0, number k T + t, and probabilities of T texels; ``counts`` (T,) of K are used."""

    bins: Any
    weights: Any
    counts: Any

    def at(self, number: Any, texel: Any) -> tuple[Any, Any]:
        """Read cell and probability of a hypothesis of texels, by its number."""
        place = number * self._stride + texel
        return dr.gather(mi.UInt32, self.bins, place), dr.gather(mi.Float, self.weights, place)

    def of_texels(self, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which of L texels hypotheses are of, and their numbers: (N,) int64 each."""
        counts = self.counts.numpy()[texels].astype(np.int64)
        place = np.repeat(np.arange(len(texels)), counts)
        return place, np.arange(len(place)) - (np.cumsum(counts) - counts)[place]

    @cached_property
    def _stride(self) -> Any:
        return dr.opaque(mi.UInt32, dr.width(self.counts))

    @staticmethod
    def draw(
        probabilities: np.ndarray, most: int, starts: np.ndarray, possible: int | None = None
    ) -> Hypotheses:
        """Draw ``most`` bins of (T, N) probabilities, or enumerate them if there are no more.

        ``starts`` is (T,) random in [0, 1); ``possible`` counts bins that the prior allows.
        """
        total = probabilities.sum(axis=1, keepdims=True, dtype=np.float64)
        if most >= (probabilities.shape[1] if possible is None else possible):
            weights = probabilities / total
        else:
            weights = _systematic_sample(np.cumsum(probabilities / total, axis=1), most, starts)
        return Hypotheses.of(weights)

    @staticmethod
    def of(weights: np.ndarray) -> Hypotheses:
        """Take the bins of positive weight (T, N), the heaviest first."""
        counts = (weights > 0).sum(axis=1)
        most = max(int(counts.max(initial=0)), 1)
        bins = np.argpartition(-weights, min(most, weights.shape[1] - 1), axis=1)[:, :most]
        part = np.take_along_axis(weights, bins, axis=1)
        order = np.argsort(-part, axis=1, kind="stable")
        bins, part = (np.take_along_axis(x, order, axis=1) for x in (bins, part))
        return Hypotheses(
            bins=to_drjit(mi.UInt32, bins.T.astype(np.uint32).ravel()),
            weights=to_drjit(mi.Float, part.T.astype(np.float32).ravel()),
            counts=to_drjit(mi.UInt32, counts.astype(np.uint32)),
        )


def _systematic_sample(cumulative: np.ndarray, most: int, starts: np.ndarray) -> np.ndarray:
    """Return (T, N) shares k / K of bins drawn at equal steps of probability."""
    # How many of the points (i + start) / K lie below the end of every cell.
    below = np.clip(np.ceil(cumulative * most - starts[:, None]), 0, most)
    below[cumulative >= cumulative[:, -1:]] = most  # the last cell that is possible, and others
    return np.diff(below, axis=1, prepend=0) / most


@dataclass(frozen=True)
class Forecast(ABC):
    """Expected entropies of T texels. Views are numbered: photographs first, then candidates.

    Attributes:
        hypotheses: psi of Eq. 13, and p(psi | B, L).
        prior: Float, -log prior of every cell, or row; or None.
    """

    responses: Responses
    hypotheses: Hypotheses
    grid: Grid
    prior: Any | None
    measure: Measure

    @cached_property
    def seen(self) -> np.ndarray:
        """(V, T) bool, which view sees which texel."""
        return self.responses.seen

    @property
    def count(self) -> int:
        """T."""
        return int(self.responses.count[0])

    def current(self, views: np.ndarray) -> np.ndarray:
        """Return E[H] (T,) of photographs from some views; of unseen texels, H of the prior."""
        seen = self.seen[views].any(axis=0)
        result = np.full(self.count, self.measure.unseen, np.float32)
        if seen.any():
            result[seen] = self._evaluate(views, None, np.flatnonzero(seen))[0]
        return result

    def expected(self, views: np.ndarray, candidates: np.ndarray, texels: np.ndarray) -> np.ndarray:
        """Return E[H] with views and one candidate (Eq. 13): (A, L); NaN where it does not see."""
        if not len(candidates) or not len(texels):
            return np.empty((len(candidates), len(texels)), np.float32)
        values = self._evaluate(views, candidates, texels)
        return np.where(self.seen[np.ix_(candidates, texels)], values, np.nan)

    def cumulative(self, views: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """Return E[H] of some views, then with each of A candidates in addition: (A + 1, T)."""
        steps = [self.current(views)]
        for k, candidate in enumerate(candidates):
            texels = np.flatnonzero(self.seen[candidate])
            after = steps[-1].copy()
            so_far = np.append(views, candidates[:k])
            after[texels] = self.expected(so_far, candidates[k : k + 1], texels)[0]
            steps.append(after)
        return np.stack(steps)

    @property
    def is_separable(self) -> bool:
        """Whether E[H] of a texel stays when a view is added that does not see it."""
        return True

    @abstractmethod
    def _evaluate(
        self, views: np.ndarray, candidates: np.ndarray | None, texels: np.ndarray
    ) -> np.ndarray:
        """As ``expected``; anything where not seen. Without candidates, (1, L) of the views."""


def numbers(values: np.ndarray | list[int]) -> Any:
    """Return indices as UInt32."""
    return to_drjit(mi.UInt32, np.asarray(values, np.uint32))
