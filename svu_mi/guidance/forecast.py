"""Expected entropy of texels with additional photographs: interface of both methods.

Eq. 13 averages over truths drawn from the posterior of each texel. A truth is a grid cell, or a row
with its best base colour (``objectives.py``). Small grids are enumerated. From large grids, K cells
are drawn by systematic sampling; all candidates share the draws.
"""

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
    """Cells and probabilities of hypotheses psi_0 for T texels, (K T,) each.

    Hypothesis k of texel t has the index k T + t. Each texel uses its first ``counts`` (T,) ones.
    """

    bins: Any
    weights: Any
    counts: Any

    def at(self, number: Any, texel: Any) -> tuple[Any, Any]:
        """Return cell and probability of the hypothesis with index ``number``, per texel."""
        place = number * self._stride + texel
        return dr.gather(mi.UInt32, self.bins, place), dr.gather(mi.Float, self.weights, place)

    def of_texels(self, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """List all N hypotheses: indices into ``texels`` and within the texel, (N,) int64 each."""
        counts = self.counts.numpy()[texels].astype(np.int64)
        place = np.repeat(np.arange(len(texels)), counts)
        return place, np.arange(len(place)) - (np.cumsum(counts) - counts)[place]

    @cached_property
    def _stride(self) -> Any:
        return dr.opaque(mi.UInt32, dr.width(self.counts))

    @staticmethod
    def draw(
        probabilities: np.ndarray, most: int, starts: np.ndarray, possible: int | None = None
    ) -> "Hypotheses":
        """Draw ``most`` cells per texel from (T, N) probabilities, or list all if they suffice.

        ``starts`` are (T,) random in [0, 1); ``possible`` (default N) cells have a prior above 0.
        """
        total = probabilities.sum(axis=1, keepdims=True, dtype=np.float64)
        if most >= (probabilities.shape[1] if possible is None else possible):
            weights = probabilities / total
        else:
            weights = _systematic_sample(np.cumsum(probabilities / total, axis=1), most, starts)
        return Hypotheses.of(weights)

    @staticmethod
    def of(weights: np.ndarray) -> "Hypotheses":
        """Create hypotheses from all positive ``weights`` (T, N), largest weight first."""
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
    """Draw K cells at equal steps of probability; return each cell's share of draws, (T, N)."""
    # Number of points (i + start) / K below the upper end of each cell.
    below = np.clip(np.ceil(cumulative * most - starts[:, None]), 0, most)
    below[cumulative >= cumulative[:, -1:]] = most  # rounding must not lose the last point
    return np.diff(below, axis=1, prepend=0) / most


@dataclass(frozen=True)
class Forecast(ABC):
    """Expected entropies of T texels. View indices: photographs first, then candidates.

    Attributes:
        hypotheses: psi of Eq. 13 and p(psi | B, L).
        prior: Float, -log prior of every cell or row; None if uniform.
    """

    responses: Responses
    hypotheses: Hypotheses
    grid: Grid
    prior: Any | None
    measure: Measure

    @cached_property
    def seen(self) -> np.ndarray:
        """Visibility of texels in views, (V, T) bool."""
        return self.responses.seen

    @property
    def count(self) -> int:
        """Number of texels, T."""
        return int(self.responses.count[0])

    def current(self, views: np.ndarray) -> np.ndarray:
        """Return E[H] with photographs from ``views``, (T,); the prior's H for unseen texels."""
        seen = self.seen[views].any(axis=0)
        result = np.full(self.count, self.measure.unseen, np.float32)
        if seen.any():
            result[seen] = self._evaluate(views, None, np.flatnonzero(seen))[0]
        return result

    def expected(self, views: np.ndarray, candidates: np.ndarray, texels: np.ndarray) -> np.ndarray:
        """Return E[H] with views and one of A candidates (Eq. 13), (A, L); NaN if not seen."""
        if not len(candidates) or not len(texels):
            return np.empty((len(candidates), len(texels)), np.float32)
        values = self._evaluate(views, candidates, texels)
        return np.where(self.seen[np.ix_(candidates, texels)], values, np.nan)

    def cumulative(self, views: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """Return E[H] with ``views``, then with candidates added one by one: (A + 1, T)."""
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
        """True if views that do not see a texel leave its E[H] unchanged."""
        return True

    @abstractmethod
    def _evaluate(
        self, views: np.ndarray, candidates: np.ndarray | None, texels: np.ndarray
    ) -> np.ndarray:
        """Return E[H] as ``expected``, arbitrary for unseen texels; (1, L) without candidates."""


def numbers(values: np.ndarray | list[int]) -> Any:
    """Return indices as a UInt32 array."""
    return to_drjit(mi.UInt32, np.asarray(values, np.uint32))
