"""Kernel that computes the posterior of many texels in tiles.

The first pass caches entropy and, for calibrated posteriors, moments. Other results recompute the
statistics of the requested texels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.core.memory import AT_WORK
from svu_mi.posterior.grid import Grid
from svu_mi.posterior.intervals import LEVEL, subsample
from svu_mi.posterior.kernel import Kernel, Pair, Prior

KEPT = 2**13  # maximum number of texels of a cached kernel

Moments = dict[str, Pair]


@dataclass(frozen=True, kw_only=True, eq=False)
class TiledKernel(Kernel):
    """Kernel of T texels that holds one tile in memory.

    Attributes:
        observed: (T,) bool, mask of seen texels; only these can be requested.
        make: function from (t,) texels to a kernel, which numbers them from 0 to t - 1.
        report: callback for progress of the first pass; gets numbers of finished and all texels.
    """

    grid: Grid
    observed: np.ndarray
    make: Callable[[np.ndarray], Kernel] = field(repr=False)
    size: int = AT_WORK
    report: Callable[[int, int], None] = field(default=lambda *_: None, repr=False)
    _last: dict[bytes, Kernel] = field(default_factory=dict, repr=False)
    _widths: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def channels(self) -> int:
        """Number of base colours or Ks per texel (see ``Kernel``)."""
        return self._one.channels

    @property
    def continuous(self) -> bool:  # type: ignore[override]
        """True if parameters are continuous (see ``Posterior``)."""
        return self._one.continuous

    @property
    def prior(self) -> Prior:
        """Prior of all texels."""
        return self._one.prior

    @property
    def spread(self) -> Mapping[str, float]:  # type: ignore[override]
        """Factors of standard deviations (see ``Kernel``)."""
        return self._one.spread

    @cached_property
    def _one(self) -> Kernel:
        """Kernel of one texel, for properties that do not depend on the texel."""
        return self.make(self._seen[:1])

    @cached_property
    def _seen(self) -> np.ndarray:
        return np.flatnonzero(self.observed)

    def noise_of(self, texels: np.ndarray) -> np.ndarray:
        """Return the noise of texels, (t,) radiance (see ``CalibratedKernel``)."""
        return self._joined(texels, lambda tile, own: tile.noise_of(own))

    def entropy(self, texels: np.ndarray) -> np.ndarray:
        """Return the normalised entropy, cached for all texels (see ``Kernel``)."""
        return self._first[0][texels]

    def probabilities(self, texels: np.ndarray) -> np.ndarray:
        """Return bin probabilities (see ``Kernel``)."""
        return self._joined(texels, lambda tile, own: tile.probabilities(own))

    def best(self, texels: np.ndarray) -> np.ndarray:
        """Return the most probable nodes (see ``Kernel``)."""
        return self._joined(texels, lambda tile, own: tile.best(own))

    def marginals(self, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Return the marginals of all parameters (see ``Kernel``)."""
        parts = [tile.marginals(own) for _, tile, own in self._tiles(texels)]
        return {name: np.concatenate([part[name] for part in parts]) for name in self.grid.axes}

    def moments(self, name: str, texels: np.ndarray) -> Pair:
        """Return mean and standard deviation, cached for all texels (see ``Kernel``)."""
        mean, sd = self._moments[name]
        return mean[texels], sd[texels]

    def ends(self, name: str, level: float, texels: np.ndarray) -> Pair:
        """Return the ends of the shortest intervals (see ``Kernel``)."""
        ends = self._joined(texels, lambda tile, own: np.stack(tile.ends(name, level, own), axis=1))
        return ends[:, 0], ends[:, 1]

    def half_widths(self, name: str, level: float, texels: np.ndarray) -> np.ndarray:
        """Return half the widths of intervals, cached for a sample of texels (see ``Kernel``)."""
        kept = self._widths.get(name) if level == LEVEL else None
        if kept is not None and np.isin(texels, self._sample).all():
            return kept[np.searchsorted(self._sample, texels)]
        return self._joined(texels, lambda tile, own: tile.half_widths(name, level, own))

    def draws(self, count: int, seed: int, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Sample parameters, with a separate seed for each tile (see ``Kernel``)."""
        drawn: dict[str, np.ndarray] = {}
        for number, (span, tile, own) in enumerate(self._tiles(texels)):
            of_tile = int(np.random.SeedSequence((seed, number)).generate_state(1)[0])
            for name, values in tile.draws(count, of_tile, own).items():
                shape = (count, len(texels), values.shape[2])
                drawn.setdefault(name, np.empty(shape, np.float32))[:, span] = values
        return drawn

    @cached_property
    def _first(self) -> tuple[np.ndarray, Moments]:
        """Entropy, (T,) float32, and moments if continuous (computed in the same pass)."""
        entropy, moments = np.ones(self.count, np.float32), Moments({})
        for span, tile, own in self._tiles(self._seen):
            texels = self._seen[span]
            entropy[texels] = tile.entropy(own)
            if self.continuous:
                self._keep(moments, texels, tile)
                self._keep_widths(texels, tile)
            self.report(span.stop, len(self._seen))
        dr.flush_malloc_cache()  # releases the statistics of the last tile
        return entropy, moments

    @cached_property
    def _moments(self) -> Moments:
        if self.continuous:
            return self._first[1]
        moments = Moments({})
        for span, tile, _ in self._tiles(self._seen):
            self._keep(moments, self._seen[span], tile)
        return moments

    def _keep(self, moments: Moments, texels: np.ndarray, tile: Kernel) -> None:
        """Copy the moments of a tile's texels into the arrays ``moments`` of all texels."""
        for name in self.grid.axes:
            found = tile.moments(name, np.arange(len(texels)))
            shape = (self.count, found[0].shape[1])
            if name not in moments:
                moments[name] = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
            for table, values in zip(moments[name], found, strict=True):
                table[texels] = values

    def _keep_widths(self, texels: np.ndarray, tile: Kernel) -> None:
        """Cache half-widths of a sample of texels, so that photographs are not read again later."""
        own = np.flatnonzero(np.isin(texels, self._sample, assume_unique=True))
        place = np.searchsorted(self._sample, texels[own])
        for name in self.grid.axes if len(own) else ():
            kept = self._widths.setdefault(name, np.zeros(len(self._sample), np.float32))
            kept[place] = tile.half_widths(name, LEVEL, own)

    @property
    def count(self) -> int:
        """Number of texels T."""
        return len(self.observed)

    @cached_property
    def _sample(self) -> np.ndarray:
        return subsample(self._seen)

    def _tiles(self, chosen: np.ndarray) -> Iterator[tuple[slice, Any, np.ndarray]]:
        """Yield slices of ``chosen``, the kernel of each, and texel indices in the kernel."""
        if 0 < len(chosen) <= min(KEPT, self.size):
            # Cached: texels spread over the surface read most pages of all photographs.
            key = np.asarray(chosen, np.int64).tobytes()
            if key not in self._last:
                self._last.clear()
                self._last[key] = self.make(chosen)
            yield slice(0, len(chosen)), self._last[key], np.arange(len(chosen))
            return
        for first in range(0, len(chosen), self.size):
            span = slice(first, min(first + self.size, len(chosen)))
            yield span, self.make(chosen[span]), np.arange(span.stop - span.start)

    def _joined(
        self, chosen: np.ndarray, compute: Callable[[Any, np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Return the concatenated results of ``compute(kernel, indices)`` of all tiles."""
        return np.concatenate([compute(tile, own) for _, tile, own in self._tiles(chosen)])
