"""What photographs that nobody has taken would say: the interface of both methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.guidance.hypotheses import Hypotheses
from svu_mi.guidance.measures import Measure
from svu_mi.guidance.responses import Responses
from svu_mi.interop import owned
from svu_mi.posterior.grid import Grid


@dataclass(frozen=True)
class Forecast(ABC):
    """Expected entropies of T texels.

    Views are numbered: first those with photographs, then the candidates.

    Attributes:
        responses: of all views.
        hypotheses: psi of Eq. 13, and p(psi | B, L).
        grid: of parameters.
        prior: Float, -log prior of every cell, or of every row; or None.
        measure: what is expected.
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

    def now(self, views: np.ndarray) -> np.ndarray:
        """Return E[H] (T,) of photographs from some views; where none of them sees a texel, H of
        the prior."""
        seen = self.seen[views].any(axis=0)
        result = np.full(self.count, self.measure.unseen, np.float32)
        if seen.any():
            result[seen] = self._evaluate(views, None, np.flatnonzero(seen))[0]
        return result

    def expected(
        self, views: np.ndarray, candidates: np.ndarray, texels: np.ndarray
    ) -> np.ndarray:
        """Return E[H] of photographs from some views and one candidate (Eq. 13).

        Args:
            views: v' numbers.
            candidates: A numbers, none of them among ``views``.
            texels: (L,) of the T.

        Returns:
            (A, L) float32; NaN where the candidate does not see the texel.
        """
        if not len(candidates) or not len(texels):
            return np.empty((len(candidates), len(texels)), np.float32)
        found = self._evaluate(views, candidates, texels)
        return np.where(self.seen[np.ix_(candidates, texels)], found, np.nan)

    def one_by_one(self, views: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """Return E[H] of photographs from some views, then with each candidate as well: (A + 1, T).

        Args:
            views: v' numbers.
            candidates: A numbers, in the order in which they are photographed.
        """
        steps = [self.now(views)]
        for k, candidate in enumerate(candidates):
            texels = np.flatnonzero(self.seen[candidate])
            after = steps[-1].copy()
            so_far = np.append(views, candidates[:k])
            after[texels] = self.expected(so_far, candidates[k : k + 1], texels)[0]
            steps.append(after)
        return np.stack(steps)

    @property
    def lasting(self) -> bool:
        """Whether E[H] of a texel stays when a view is added that does not see it."""
        return True

    @abstractmethod
    def _evaluate(
        self, views: np.ndarray, candidates: np.ndarray | None, texels: np.ndarray
    ) -> np.ndarray:
        """As ``expected``; anything where not seen. Without candidates, (1, L) of the views."""


def numbers(values: np.ndarray | list[int]) -> Any:
    """Return indices as UInt32."""
    return owned(mi.UInt32, np.asarray(values, np.uint32))
