"""Choosing views one by one, each as if those before it were photographed."""

from __future__ import annotations

import numpy as np

from svu_mi.guidance.forecast import Forecast


class Greedy:
    """Lowest expected entropy (Eq. 13), summed over texels; unseen ones have that of the prior.

    A candidate's E[H] of a texel changes only when a view is added that sees the texel, too: only
    these are computed again; or all of them, if the forecast is not ``lasting``. With ``lazy``,
    only while the candidate's last gain, which is taken for a bound, is above the best. Candidates
    out of reach are never computed.

    Attributes:
        forecast: of the texels.
        photographs: number of views with a photograph; candidates are numbered after them.
        entropy: (T,) float64, E[H] of photographs from all views chosen so far.
        evaluated: number of (candidate, texel) pairs computed so far.
    """

    BATCH = 8  # candidates of one launch, when lazy

    def __init__(
        self, forecast: Forecast, photographs: int, reachable: np.ndarray | None = None, *,
        lazy: bool = False,
    ) -> None:  # fmt: skip
        self.forecast, self.photographs, self.evaluated = forecast, photographs, 0
        self._views, self._lazy = np.arange(photographs), lazy
        self.entropy = forecast.now(self._views).astype(np.float64)
        self._sees = forecast.seen[photographs:]
        self._expected = np.zeros(self._sees.shape)
        self._stale = self._sees.copy()
        self._gains = np.where(self._sees.any(axis=1), np.inf, 0.0)
        self._free = np.ones(len(self._sees), bool) if reachable is None else reachable.copy()

    def gains(self) -> np.ndarray:
        """Mean over texels of E[H] without and with each candidate; a bound if lazy, and
        -infinity for those taken or out of reach."""
        pending = np.flatnonzero(self._stale.any(axis=1) & self._free)
        if not self._lazy:
            self._evaluate(pending)
            return np.where(self._free, self._gains, -np.inf)
        pending = pending[np.argsort(-self._gains[pending], kind="stable")]
        while len(pending):
            fresh = self._free & ~self._stale.any(axis=1)
            best = self._gains[fresh].max(initial=-np.inf)
            pending = pending[self._gains[pending] > best]
            self._evaluate(pending[: self.BATCH])
            pending = pending[self.BATCH :]
        # What was not looked at is no better than the best, but its bound may be equal.
        fresh = self._free & ~self._stale.any(axis=1)
        best = self._gains[fresh].max(initial=-np.inf)
        bound = np.minimum(self._gains, np.nextafter(best, -np.inf))
        return np.where(fresh, self._gains, np.where(self._free, bound, -np.inf))

    def texel_gains(self, candidate: int) -> np.ndarray:
        """Return what a candidate would change in every texel, (T,) float64."""
        if self._stale[candidate].any():
            self._evaluate(np.array([candidate]))
        return np.where(self._sees[candidate], self.entropy - self._expected[candidate], 0.0)

    def choose(self, candidate: int) -> None:
        """Take a candidate as photographed: E[H] with it is E[H] from now on.

        Unless the forecast is not ``lasting``: then all is computed again.
        """
        self.entropy = self.entropy - self.texel_gains(candidate)
        self._views = np.append(self._views, self.photographs + candidate)
        self._free[candidate] = False
        if self.forecast.lasting:
            self._stale |= self._sees & self._sees[candidate]
        else:
            self._stale = self._sees.copy()
            self.entropy = self.forecast.now(self._views).astype(np.float64)

    def _evaluate(self, candidates: np.ndarray) -> None:
        """Bring candidates up to date."""
        if not len(candidates):
            return
        texels = np.flatnonzero(self._stale[candidates].any(axis=0))
        found = self.forecast.expected(self._views, self.photographs + candidates, texels)
        seen = np.isfinite(found)
        self.evaluated += int(seen.sum())
        self._expected[np.ix_(candidates, texels)] = np.where(seen, found, 0)
        self._stale[candidates] = False
        change = np.where(self._sees[candidates], self.entropy - self._expected[candidates], 0)
        self._gains[candidates] = change.mean(axis=1)
