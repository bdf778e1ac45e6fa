"""Inputs of guidance strategies, computed on first use."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from svu_mi.capture.sensors import bounding_sphere, directions_of
from svu_mi.geometry.packed_views import Views, pack_sensors
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.geometry.visibility import Visibility
from svu_mi.guidance.angular_forecast import AngularForecast
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.forecast import Forecast, numbers
from svu_mi.guidance.greedy import GreedyScorer
from svu_mi.guidance.guidance_options import GuidanceOptions
from svu_mi.guidance.make_forecast import forecast_of
from svu_mi.guidance.objectives import VarianceMeasure
from svu_mi.guidance.predicted_responses import cosines
from svu_mi.guidance.strategies import TABLE
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.tables import marginals

LEAST_VARIANCE = 1e-4  # lower bound of the mean variance that others are divided by


@dataclass(frozen=True)
class StrategyInputs:
    """An estimate, C candidates, and the (t,) int64 texels over which scores are averaged."""

    estimate: Estimate
    observed: Observed
    candidates: Candidates
    texels: np.ndarray
    options: GuidanceOptions

    @property
    def photographs(self) -> int:
        """Number of photographs; candidate indices follow them."""
        return self.observed.views.number

    @cached_property
    def directions(self) -> np.ndarray:
        """Unit vectors (V, 3) from the object to the photographs, then to the candidates."""
        capture = self.observed.capture
        center, _ = bounding_sphere(capture.shape)
        return directions_of((*capture.used_sensors, *self.candidates.sensors), center)

    @cached_property
    def seen(self) -> np.ndarray:
        """Visibility of texels in views, (V, t) bool."""
        if TABLE[self.options.strategy].needs_forecast:
            return self.forecast.seen
        return self.trace((self.observed.views, self.observed.visibility))

    def trace(self, photographed: tuple[Views, Visibility] | None = None) -> np.ndarray:
        """Trace the visibility of texels in ``photographed`` views, then candidates, bool."""
        surface = TexelLanes.of(self.observed.texels, numbers(self.texels))
        visible = cosines(surface, photographed, self._packed)
        return np.asarray(visible.numpy() > 0).reshape(-1, len(self.texels))

    @cached_property
    def forecast(self) -> Forecast:
        """Forecast of the entropy with a photograph from any candidate."""
        return forecast_of(
            self.estimate, self.texels, self._packed, self.options, self.candidates.sensors
        )

    @cached_property
    def greedy(self) -> GreedyScorer:
        """Scorer by expected entropy."""
        return self._greedy(self.forecast, self.options.lazy)

    def by_error(self) -> GreedyScorer:
        """Return the scorer by expected squared error, relative to the present mean error."""
        posterior, seen = self.estimate.posterior, self.observed.coverage > 0
        if isinstance(posterior.kernel, CalibratedKernel):
            # Exclude the common scale: no candidate determines the brightness of the light.
            posterior = replace(posterior, kernel=posterior.kernel.alone())
        present, prior = [], []
        for name, p in marginals(posterior.prior, list(posterior.axes)).items():
            nodes = posterior.axes[name]
            spread = np.array(posterior.sd(name), np.float64)[seen] ** 2
            # The bound excludes parameters that are already known.
            present.append(max(float(spread.mean()), LEAST_VARIANCE))
            prior.append(float(p @ (nodes - p @ nodes) ** 2))
        forecast = self.forecast
        assert isinstance(forecast, AngularForecast)
        measure = VarianceMeasure(tuple(present), tuple(prior), forecast.channels)
        # Not lazy: the expected error may grow with a view, e.g. if two explanations remain.
        return self._greedy(replace(forecast, measure=measure), lazy=False)

    @cached_property
    def _packed(self) -> Views:
        capture = self.observed.capture
        return pack_sensors(capture.scene, capture.shape, self.candidates.sensors, later=True)

    def _greedy(self, forecast: Forecast, lazy: bool) -> GreedyScorer:
        return GreedyScorer(forecast, self.photographs, self.candidates.reachable, lazy=lazy)
