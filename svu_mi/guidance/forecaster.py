"""From an estimate to forecasts of some of its texels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.guidance import angular, spectral
from svu_mi.guidance.angular import AngularForecast
from svu_mi.guidance.forecast import Forecast, numbers
from svu_mi.guidance.hypotheses import Hypotheses
from svu_mi.guidance.measures import Entropy
from svu_mi.guidance.responses import Respond, collect
from svu_mi.guidance.spectral import SpectrumForecast
from svu_mi.interop import owned
from svu_mi.observed import Observed
from svu_mi.options import AngularPreset, AnyPreset, Preset, preset
from svu_mi.pipeline import Estimate
from svu_mi.pipeline import estimate as estimate_again
from svu_mi.posterior import CalibratedPosterior, ParameterGrid, PrincipledGrid
from svu_mi.posterior.angular import AngularPosterior
from svu_mi.posterior.spectrum import SpectrumPosterior
from svu_mi.visibility import Surface, Views, pack_sensors


class Forecaster(ABC):
    """Makes forecasts; what all texels have in common is made once."""

    columns: int

    def __init__(self, estimate: Estimate, observed: Observed) -> None:
        self.estimate, self.observed = estimate, observed

    def pack(self, sensors: Sequence[Any]) -> Views:
        """Lay candidates out, once for all texels."""
        capture = self.observed.capture
        return pack_sensors(capture.scene, capture.shape, sensors)

    def forecast(
        self, texels: np.ndarray, candidates: Views, hypotheses: int, seed: int
    ) -> Forecast:
        """Look at texels from sensors that have not taken a photograph.

        Args:
            texels: (t,) int64 indices of texels of the estimate.
            candidates: views, as ``pack`` returns them.
            hypotheses: most psi per texel.
            seed: of their draw.
        """
        seen = self.observed
        surface, respond = self._respond(texels)
        responses = collect(
            surface, (seen.views, seen.found), candidates, respond, self.columns
        )
        return self._forecast(
            responses=responses,
            # A texel draws the same, whichever others are looked at.
            hypotheses=Hypotheses.draw(
                self._probabilities(texels), hypotheses,
                np.random.default_rng(seed).random(seen.texels.count)[texels],
            ),
            prior=_energies(self.estimate.posterior.problem.prior),  # type: ignore[attr-defined]
        )

    @abstractmethod
    def _respond(self, texels: np.ndarray) -> tuple[Surface, Respond]:
        """Texels as a launch, and what evaluates a view of them."""

    @abstractmethod
    def _forecast(self, **parts: Any) -> Forecast:
        """Put a forecast together."""

    def _probabilities(self, texels: np.ndarray) -> np.ndarray:
        """p(psi | B, L), (t, N)."""
        return np.array(self.estimate.posterior.probabilities_of(texels)).reshape(len(texels), -1)


class AngularForecaster(Forecaster):
    """``Forecaster`` by angular statistics, in grey."""

    def __init__(self, estimate: Estimate, observed: Observed) -> None:
        super().__init__(estimate, observed)
        grid = estimate.posterior.grid
        if not isinstance(grid, PrincipledGrid):
            raise OptionError(
                "next_best_view(): an angular estimate of (roughness, Ks) says nothing of what "
                "photographs would show; use parameters='principled', as the default preset does."
            )
        _require(estimate.preset, noise=("fixed", "relative", "heteroscedastic"),
                 channels=("grey",))  # fmt: skip
        self.grid = grid
        self.columns = angular.columns(grid.shape[0])

    def _respond(self, texels: np.ndarray) -> tuple[Surface, Respond]:
        seen, switches = self.observed, self.estimate.preset
        assert isinstance(switches, AngularPreset)
        model = seen.model(self.grid.roughness_nodes, switches, 1, texels)
        sigma = switches.sigma * (1.0 if switches.noise == "fixed" else seen.unit)
        return model.surface, angular.respond(
            seen.views.scene, model, dr.opaque(mi.Float, sigma)
        )

    def _forecast(self, **parts: Any) -> Forecast:
        switches = self.estimate.preset
        growth = 2**0.5 * switches.sigma if switches.noise == "heteroscedastic" else 0.0
        measure = Entropy(int(np.prod(self.grid.shape)))
        return AngularForecast(
            grid=self.grid, growth=growth, grazing=False, measure=measure, **parts
        )  # fmt: skip


class SpectrumForecaster(Forecaster):
    """``Forecaster`` by power spectra."""

    def __init__(self, estimate: Estimate, observed: Observed) -> None:
        super().__init__(estimate, observed)
        grid = estimate.posterior.grid
        if not isinstance(grid, ParameterGrid):
            raise OptionError(
                "next_best_view(): spectra of photographs to come are known over (roughness, Ks) "
                "only; use preset='paper' or parameters='specular', or method='angular'."
            )
        _require(estimate.preset, noise=("fixed", "relative"), channels=("grey", "sum"))
        self.grid = grid
        assert isinstance(estimate.preset, Preset)
        self.switches = estimate.preset
        self.columns = spectral.columns(self.switches)

    def _respond(self, texels: np.ndarray) -> tuple[Surface, Respond]:
        seen = self.observed
        surface = Surface.of(seen.texels, numbers(texels))
        return surface, spectral.respond(seen.views.scene, surface, seen.lighting, self.switches)

    def _forecast(self, **parts: Any) -> Forecast:
        problem = self.estimate.posterior.problem  # type: ignore[attr-defined]
        return SpectrumForecast(
            grid=self.grid, switches=self.switches, sigma=float(problem.sigma[0]),
            prefilter=self.observed.lighting.prefilter, **parts,
        )  # fmt: skip


def forecaster(estimate: Estimate) -> Forecaster:
    """Return what makes forecasts by the method of an estimate.

    Raises:
        OptionError: an estimate that was not made from a capture, or is over parameters that
            do not say what photographs would show.
    """
    if estimate.observed is None:
        raise OptionError(
            "next_best_view(): the estimate does not know its capture; use what svu.estimate() "
            "returns."
        )
    observed, posterior = estimate.observed, estimate.posterior
    if isinstance(posterior, CalibratedPosterior):
        # Forecasts know one noise for all, and grey; what is believed of materials stays.
        assumed = preset("fixed", method="angular")
        estimate = estimate_again(
            observed, preset=assumed, grid=posterior.grid, prior=posterior.prior
        )
    if isinstance(estimate.posterior, AngularPosterior):
        return AngularForecaster(estimate, observed)
    assert isinstance(estimate.posterior, SpectrumPosterior)
    return SpectrumForecaster(estimate, observed)


def _require(switches: AnyPreset, **allowed: tuple[str, ...]) -> None:
    """Refuse switches whose entropy cannot be foretold."""
    for name, values in allowed.items():
        if getattr(switches, name) not in values:
            raise OptionError(
                f"next_best_view(): an estimate with {name}={getattr(switches, name)!r} does not "
                f"say what photographs would add; use {name}={' or '.join(map(repr, values))}."
            )


def _energies(prior: tuple[Any, Any] | None) -> Any | None:
    """-log prior of every cell, (N,) Float, from those of rows, and of cells given their row."""
    if prior is None:
        return None
    row, cell = (np.array(part, np.float64) for part in prior)
    total = row[:, None] + cell.reshape(len(row), -1)
    return owned(mi.Float, np.minimum(total - total.min(), 1e4).astype(np.float32).ravel())
