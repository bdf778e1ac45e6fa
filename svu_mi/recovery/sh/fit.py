"""What SH recovery descends on, from what was observed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import CaptureError
from svu_mi.observed import Observed
from svu_mi.options import preset
from svu_mi.recovery.descent import Objective
from svu_mi.recovery.options import ShOptions
from svu_mi.recovery.sh.angular import angular_objective
from svu_mi.recovery.sh.materials import Materials, find_materials
from svu_mi.recovery.sh.objective import StatisticsLoss
from svu_mi.recovery.sh.spectral import spectral_objective
from svu_mi.recovery.sh.start import Start, closed_form
from svu_mi.recovery.textures import Textures, lay_out
from svu_mi.regularization.seeds import candidates, spread
from svu_mi.statistics import Factors
from svu_mi.statistics.gather import Values
from svu_mi.surface.neighbors import Neighbors

SEEDS = 20  # most materials; as many as the paper shares from


@dataclass(frozen=True)
class Fit:
    """What the statistics of S seen texels say.

    Attributes:
        factors: of the texels.
        start: their parameters, each for itself.
        loss: how far textures are from the statistics.
    """

    factors: Factors
    start: Start
    loss: StatisticsLoss


@dataclass(frozen=True)
class Fits:
    """What SH recovery makes of photographs; each of it once.

    Attributes:
        observed: the photographs.
    """

    observed: Observed
    _kept: dict[Any, Fit] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not self.observed.found.scale > 0:
            raise CaptureError(
                f"No texel of '{self.observed.capture.shape.id()}' is seen with any radiance; "
                "check poses (camera space is +X left, +Y up, +Z forward), masks and exposures."
            )

    @cached_property
    def seen(self) -> np.ndarray:
        """(S,) numbers of the texels that some photograph shows."""
        return np.flatnonzero(self.observed.coverage)

    def objective(self, options: ShOptions) -> Objective:
        """Return what to descend on."""
        if options.loss == "angular":
            switches = preset("paper", method="angular", channels="joint")
            return angular_objective(self.observed, switches, options.levels)
        if options.loss == "statistics":
            return self.fit(options).loss
        return spectral_objective(self.observed, preset("paper", method="spectrum"), options.loss)

    def fit(self, options: ShOptions) -> Fit:
        """Gather the statistics, and start from them; done once."""
        key = (options.levels, options.knee, options.sigma, options.robust)
        if key not in self._kept:
            self._kept[key] = self._fit(options)
        return self._kept[key]

    def _fit(self, options: ShOptions) -> Fit:
        seen, texels = self.observed, self.observed.texels
        switches = preset("default", method="angular", channels="joint")
        roughness = np.linspace(0, 1, options.levels)
        kappa = options.knee * seen.found.scale
        sigma = dr.opaque(mi.Float, options.sigma * seen.found.scale)
        current: Values | None = None
        for _ in range(1 + options.robust):
            # Edges count in full: measured, textures are 0.1 to 2 dB better than if they do not.
            factors = seen.statistics(
                roughness, switches, 3, kappa=kappa, edges=0.0, texels=self.seen, current=current
            ).factor()
            start = closed_form(factors, sigma)
            current = start.values()
        place = dr.gather(mi.UInt32, texels.index, factors.texel)
        views = mi.Float(factors.views)
        mean = dr.opaque(mi.Float, float(factors.views.numpy().mean()))
        variance = start.variance * mean / views
        dr.eval(variance)
        return Fit(factors, start, StatisticsLoss(factors, place, variance))

    def materials(self, options: ShOptions, around: Neighbors) -> Materials:
        """Find what texels share; seeds are minima of the entropy on the surface."""
        fit, count = self.fit(options), self.observed.texels.count
        entropy, number = np.ones(count), np.full(count, -1)
        entropy[self.seen], number[self.seen] = fit.start.entropy.numpy(), np.arange(len(self.seen))
        found, worth = candidates(entropy, self.observed.coverage > 0, around)
        own = fit.start.table()
        if len(found):
            found = found[spread(own[:, number[found]].T, worth, SEEDS)]
        return find_materials(fit.factors, fit.start, own, number[found])

    def textures(self, values: np.ndarray) -> Textures:
        """Lay parameters (5, S) of seen texels out; others take the mean of these."""
        texels = self.observed.texels
        filled = np.empty((5, texels.count), np.float32)
        filled[:] = values.mean(axis=1, keepdims=True)
        filled[:, self.seen] = values
        return lay_out(
            texels, {"base_color": filled[:3].T, "roughness": filled[3], "metallic": filled[4]}
        )
