"""Kernel that computes the posterior of many texels in tiles.

The first pass caches entropy and, for calibrated posteriors, moments and noise. Error bars depend
on neighbours, perhaps of another tile, so they are computed after the first pass. Other results
recompute the statistics of the requested texels.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.core.memory import AT_WORK
from svu_mi.posterior.calibrated import CalibratedKernel
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
        widened: function that adds the error bars to a calibrated kernel of all seen texels.
        report: callback for progress of the first pass; gets numbers of finished and all texels.
    """

    grid: Grid
    observed: np.ndarray
    make: Callable[[np.ndarray], Any] = field(repr=False)
    widened: Callable[[CalibratedKernel], CalibratedKernel] = field(repr=False)
    size: int = AT_WORK
    report: Callable[[int, int], None] = field(default=lambda *_: None, repr=False)
    _last: dict[bytes, Kernel] = field(default_factory=dict, repr=False)
    _ends: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

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
        return (self._whole or self._one).spread

    @cached_property
    def _one(self) -> Any:
        """Kernel of one texel, for properties that do not depend on the texel."""
        return self.make(self._seen[:1])

    @cached_property
    def _seen(self) -> np.ndarray:
        return np.flatnonzero(self.observed)

    def noise_of(self, texels: np.ndarray) -> np.ndarray:
        """Return the noise of texels, (t,) radiance (see ``CalibratedKernel``)."""
        assert self._whole is not None
        return self._whole.noise_of(texels)

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
        if self._whole is not None:
            return self._whole.moments(name, texels)
        mean, sd = self._moments[name]
        return mean[texels], sd[texels]

    def ends(self, name: str, level: float, texels: np.ndarray) -> Pair:
        """Return the ends of the shortest intervals, cached for a sample (see ``Kernel``)."""
        if self._whole is not None and level == LEVEL and np.isin(texels, self._sample).all():
            kept = self._ends[name][np.searchsorted(self._sample, texels)]
            return self._whole.widened_ends(name, level, (kept[:, 0], kept[:, 1]), texels)
        ends = self._joined(texels, lambda tile, own: np.stack(tile.ends(name, level, own), axis=1))
        return ends[:, 0], ends[:, 1]

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
    def _first(self) -> tuple[np.ndarray, CalibratedKernel | None]:
        """Entropy, (T,) float32, and a kernel of the moments of all seen texels if calibrated."""
        entropy, tiles = np.ones(self.count, np.float32), []
        for span in self._spans(len(self._seen)):
            texels = self._seen[span]
            tile, own = self.make(texels), np.arange(len(texels))
            if tile.continuous:
                tiles.append((tile.summary, tile.noise))
                self._keep_ends(texels, tile)
            else:
                entropy[texels] = tile.entropy(own)
            self.report(span.stop, len(self._seen))
        dr.flush_malloc_cache()  # releases the statistics of the last tile
        if not tiles:
            return entropy, None
        whole = self.widened(self._one.of_tiles(tiles, self._seen))
        entropy[self._seen] = whole.entropy(self._seen)
        return entropy, whole

    @property
    def _whole(self) -> CalibratedKernel | None:
        return self._first[1]

    @cached_property
    def _moments(self) -> Moments:
        """Moments of a posterior on a grid, (T, g) each."""
        moments = Moments({})
        for span, tile, own in self._tiles(self._seen):
            for name in self.grid.axes:
                found = tile.moments(name, own)
                shape = (self.count, found[0].shape[1])
                if name not in moments:
                    moments[name] = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
                for table, values in zip(moments[name], found, strict=True):
                    table[self._seen[span]] = values
        return moments

    def _keep_ends(self, texels: np.ndarray, tile: CalibratedKernel) -> None:
        """Cache intervals of a sample of texels, so that photographs are not read again later."""
        own = np.flatnonzero(np.isin(texels, self._sample, assume_unique=True))
        place = np.searchsorted(self._sample, texels[own])
        for name in self.grid.axes if len(own) else ():
            shape = (len(self._sample), 2, tile.channels_of(name))
            kept = self._ends.setdefault(name, np.zeros(shape, np.float32))
            kept[place] = np.stack(tile.own_ends(name, LEVEL, own), axis=1)

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
                self._last[key] = self._made(chosen)
            yield slice(0, len(chosen)), self._last[key], np.arange(len(chosen))
            return
        for span in self._spans(len(chosen)):
            yield span, self._made(chosen[span]), np.arange(span.stop - span.start)

    def _spans(self, count: int) -> Iterator[slice]:
        for first in range(0, count, self.size):
            yield slice(first, min(first + self.size, count))

    def _made(self, texels: np.ndarray) -> Kernel:
        """Return the kernel of (t,) texels, with their error bars."""
        made = self.make(texels)
        return made.widened_like(self._whole, texels) if self._whole else made

    def _joined(
        self, chosen: np.ndarray, compute: Callable[[Any, np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Return the concatenated results of ``compute(kernel, indices)`` of all tiles."""
        return np.concatenate([compute(tile, own) for _, tile, own in self._tiles(chosen)])
