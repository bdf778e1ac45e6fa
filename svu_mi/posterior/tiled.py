"""A posterior of more texels than fit into memory at a time: made tile by tile, when asked.

What all maps are made of (entropy, and the moments where those come with it) is kept; everything
else is computed again for the texels that it is asked of.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.memory import AT_WORK
from svu_mi.posterior.calibrated import CalibratedPosterior
from svu_mi.posterior.intervals import LEVEL, spread
from svu_mi.posterior.part import LikeAnother
from svu_mi.posterior.record import Posterior

KEPT = 2**13  # texels whose posterior is kept for the next question about the same

Moments = dict[str, tuple[np.ndarray, ...]]


@dataclass(frozen=True, kw_only=True, eq=False)
class TiledPosterior(LikeAnother):
    """The posterior of T texels, of which no more than a tile is held at a time.

    Attributes:
        make: returns the posterior of some texels (t,), by their numbers among all T; it numbers
            them from 0 to t - 1.
        size: texels of a tile.
        report: called with the number of texels that are done, and of all, during the first pass.
    """

    make: Callable[[np.ndarray], Posterior] = field(repr=False)
    size: int = AT_WORK
    report: Callable[[int, int], None] = field(default=lambda *_: None, repr=False)
    _last: dict[bytes, Posterior] = field(default_factory=dict, repr=False)
    _widths: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    @cached_property
    def _another(self) -> Posterior:
        """The posterior of one texel, which knows what all have in common."""
        return self.make(self._seen[:1])

    @cached_property
    def _seen(self) -> np.ndarray:
        return np.flatnonzero(self.observed)

    def noise_of(self, texels: np.ndarray) -> np.ndarray:
        """Return the noise of texels (t,) that are observed, by their numbers among all T."""
        noise = np.zeros(len(texels))
        for span, tile in self._tiles(texels):
            assert isinstance(tile, CalibratedPosterior)
            noise[span] = tile.noise_of(np.arange(tile.count))
        return noise

    def _entropy_of_all(self) -> Any:
        return owned(mi.Float, self._first[0])

    @cached_property
    def _first(self) -> tuple[np.ndarray, Moments]:
        """Entropy (T,) float32 as if all texels were observed, and moments if they come with it."""
        entropy, moments, done = np.ones(self.count, np.float32), Moments({}), 0
        for span, tile in self._tiles(self._seen):
            texels = self._seen[span]
            entropy[texels] = np.array(tile.entropy())
            if self.continuous:
                self._keep(moments, texels, tile)
                self._keep_widths(texels, tile)
            done += len(texels)
            self.report(done, len(self._seen))
        dr.flush_malloc_cache()  # a tile's statistics, which nobody needs any more
        return entropy, moments

    @cached_property
    def _moments_of_all(self) -> Moments:
        if self.continuous:
            return self._first[1]
        moments = Moments({})
        for span, tile in self._tiles(self._seen):
            self._keep(moments, self._seen[span], tile)
        return moments

    def _keep(self, moments: Moments, texels: np.ndarray, tile: Posterior) -> None:
        """Put the moments of a tile in their place."""
        for name in self.axes:
            found = [np.array(x).reshape(tile.count, -1) for x in (tile.mean(name), tile.sd(name))]
            tables = moments.setdefault(
                name, tuple(np.zeros((self.count, x.shape[1]), np.float32) for x in found)
            )
            for table, values in zip(tables, found, strict=True):
                table[texels] = values

    def _keep_widths(self, texels: np.ndarray, tile: Posterior) -> None:
        """Keep half the widths of the intervals of some texels, by which people are told how well
        the surface is known: later, they would be in most pages of all photographs."""
        own = np.flatnonzero(np.isin(texels, self._sample, assume_unique=True))
        place = np.searchsorted(self._sample, texels[own])
        for name in self.axes if len(own) else ():
            kept = self._widths.setdefault(name, np.zeros(len(self._sample), np.float32))
            kept[place] = tile._half_widths(name, LEVEL, own)

    @cached_property
    def _sample(self) -> np.ndarray:
        return spread(self._seen)

    def _moments(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        mean, sd = self._moments_of_all[name]
        return mean.copy(), sd.copy()

    def _tables(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._cells(chosen), self._best(chosen)

    def _cells(self, chosen: np.ndarray) -> np.ndarray:
        return self._joined(chosen, lambda tile: tile._cells(np.arange(tile.count)))

    def _best(self, chosen: np.ndarray) -> np.ndarray:
        return self._joined(chosen, lambda tile: tile._best(np.arange(tile.count)))

    def _marginals_of(self, chosen: np.ndarray) -> dict[str, Any]:
        parts = [tile._marginals_of(np.arange(tile.count)) for _, tile in self._tiles(chosen)]
        parts = parts or [self._another._marginals_of(np.arange(0))]
        return {name: np.concatenate([part[name] for part in parts]) for name in self.axes}

    def _ends(
        self, name: str, level: float, texels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        ends = self._joined(
            texels, lambda tile: np.stack(tile._ends(name, level, np.arange(tile.count)), axis=1)
        )
        return ends[:, 0], ends[:, 1]

    def _half_widths(self, name: str, level: float, texels: np.ndarray) -> np.ndarray:
        kept = self._widths.get(name) if level == LEVEL else None
        if kept is not None and np.isin(texels, self._sample).all():
            return kept[np.searchsorted(self._sample, texels)]
        return self._joined(
            texels, lambda tile: tile._half_widths(name, level, np.arange(tile.count))
        )

    def _draws(self, count: int, seed: int) -> dict[str, np.ndarray]:
        drawn: dict[str, np.ndarray] = {}
        for number, (span, tile) in enumerate(self._tiles(self._seen)):
            own = int(np.random.SeedSequence((seed, number)).generate_state(1)[0])
            for name, values in tile._draws(count, own).items():
                shape = (count, self.count, values.shape[2])
                table = drawn.setdefault(name, np.zeros(shape, np.float32))
                table[:, self._seen[span]] = values
        return drawn

    def _tiles(self, chosen: np.ndarray) -> Iterator[tuple[slice, Posterior]]:
        """Posteriors of texels (t,), as many at a time as a tile has."""
        if 0 < len(chosen) <= min(KEPT, self.size):
            # Those all over the surface are in most pages of all photographs.
            key = np.asarray(chosen, np.int64).tobytes()
            if key not in self._last:
                self._last.clear()
                self._last[key] = self.make(chosen)
            yield slice(0, len(chosen)), self._last[key]
            return
        for first in range(0, len(chosen), self.size):
            span = slice(first, min(first + self.size, len(chosen)))
            yield span, self.make(chosen[span])

    def _joined(self, chosen: np.ndarray, ask: Callable[[Posterior], np.ndarray]) -> np.ndarray:
        """Ask the posteriors of texels; return all answers, one after the other."""
        found = [ask(tile) for _, tile in self._tiles(chosen)]
        return np.concatenate(found or [ask(self._another)[:0]])
