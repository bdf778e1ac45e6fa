"""A kernel of more texels than fit into memory at a time: made tile by tile, when asked.

The first pass keeps the values of all maps (entropy, and the moments where they come with it);
everything else is computed again for the texels that it is asked of.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.core.memory import AT_WORK
from svu_mi.posterior.grid import Grid
from svu_mi.posterior.intervals import LEVEL, subsample
from svu_mi.posterior.kernel import Kernel, Pair, Prior

KEPT = 2**13  # texels whose kernel is kept for the next question about the same

Moments = dict[str, Pair]


@dataclass(frozen=True, kw_only=True, eq=False)
class TiledKernel(Kernel):
    """Kernel of T texels that holds one tile at a time.

    Attributes:
        observed: (T,) bool; only these may be requested.
        make: returns the kernel of (t,) texels, which numbers them from 0 to t - 1.
        report: called with the numbers of finished and of all texels, during the first pass.
    """

    grid: Grid
    observed: np.ndarray
    make: Callable[[np.ndarray], Kernel] = field(repr=False)
    size: int = AT_WORK
    report: Callable[[int, int], None] = field(default=lambda *_: None, repr=False)
    _last: dict[bytes, Kernel] = field(default_factory=dict, repr=False)
    _widths: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def groups(self) -> int:
        """Number of distributions per texel (see ``Kernel``)."""
        return self._one.groups

    @property
    def continuous(self) -> bool:  # type: ignore[override]
        """Whether intervals are made of finer parts than bins (see ``Kernel``)."""
        return self._one.continuous

    @property
    def prior(self) -> Prior:
        """The prior (see ``Kernel``)."""
        return self._one.prior

    @cached_property
    def _one(self) -> Kernel:
        """The kernel of one texel, for what is the same of all."""
        return self.make(self._seen[:1])

    @cached_property
    def _seen(self) -> np.ndarray:
        return np.flatnonzero(self.observed)

    def noise_of(self, texels: np.ndarray) -> np.ndarray:
        """Return the noise of texels, (t,) (see ``CalibratedKernel``)."""
        return self._joined(texels, lambda tile, own: tile.noise_of(own))

    def entropy(self, texels: np.ndarray) -> np.ndarray:
        """Return the normalised entropy, computed once for all texels (see ``Kernel``)."""
        return self._first[0][texels]

    def probabilities(self, texels: np.ndarray) -> np.ndarray:
        """Return p of every bin (see ``Kernel``)."""
        return self._joined(texels, lambda tile, own: tile.probabilities(own))

    def best(self, texels: np.ndarray) -> np.ndarray:
        """Return the most probable nodes (see ``Kernel``)."""
        return self._joined(texels, lambda tile, own: tile.best(own))

    def marginals(self, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Return the marginals of all parameters (see ``Kernel``)."""
        parts = [tile.marginals(own) for _, tile, own in self._tiles(texels)]
        return {name: np.concatenate([part[name] for part in parts]) for name in self.grid.axes}

    def moments(self, name: str, texels: np.ndarray) -> Pair:
        """Return mean and standard deviation, computed once for all texels (see ``Kernel``)."""
        mean, sd = self._moments[name]
        return mean[texels], sd[texels]

    def ends(self, name: str, level: float, texels: np.ndarray) -> Pair:
        """Return the ends of intervals (see ``Kernel``)."""
        ends = self._joined(texels, lambda tile, own: np.stack(tile.ends(name, level, own), axis=1))
        return ends[:, 0], ends[:, 1]

    def half_widths(self, name: str, level: float, texels: np.ndarray) -> np.ndarray:
        """Return half the widths of intervals, kept of a sample (see ``Kernel``)."""
        kept = self._widths.get(name) if level == LEVEL else None
        if kept is not None and np.isin(texels, self._sample).all():
            return kept[np.searchsorted(self._sample, texels)]
        return self._joined(texels, lambda tile, own: tile.half_widths(name, level, own))

    def draws(self, count: int, seed: int, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Draw parameters, with a seed for every tile of ``texels`` (see ``Kernel``)."""
        drawn: dict[str, np.ndarray] = {}
        for number, (span, tile, own) in enumerate(self._tiles(texels)):
            of_tile = int(np.random.SeedSequence((seed, number)).generate_state(1)[0])
            for name, values in tile.draws(count, of_tile, own).items():
                shape = (count, len(texels), values.shape[2])
                drawn.setdefault(name, np.empty(shape, np.float32))[:, span] = values
        return drawn

    @cached_property
    def _first(self) -> tuple[np.ndarray, Moments]:
        """Entropy (T,) float32, and moments if they come with it."""
        entropy, moments = np.ones(self.count, np.float32), Moments({})
        for span, tile, own in self._tiles(self._seen):
            texels = self._seen[span]
            entropy[texels] = tile.entropy(own)
            if self.continuous:
                self._keep(moments, texels, tile)
                self._keep_widths(texels, tile)
            self.report(span.stop, len(self._seen))
        dr.flush_malloc_cache()  # a tile's statistics, which are not needed any more
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
        """Put the moments of a tile in their place."""
        for name in self.grid.axes:
            found = tile.moments(name, np.arange(len(texels)))
            shape = (self.count, found[0].shape[1])
            if name not in moments:
                moments[name] = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
            for table, values in zip(moments[name], found, strict=True):
                table[texels] = values

    def _keep_widths(self, texels: np.ndarray, tile: Kernel) -> None:
        """Cache half-widths of the summary's sample; later they would re-read photographs."""
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
        """Yield kernels of texels, as many at a time as a tile has, and their numbers there."""
        if 0 < len(chosen) <= min(KEPT, self.size):
            # Those all over the surface are in most pages of all photographs.
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
        self, chosen: np.ndarray, ask: Callable[[Any, np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Ask the kernels of texels; return all answers, one after the other."""
        return np.concatenate([ask(tile, own) for _, tile, own in self._tiles(chosen)])
