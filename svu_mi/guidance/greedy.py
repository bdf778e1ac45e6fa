"""Greedy selection of views: chosen views count as photographed in all later choices."""

import numpy as np

from svu_mi.guidance.forecast import Forecast

# Largest relative growth of an information gain when another view is added. Gains usually fall; the
# largest growth on our test objects was 0.043, for a candidate that was not chosen.
GROWTH = 0.05
BATCH = 8  # candidates per launch; a small batch raises the bound that skips later ones


class GreedyScorer:
    """Scorer by expected entropy (Eq. 13), mean over texels; the prior's entropy if unseen.

    A choice invalidates E[H] of the texels that the new view sees, or of all texels if the forecast
    is not separable. With ``lazy``, a candidate is updated only if its last gain, increased by
    ``GROWTH`` per added view, reaches the best gain [Minoux 1978].

    Attributes:
        photographs: Number of photographs; candidate indices follow them.
        entropy: (T,) float64, E[H] with photographs from all chosen views.
        evaluated: Number of evaluated (candidate, texel) pairs.
    """

    def __init__(
        self, forecast: Forecast, photographs: int, reachable: np.ndarray | None = None, *,
        lazy: bool = False,
    ) -> None:  # fmt: skip
        self.forecast, self.photographs, self.evaluated = forecast, photographs, 0
        self._views, self._lazy = np.arange(photographs), lazy and forecast.is_separable
        self.entropy = forecast.current(self._views).astype(np.float64)
        self._sees = forecast.seen[photographs:]
        self._expected = np.zeros(self._sees.shape)
        self._stale = self._sees.copy()
        self._scores = np.where(self._sees.any(axis=1), np.inf, 0.0)
        self._bounds = self._scores.copy()
        self._free = np.ones(len(self._sees), bool) if reachable is None else reachable.copy()

    def scores(self) -> np.ndarray:
        """Return the mean information gain of each candidate, (C,); -infinity if chosen or
        unreachable. With ``lazy``, candidates that cannot be best keep their last gain, limited
        to just below the best."""
        while len(candidates := self._next()):
            self._evaluate(candidates)
        below = np.nextafter(self._best(), -np.inf)
        known = np.where(self._fresh, self._scores, np.minimum(self._scores, below))
        return np.where(self._free, known, -np.inf)

    def _next(self) -> np.ndarray:
        """Return the candidates to evaluate before the best one can be determined."""
        pending = np.flatnonzero(self._free & ~self._fresh)
        if not self._lazy:
            return pending
        bounds = self._bounds[pending]
        likely = np.argsort(-bounds, kind="stable")
        likely = likely[bounds[likely] >= self._best()]
        return pending[likely[: max(BATCH, np.isinf(bounds).sum())]]  # all in the first pass

    def _best(self) -> float:
        """Return the largest up-to-date gain."""
        return float(self._scores[self._free & self._fresh].max(initial=-np.inf))

    @property
    def _fresh(self) -> np.ndarray:
        """Flags of candidates with an up-to-date gain, (C,) bool."""
        return np.asarray(~self._stale.any(axis=1))

    def information_gain(self, candidate: int) -> np.ndarray:
        """Return the expected entropy decrease of every texel, (T,) float64."""
        if self._stale[candidate].any():
            self._evaluate(np.array([candidate]))
        return np.where(self._sees[candidate], self.entropy - self._expected[candidate], 0.0)

    def choose(self, candidate: int) -> None:
        """Treat a candidate as photographed; invalidate the gains that depend on it."""
        self.entropy = self.entropy - self.information_gain(candidate)
        touched = (self._sees & self._sees[candidate]).any(axis=1) & np.isfinite(self._bounds)
        self._bounds[touched] += GROWTH * np.abs(self._bounds[touched])
        self._views = np.append(self._views, self.photographs + candidate)
        self._free[candidate] = False
        if self.forecast.is_separable:
            self._stale |= self._sees & self._sees[candidate]
        else:
            self._stale = self._sees.copy()
            self.entropy = self.forecast.current(self._views).astype(np.float64)

    def _evaluate(self, candidates: np.ndarray) -> None:
        """Compute E[H] of candidates for the texels that are out of date."""
        if not len(candidates):
            return
        texels = np.flatnonzero(self._stale[candidates].any(axis=0))
        expected = self.forecast.expected(self._views, self.photographs + candidates, texels)
        seen = np.isfinite(expected)
        self.evaluated += int(seen.sum())
        self._expected[np.ix_(candidates, texels)] = np.where(seen, expected, 0)
        self._stale[candidates] = False
        change = np.where(self._sees[candidates], self.entropy - self._expected[candidates], 0)
        self._scores[candidates] = self._bounds[candidates] = change.mean(axis=1)
