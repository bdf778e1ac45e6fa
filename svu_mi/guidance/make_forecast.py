"""Forecasts of an estimate's entropy, with hypotheses drawn from its posterior."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.guidance import angular_forecast, spectral_forecast
from svu_mi.guidance.angular_forecast import AngularForecast
from svu_mi.guidance.forecast import Forecast, Hypotheses, numbers
from svu_mi.guidance.growing_band_limit import GrowingForecast
from svu_mi.guidance.guidance_options import GuidanceOptions
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
"""Probabilities (t, N) of texels and prior (N,) -> truths."""


def forecast_of(
    estimate: Estimate, texels: np.ndarray, candidates: Views, options: GuidanceOptions
) -> Forecast:
    """Make the forecast of texels for candidate views."""
    options = options.resolved(estimate.preset)
    require_band_limit(estimate.method, options)
    observed = observations_of(estimate, None)
    # A texel draws the same, whichever others are looked at.
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
    return _angular_forecast(estimate.posterior, estimate.switches, observed, texels, collect, draw)


def _angular_forecast(
    posterior: Posterior[CalibratedKernel | AngularKernel], switches: AnyPreset, observed: Observed,
    texels: np.ndarray, collect: CollectFunction, draw: DrawFunction,
) -> AngularForecast:  # fmt: skip
    """Make a forecast with the energies of the estimate."""
    grid, by_nodes = posterior.grid, isinstance(posterior.kernel, AngularKernel)
    if not isinstance(grid, PrincipledGrid):
        raise OptionError(
            "next_best_view(): an angular estimate of (roughness, Ks) does not predict "
            "photographs; use parameters='principled', as the default preset does.",
            shell="An estimate of roughness and Ks does not predict photographs; leave --preset "
            "out.",
        )
    assert isinstance(switches, AngularPreset)
    if switches.fit is not None:
        raise OptionError(
            f"next_best_view(): the SH model (preset {switches.name!r}) knows light only where "
            "photographs were taken; use method='spectrum', preset='paper' for Eq. 13, or another "
            "preset.",
            shell=f"The SH model (preset {switches.name}) knows light only where photographs were "
            "taken; give --method spectrum with --preset paper for Eq. 13, or another preset.",
        )
    if by_nodes and switches.channels == "joint":
        raise OptionError(
            "next_best_view(): an estimate with channels='joint' does not predict what photographs "
            "would add; use channels='grey'.",
            shell=f"An estimate with the preset {switches.name} does not predict what "
            "photographs would add; use another.",
        )
    channels = posterior.kernel.problem.factors.channels
    # Grey light has one lobe for all channels.
    lobes = 1 if observed.lighting.environment.grey else channels
    model = observed.model(grid.roughness_nodes, switches, lobes, texels)
    responses = collect(
        model.surface, angular_forecast.respond(observed.views.scene, model),
        angular_forecast.columns(grid.shape[0], lobes),
    )  # fmt: skip
    edges = bin_edges(grid.base_color_nodes)
    usual = bin_widths(edges)
    if by_nodes:  # a prior of nodes, of which none is more likely
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
    """Return row masses (t, rows), and each row's base colour if true, (t, rows, C)."""
    kernel, nodes = posterior.kernel, posterior.grid.axes["base_color"]
    if not isinstance(kernel, CalibratedKernel):
        p = np.array(posterior.probabilities_of(texels))
        p = p.reshape(len(p), -1, len(nodes), posterior.channels)[..., :: kernel.problem.copies]
        # Between nodes, no colour might explain what a row shows.
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
    """s^2 tau of all texels, (T,); of those nobody saw, the median of the others."""
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
    grid = posterior.grid
    if not isinstance(grid, ParameterGrid):
        raise OptionError(
            "next_best_view(): spectra of new photographs can be predicted over (roughness, Ks) "
            "only; use preset='paper' or parameters='specular', or method='angular'.",
            shell="Spectra of new photographs can be predicted over roughness and Ks only; give "
            "--preset paper with --method spectrum, or leave both out.",
        )
    assert isinstance(switches, Preset)
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
    """Make a forecast in the light of one more view, with truths weighted by the photographs."""
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


def require_band_limit(method: str, options: GuidanceOptions) -> None:
    """Refuse a growing band limit for estimates other than by power spectra."""
    if options.band_limit == "growing" and method != "spectrum":
        raise OptionError(
            "next_best_view(): band_limit='growing' is about power spectra (Eq. 13); use "
            "method='spectrum' over (roughness, Ks), such as preset='paper', or omit it.",
            shell="--band-limit growing is about power spectra (Eq. 13); give --method spectrum "
            "with --preset paper, or omit it.",
        )


def _entropy_measure(posterior: Posterior) -> EntropyMeasure:
    """Return the measure in units of the posterior's entropy; known parameters have one node."""
    return EntropyMeasure(max(posterior.max_entropy, 1e-6), posterior.prior_entropy)


def _prior_energies(prior: tuple[Any, Any] | None) -> Any | None:
    """-log prior of every cell, (N,) Float, from those of rows, and of cells given their row."""
    if prior is None:
        return None
    row, cell = (np.array(part, np.float64) for part in prior)
    total = row[:, None] + cell.reshape(len(row), -1)
    return to_drjit(mi.Float, np.minimum(total - total.min(), 1e4).astype(np.float32).ravel())
