"""Construction of forecasts from an estimate, with hypotheses drawn from its posterior."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.guidance import angular_forecast, spectral_forecast
from svu_mi.guidance.angular_forecast import AngularForecast
from svu_mi.guidance.forecast import Forecast, Hypotheses, numbers
from svu_mi.guidance.growing_band_limit import GrowingForecast
from svu_mi.guidance.guidance_options import GuidanceOptions, require_prediction
from svu_mi.guidance.objectives import Colors, EntropyMeasure, prior_tables
from svu_mi.guidance.predicted_responses import ResponseFunction, Responses, collect_responses
from svu_mi.guidance.spectral_forecast import SpectrumForecast
from svu_mi.light.band_limited import band_limited_lighting
from svu_mi.posterior.angular import AngularKernel
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.estimate import Estimate, observations_of
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.quadrature import bin_edges, bin_widths
from svu_mi.posterior.spectrum import SpectrumKernel
from svu_mi.posterior.tables import row_colors
from svu_mi.presets import AngularPreset, AnyPreset, Preset

CollectFunction = Callable[[TexelLanes, ResponseFunction, int], Responses]
DrawFunction = Callable[[np.ndarray, np.ndarray], Hypotheses]
"""Probabilities (t, N) of texels and prior (N,) -> drawn hypotheses."""


def forecast_of(
    estimate: Estimate, texels: np.ndarray, candidates: Views, options: GuidanceOptions,
    sensors: Sequence[Any],
) -> Forecast:  # fmt: skip
    """Return the forecast of ``texels`` for candidate views with ``sensors``."""
    options = options.resolved(estimate.preset)
    require_prediction(estimate.preset)
    observed = observations_of(estimate, None)
    # One random number per texel of the capture: draws do not depend on the chosen texels.
    starts = np.random.default_rng(options.seed).random(observed.texels.count)[texels]

    def collect(surface: TexelLanes, respond: ResponseFunction, columns: int) -> Responses:
        photographed = observed.views, observed.visibility
        return collect_responses(surface, photographed, candidates, respond, columns)

    def draw(weights: np.ndarray, prior: np.ndarray) -> Hypotheses:
        return Hypotheses.draw(weights, options.hypotheses, starts, int((prior > 0).sum()))

    if isinstance(estimate.posterior.kernel, SpectrumKernel):
        known = _spectrum_forecast(
            estimate.posterior, estimate.switches, observed, texels, collect, draw
        )
        if options.band_limit == "photographs":
            return known
        return _growing_forecast(known, estimate.posterior, observed, texels, collect)
    assert isinstance(estimate.posterior.kernel, CalibratedKernel | AngularKernel)
    return _angular_forecast(
        estimate.posterior, estimate.switches, observed, texels, collect, draw, sensors
    )


def _angular_forecast(
    posterior: Posterior[CalibratedKernel | AngularKernel], switches: AnyPreset, observed: Observed,
    texels: np.ndarray, collect: CollectFunction, draw: DrawFunction, sensors: Sequence[Any],
) -> AngularForecast:  # fmt: skip
    """Return a forecast with the energies of the angular estimate."""
    grid, by_nodes = posterior.grid, isinstance(posterior.kernel, AngularKernel)
    assert isinstance(grid, PrincipledGrid) and isinstance(switches, AngularPreset)
    channels = posterior.kernel.problem.factors.channels
    # Grey light: one lobe serves all channels.
    lobes = 1 if observed.grey_light(switches) else channels
    model = observed.model(grid.roughness_nodes, switches, lobes, texels)
    if model.flash is not None:
        model = replace(model, flash=observed.flash_of(sensors))
    responses = collect(
        model.surface, angular_forecast.respond(observed.views.scene, model),
        angular_forecast.columns(grid.shape[0], lobes),
    )  # fmt: skip
    edges = bin_edges(grid.base_color_nodes)
    usual = bin_widths(edges)
    if by_nodes:  # discrete colours: uniform over nodes
        usual = np.full(len(usual), 1 / len(usual))
    prior, given = prior_tables(posterior.prior, usual)
    nodes = grid.base_color_nodes if by_nodes else None
    colors = Colors(edges, posterior.kernel.problem.copies, given, nodes)
    rows, truths = _row_truths(posterior, texels)
    variance = _noise_variance(posterior, switches, observed.unit)[texels]
    return AngularForecast(
        responses=responses, hypotheses=draw(rows, posterior.prior.sum(axis=2).ravel()),
        grid=grid, prior=prior, measure=_entropy_measure(posterior),
        truths=to_drjit(mi.Float, truths.ravel()), channels=channels,
        precision=to_drjit(mi.Float, 0.5 / variance), kappa=switches.kappa(observed.unit),
        averaged=by_nodes and switches.errors == "mean", colors=colors,
    )  # fmt: skip


def _row_truths(posterior: Posterior[Any], texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return row masses (t, rows), and base colours to assume for true rows, (t, rows, C)."""
    kernel, nodes = posterior.kernel, posterior.grid.axes["base_color"]
    if not isinstance(kernel, CalibratedKernel):
        p = np.array(posterior.probabilities_of(texels))
        p = p.reshape(len(p), -1, len(nodes), posterior.channels)[..., :: kernel.problem.copies]
        # Use a node: a colour between nodes may fit no cell of the grid.
        return p[..., 0].sum(axis=2, dtype=np.float64), nodes[p.argmax(axis=2)]
    prior = posterior.prior.astype(np.float32).reshape(1, -1, len(nodes), 1)
    masses = np.repeat(prior[..., 0].sum(axis=2, dtype=np.float64), len(texels), axis=0)
    colors = np.empty((*masses.shape, kernel.problem.factors.channels))
    colors[:] = row_colors(prior, kernel.problem.edges)
    seen = np.flatnonzero(posterior.observed[texels])
    for span in kernel.chunks(len(seen)):
        masses[seen[span]], colors[seen[span]] = kernel.rows(texels[seen[span]])
    return masses, colors


def _noise_variance(
    posterior: Posterior[CalibratedKernel | AngularKernel], switches: AngularPreset, unit: float
) -> np.ndarray:
    """Return s^2 tau of all texels, (T,); unseen texels have the median of the seen ones."""
    if isinstance(posterior.kernel, AngularKernel):
        sigma = switches.sigma * (1.0 if switches.noise == "fixed" else unit)
        return np.full(posterior.count, sigma**2)
    noise = posterior.kernel.noise
    variance = np.full(posterior.count, np.median(noise) ** 2)
    variance[posterior.kernel.problem.factors.texel.numpy()] = noise**2
    return variance * switches.overdispersion


def _spectrum_forecast(
    posterior: Posterior[SpectrumKernel], switches: AnyPreset, observed: Observed,
    texels: np.ndarray, collect: CollectFunction, draw: DrawFunction,
) -> SpectrumForecast:  # fmt: skip
    """Return a forecast by power spectra; the light has the estimate's band limit."""
    grid = posterior.grid
    assert isinstance(grid, ParameterGrid) and isinstance(switches, Preset)
    surface = TexelLanes.of(observed.texels, numbers(texels))
    respond = spectral_forecast.respond(observed.views.scene, surface, observed.lighting, switches)
    p = np.array(posterior.probabilities_of(texels))
    return SpectrumForecast(
        responses=collect(surface, respond, spectral_forecast.columns(switches)),
        hypotheses=draw(p.reshape(len(p), -1), posterior.prior.ravel()), grid=grid,
        prior=_prior_energies(posterior.kernel.problem.prior),
        measure=_entropy_measure(posterior), switches=switches,
        sigma=float(posterior.kernel.problem.sigma[0]), prefilter=observed.lighting.prefilter,
    )  # fmt: skip


def _growing_forecast(
    known: SpectrumForecast, posterior: Posterior[SpectrumKernel], observed: Observed,
    texels: np.ndarray, collect: CollectFunction,
) -> GrowingForecast:  # fmt: skip
    """Return a forecast whose light, and thus the likelihood, sharpens with every view."""
    switches, environment = known.switches, observed.lighting.environment
    surface = TexelLanes.of(observed.texels, numbers(texels))

    def relight(views: int) -> tuple[Responses, float]:
        lighting = band_limited_lighting(environment, views)
        respond = spectral_forecast.respond(observed.views.scene, surface, lighting, switches)
        return collect(surface, respond, spectral_forecast.columns(switches)), lighting.prefilter

    problem, seen = posterior.kernel.problem, posterior.observed[texels]
    (channels,) = problem.groups
    shown = problem.outgoing.numpy().reshape(posterior.count, problem.degree + 1, -1)
    weights = np.broadcast_to(posterior.prior.ravel(), (len(texels), posterior.prior.size))
    return GrowingForecast(
        responses=known.responses, hypotheses=Hypotheses.of(weights), grid=known.grid,
        prior=known.prior, measure=known.measure, switches=switches, sigma=known.sigma,
        prefilter=known.prefilter, relight=relight, observed=to_drjit(mi.Bool, seen),
        photographs=to_drjit(mi.Float, shown[texels][:, :, list(channels)].ravel()),
    )  # fmt: skip


def _entropy_measure(posterior: Posterior) -> EntropyMeasure:
    """Return the entropy measure in the posterior's unit."""
    return EntropyMeasure(max(posterior.max_entropy, 1e-6), posterior.prior_entropy)


def _prior_energies(prior: tuple[Any, Any] | None) -> Any | None:
    """Return -log prior of cells, (N,) Float: sum of row and cell-given-row energies."""
    if prior is None:
        return None
    row, cell = (np.array(part, np.float64) for part in prior)
    total = row[:, None] + cell.reshape(len(row), -1)
    return to_drjit(mi.Float, np.minimum(total - total.min(), 1e4).astype(np.float32).ravel())
