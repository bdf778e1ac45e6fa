"""From an estimate to forecasts of some of its texels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.guidance import angular, spectral
from svu_mi.guidance.angular import AngularForecast
from svu_mi.guidance.colors import colors_of
from svu_mi.guidance.forecast import Forecast, numbers
from svu_mi.guidance.hypotheses import Hypotheses
from svu_mi.guidance.measures import Entropy
from svu_mi.guidance.responses import Respond, Responses, collect
from svu_mi.guidance.spectral import SpectrumForecast
from svu_mi.interop import owned
from svu_mi.observed import Observed
from svu_mi.options import AngularPreset, AnyPreset, Preset
from svu_mi.pipeline import Estimate, observed_of
from svu_mi.posterior import CalibratedPosterior, ParameterGrid, PrincipledGrid
from svu_mi.posterior.angular import AngularPosterior
from svu_mi.posterior.spectrum import SpectrumPosterior
from svu_mi.visibility import Surface, Views

Draw = Callable[[np.ndarray], Hypotheses]


class Forecaster(ABC):
    """Makes forecasts; what all texels have in common is made once."""

    columns: int

    def __init__(self, estimate: Estimate, observed: Observed) -> None:
        self.estimate, self.observed = estimate, observed

    def forecast(
        self, texels: np.ndarray, candidates: Views, hypotheses: int, seed: int
    ) -> Forecast:
        """Look at texels from sensors that have not taken a photograph.

        Args:
            texels: (t,) int64 indices of texels of the estimate.
            candidates: views, packed.
            hypotheses: most psi per texel.
            seed: of their draw.
        """
        seen = self.observed
        surface, respond = self._respond(texels)
        responses = collect(
            surface, (seen.views, seen.found), candidates, respond, self.columns
        )
        p = np.array(self.estimate.posterior.probabilities_of(texels))
        # A texel draws the same, whichever others are looked at.
        starts = np.random.default_rng(seed).random(seen.texels.count)[texels]
        return self._forecast(
            responses, p, texels, lambda weights: Hypotheses.draw(weights, hypotheses, starts)
        )

    @abstractmethod
    def _respond(self, texels: np.ndarray) -> tuple[Surface, Respond]:
        """Texels as a launch, and what evaluates a view of them."""

    @abstractmethod
    def _forecast(
        self, responses: Responses, p: np.ndarray, texels: np.ndarray, draw: Draw
    ) -> Forecast:
        """Put a forecast together from p(psi | B, L) of texels, (t, *grid) or (t, *grid, C)."""


class AngularForecaster(Forecaster):
    """``Forecaster`` by angular statistics, with the energies of the estimate."""

    def __init__(self, estimate: Estimate, observed: Observed) -> None:
        super().__init__(estimate, observed)
        posterior, switches = estimate.posterior, estimate.preset
        if not isinstance(posterior.grid, PrincipledGrid):
            raise OptionError(
                "next_best_view(): an angular estimate of (roughness, Ks) says nothing of what "
                "photographs would show; use parameters='principled', as the default preset does."
            )
        assert isinstance(switches, AngularPreset)
        assert isinstance(posterior, CalibratedPosterior | AngularPosterior)
        if isinstance(posterior, AngularPosterior):
            _require(switches, noise=("estimated", "fixed", "relative", "heteroscedastic"),
                     channels=("grey",))  # fmt: skip
        self.posterior, self.grid, self.switches = posterior, posterior.grid, switches
        self.channels = posterior.problem.factors.channels
        grey = observed.lighting.environment.grey
        self.lobes = 1 if grey else self.channels  # grey light has one for all channels
        self.columns = angular.columns(self.grid.shape[0], self.lobes)

    def _respond(self, texels: np.ndarray) -> tuple[Surface, Respond]:
        seen = self.observed
        model = seen.model(self.grid.roughness_nodes, self.switches, self.lobes, texels)
        return model.surface, angular.respond(seen.views.scene, model)

    def _forecast(
        self, responses: Responses, p: np.ndarray, texels: np.ndarray, draw: Draw
    ) -> Forecast:
        posterior, rows = self.posterior, int(np.prod(self.grid.shape[:2]))
        p = p.reshape(len(p), rows, self.grid.shape[2], -1)[..., : self.channels]
        weights = p[..., 0].sum(axis=2, dtype=np.float64)
        colors, prior, most = colors_of(posterior)
        return AngularForecast(
            responses=responses, hypotheses=draw(weights), grid=self.grid, prior=prior,
            truths=owned(mi.Float, colors.truths(p).ravel()), channels=self.channels,
            precision=owned(mi.Float, 0.5 / self._variance()[texels]),
            kappa=self.switches.kappa(self.observed.unit),
            averaged=isinstance(posterior, AngularPosterior), colors=colors,
            measure=Entropy(most),
        )  # fmt: skip

    def _variance(self) -> np.ndarray:
        """s^2 tau of all texels, (T,); of those nobody saw, the median of the others."""
        posterior, switches = self.posterior, self.switches
        if isinstance(posterior, AngularPosterior):
            sigma = switches.sigma * (1.0 if switches.noise == "fixed" else self.observed.unit)
            return np.full(posterior.count, sigma**2)
        variance = np.full(posterior.count, np.median(posterior.noise) ** 2)
        variance[posterior.problem.factors.texel.numpy()] = posterior.noise**2
        return variance * switches.overdispersion


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

    def _forecast(
        self, responses: Responses, p: np.ndarray, texels: np.ndarray, draw: Draw
    ) -> Forecast:
        del texels
        problem = self.estimate.posterior.problem  # type: ignore[attr-defined]
        return SpectrumForecast(
            responses=responses, prior=_energies(problem.prior), grid=self.grid,
            hypotheses=draw(p.reshape(len(p), -1)),
            switches=self.switches, sigma=float(problem.sigma[0]),
            prefilter=self.observed.lighting.prefilter,
        )  # fmt: skip


def forecaster(estimate: Estimate) -> Forecaster:
    """Return what makes forecasts by the method of an estimate.

    Raises:
        OptionError: an estimate that was not made from a capture, or is over parameters that
            do not say what photographs would show.
    """
    observed, posterior = observed_of(estimate, None), estimate.posterior
    if isinstance(posterior, CalibratedPosterior | AngularPosterior):
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
