"""Path-traced reference: posterior, its noise, and its options."""

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
    """Path-traced energies or statistics of n texels, for all samples and for two halves.

    Attributes:
        tables: (3, n, R, M ..., K) float64 energies, means over views; or (3, R, 3, P, n) sums
            of ``Statistics``. The first axis is mean of both halves, first half, second half.
        weight: (n,) float64, sum of weights (``Statistics``); None with energies.
        subset, coverage, brightness, scale, unit, seconds, rays, dropped: See ``Reference``.
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
        """Return the posteriors of all samples, of the first half and of the second half."""
        grid, seen = options.grid, self.coverage > 0
        if self.weight is None:
            over = self.coverage.reshape(-1, *(1 for _ in grid.shape))
            views = over if options.errors == "sum" else 1
            return [tabulated_posterior(views * table, grid, seen) for table in self.tables]
        known = [self.statistics(table, options.levels) for table in self.tables]
        return [calibrated_posterior(each, grid, self.unit) for each in known]

    def statistics(self, table: np.ndarray, levels: np.ndarray) -> Statistics:
        """Return the statistics of a table of sums."""
        assert self.weight is not None
        kappa = AngularPreset().knee * self.unit
        return Statistics.of(table, self.weight, self.coverage, levels, kappa)


@dataclass(frozen=True)
class SplitHalf:
    """Agreement of a reference's two halves, as a measure of its Monte Carlo noise.

    Attributes:
        correlation: Pearson correlation of the entropies over observed texels; NaN for fewer
            than two texels or constant entropy.
        first, second: (n,) float64 entropy of each half of the samples.
    """

    correlation: float
    first: np.ndarray = field(repr=False)
    second: np.ndarray = field(repr=False)


@dataclass(frozen=True, kw_only=True)
class Reference(TracedTables):
    """Path-traced posterior of n texels.

    Attributes:
        subset: (n,) int64, indices of the texels.
        posterior: p(psi | B, L) on the axes of a ``PrincipledGrid``. Texels without a usable
            (texel, view) pair are unobserved and have entropy 1.
        halves: Posteriors of the first and second half of the samples.
        tables, weight: Energies or sums of the posteriors (``TracedTables``).
        brightness: (n,) float64, mean observed grey radiance over the used views; 0 without any.
        coverage: (n,) int64, number of used views.
        scale: Mean grey radiance over all visible (texel, view) samples of the capture.
        unit: Radiance unit of the noise: ``scale``, or a fraction of the light if that is 0.
        seconds: Time of tracing, device synchronised; cached with the result.
        cached: True if the result comes from the cache.
        rays: Number of traced camera paths, summed over all materials psi.
        dropped: Number of visible (texel, view) pairs whose camera ray misses the texel.
        spp: Paths per psi and pair, both halves together.
        max_depth: Largest number of path edges, counted from the camera; 2 is direct light.
        method: ``linear`` or ``brute``.

    Example:
        >>> reference = svu.reference_posterior(capture, texels, subset=20, spp=4)
        >>> reference.count, reference.split_half().first.shape
        (20, (20,))
    """

    posterior: Posterior = field(repr=False)
    halves: tuple[Posterior, Posterior] = field(repr=False)
    cached: bool
    spp: int
    max_depth: int
    method: str

    @staticmethod
    def of(traced: TracedTables, options: ReferenceOptions, *, cached: bool) -> "Reference":
        """Compute the posteriors from traced tables, and return the reference."""
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
        """Normalised entropy (Eq. 5), (n,) float64 in [0, 1]; 1 for unobserved texels."""
        return np.array(self.posterior.entropy(), np.float64)

    def split_half(self) -> SplitHalf:
        """Compare the entropies of the two independent halves of the samples.

        The correlation is an upper bound for any estimator compared with one half. The full
        reference has twice the samples and therefore less noise.
        """
        both: np.ndarray = np.array([half.entropy() for half in self.halves], np.float64)
        kept = both[:, self.posterior.observed]
        varied = kept.shape[1] > 1 and np.ptp(kept, axis=1).all()
        return SplitHalf(float(np.corrcoef(kept)[0, 1]) if varied else np.nan, *both)
