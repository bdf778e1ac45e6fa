"""From a capture to what SH recovery descends on."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.errors import CaptureError
from svu_mi.interop import owned
from svu_mi.options import preset
from svu_mi.radiance import Lighting, Surface, Survey, Views, light, pack_views, survey
from svu_mi.recovery.descent import Objective
from svu_mi.recovery.options import ShOptions
from svu_mi.recovery.sh.angular import angular_objective
from svu_mi.recovery.sh.materials import Materials, find_materials
from svu_mi.recovery.sh.model import Model
from svu_mi.recovery.sh.objective import StatisticsLoss
from svu_mi.recovery.sh.spectral import spectral_objective
from svu_mi.recovery.sh.start import Start, closed_form
from svu_mi.recovery.sh.statistics import ErrorFactors, gather
from svu_mi.recovery.textures import Textures, lay_out
from svu_mi.regularization.seeds import candidates, spread
from svu_mi.surface import Texels
from svu_mi.surface.neighbors import Neighbors

SEEDS = 20  # most materials; as many as the paper shares from


@dataclass(frozen=True)
class Prepared:
    """A capture, and who sees whom in it.

    Attributes:
        capture, texels: of the recovery.
        views: the packed capture, in three channels.
        found: who sees whom.
    """

    capture: Capture
    texels: Texels
    views: Views
    found: Survey
    _fits: dict[Any, Fit] = field(default_factory=dict, repr=False)

    @property
    def coverage(self) -> np.ndarray:
        """(T,) uint32, number of photographs that show each texel."""
        return np.array(self.found.coverage)

    @cached_property
    def lighting(self) -> Lighting:
        """The capture's light."""
        return light(self.capture, sum(self.capture.used))

    @cached_property
    def seen(self) -> np.ndarray:
        """(S,) numbers of the texels that some photograph shows."""
        return np.flatnonzero(self.coverage)

    def objective(self, options: ShOptions) -> Objective:
        """Return what to descend on."""
        if options.loss == "angular":
            switches = preset("paper", method="angular", channels="joint")
            return angular_objective(
                self.views, self.texels, self.found, self.lighting, switches, options.levels
            )
        if options.loss == "statistics":
            return self.fit(options).loss
        fit = preset("paper", method="spectrum")
        return spectral_objective(
            self.views, self.texels, self.found, self.lighting, fit, options.loss
        )

    def fit(self, options: ShOptions) -> Fit:
        """Gather the statistics, and start from them; done once."""
        key = (options.levels, options.knee, options.sigma, options.robust)
        if key not in self._fits:
            self._fits[key] = self._fit(options)
        return self._fits[key]

    def _fit(self, options: ShOptions) -> Fit:
        surface = Surface.of(self.texels, owned(mi.UInt32, self.seen.astype(np.uint32)))
        model = Model.of(self.views.scene, surface, self.lighting, options.levels)
        knee = dr.opaque(mi.Float, options.knee * self.found.scale)
        sigma = dr.opaque(mi.Float, options.sigma * self.found.scale)
        statistics = gather(self.views, surface, self.found, model, knee)
        start = closed_form(statistics, sigma)
        for _ in range(options.robust):
            statistics = gather(self.views, surface, self.found, model, knee, start.values())
            start = closed_form(statistics, sigma)
        place = dr.gather(mi.UInt32, self.texels.index, surface.index)
        views = mi.Float(dr.gather(mi.UInt32, self.found.coverage, surface.index))
        mean = dr.opaque(mi.Float, float(statistics.coverage.mean()))
        variance = start.variance * mean / views
        dr.eval(variance)
        return Fit(statistics, start, StatisticsLoss(statistics, place, variance))

    def materials(self, options: ShOptions, around: Neighbors) -> Materials:
        """Find what texels share; seeds are minima of the entropy on the surface."""
        fit = self.fit(options)
        entropy, number = np.ones(self.texels.count), np.full(self.texels.count, -1)
        entropy[self.seen], number[self.seen] = fit.start.entropy.numpy(), np.arange(len(self.seen))
        found, worth = candidates(entropy, self.coverage > 0, around)
        own = fit.start.table()
        if len(found):
            found = found[spread(own[:, number[found]].T, worth, SEEDS)]
        return find_materials(fit.statistics, fit.start, own, number[found])

    def textures(self, values: np.ndarray) -> Textures:
        """Lay parameters (5, S) of seen texels out; others take the mean of these."""
        filled = np.empty((5, self.texels.count), np.float32)
        filled[:] = values.mean(axis=1, keepdims=True)
        filled[:, self.seen] = values
        return lay_out(
            self.texels,
            {"base_color": filled[:3].T, "roughness": filled[3], "metallic": filled[4]},
        )


@dataclass(frozen=True)
class Fit:
    """What the statistics of S seen texels say.

    Attributes:
        statistics: of the texels.
        start: their parameters, each for itself.
        loss: how far textures are from the statistics.
    """

    statistics: ErrorFactors
    start: Start
    loss: StatisticsLoss


def prepare(capture: Capture, texels: Texels) -> Prepared:
    """Find out who sees whom.

    Args:
        capture: scene, photographs and light.
        texels: of ``capture.mesh``.

    Raises:
        CaptureError: no texel is seen with any radiance.
    """
    views = pack_views(capture, 3)
    found = survey(views, Surface.of(texels))
    if not found.scale > 0:
        raise CaptureError(
            f"No texel of '{capture.shape.id()}' is seen with any radiance; check poses (camera "
            "space is +X left, +Y up, +Z forward), masks and exposures."
        )
    return Prepared(capture, texels, views, found)
