"""Path-traced reference: posterior, its noise, and its options."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np

from svu_mi.evaluation.reference_options import ReferenceOptions
from svu_mi.posterior.calibrated import calibrated_posterior
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.tabulated import tabulated_posterior
from svu_mi.presets import AngularPreset
from svu_mi.statistics.statistics import Statistics


@dataclass(frozen=True, kw_only=True)
class TracedTables:
    """Energies or sums of n texels, from the mean of both halves of the samples and from each.

    Attributes:
        tables: (3, n, R, M ..., K) float64 energies, means over views; or (3, R, 3, P, n) sums
            (``Statistics``).
        weight: (n,) float64 of those sums; None with energies.
        subset, coverage, brightness, scale, unit, seconds, rays, dropped: see ``Reference``.
    """

    subset: np.ndarray = field(repr=False)
    tables: np.ndarray = field(repr=False)
    weight: np.ndarray | None = field(default=None, repr=False)
    coverage: np.ndarray = field(repr=False)
    brightness: np.ndarray = field(repr=False)
    scale: float
    unit: float
    seconds: float
    rays: int
    dropped: int

    def posteriors(self, options: ReferenceOptions) -> list[Posterior]:
        """Return the posterior of the mean and of each half."""
        grid, seen = options.grid, self.coverage > 0
        if self.weight is None:
            over = self.coverage.reshape(-1, *(1 for _ in grid.shape))
            views = over if options.errors == "sum" else 1
            return [tabulated_posterior(views * table, grid, seen) for table in self.tables]
        kappa = AngularPreset().knee * self.unit
        return [
            calibrated_posterior(
                Statistics.of(table, self.weight, self.coverage, options.levels, kappa),
                grid,
                self.unit,
            )  # fmt: skip
            for table in self.tables
        ]


@dataclass(frozen=True)
class SplitHalf:
    """How well a reference agrees with itself.

    Attributes:
        correlation: Pearson correlation of the two entropies over the observed texels; NaN
            when there are fewer than two, or all have one entropy.
        first, second: (n,) float64 entropy of each half of the samples.
    """

    correlation: float
    first: np.ndarray = field(repr=False)
    second: np.ndarray = field(repr=False)


@dataclass(frozen=True, kw_only=True)
class Reference(TracedTables):
    """Path-traced posterior of n texels.

    Attributes:
        subset: (n,) int64, which of the T texels.
        posterior: p(psi | B, L) on the axes of a ``PrincipledGrid``. Not observed, with
            entropy 1, is a texel that no view sees or that no ray met.
        halves: the same from the first and from the second half of the samples.
        tables, weight: what they were made from (``TracedTables``).
        brightness: (n,) float64, mean observed grey radiance over the views used; 0 without any.
        coverage: (n,) int64, number of views used.
        scale: mean grey radiance over all visible (texel, view) samples of the capture.
        unit: that, or where it is 0 some of the light's: what noise is a part of.
        seconds: time the tracing took, device synchronised; that of the original run when
            the result came from a cache.
        cached: whether it came from a cache.
        rays: number of camera paths traced, those for all psi together.
        dropped: number of visible (texel, view) pairs left out since their ray missed the texel.
        spp: paths per psi and pair, both halves together.
        max_depth: longest path, in edges seen from the camera; 2 is direct light.
        method: ``linear`` or ``brute``.
    """

    posterior: Posterior = field(repr=False)
    halves: tuple[Posterior, Posterior] = field(repr=False)
    cached: bool
    spp: int
    max_depth: int
    method: str

    @staticmethod
    def of(traced: TracedTables, options: ReferenceOptions, *, cached: bool) -> Reference:
        """Compute the posteriors of traced tables."""
        whole, first, second = traced.posteriors(options)
        return Reference(
            **{field.name: getattr(traced, field.name) for field in fields(traced)},
            posterior=whole, halves=(first, second), cached=cached, spp=options.spp,
            max_depth=options.max_depth, method=options.method,
        )  # fmt: skip

    @property
    def count(self) -> int:
        """Number of texels n."""
        return len(self.subset)

    @cached_property
    def entropy(self) -> np.ndarray:
        """Normalised entropy (n,) float64 in [0, 1]; 1 where not observed (Eq. 5)."""
        return np.array(self.posterior.entropy(), np.float64)

    def split_half(self) -> SplitHalf:
        """Compare the entropies of the two independent halves of the samples.

        The correlation bounds what any estimator can reach against one half; the full
        reference has twice the samples and is better than that.
        """
        both: np.ndarray = np.array([half.entropy() for half in self.halves], np.float64)
        kept = both[:, self.posterior.observed]
        varied = kept.shape[1] > 1 and np.ptp(kept, axis=1).all()
        return SplitHalf(float(np.corrcoef(kept)[0, 1]) if varied else np.nan, *both)
