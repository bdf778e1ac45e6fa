"""Estimators: from observations to a posterior, by angles or by spectra.

A plan selects work that does not change results. Degrees beyond the band-limited light are not
skipped: samples on part of a sphere leak power into them (BENCHMARKS.md).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.replace_material import constant_parameters
from svu_mi.core.arrays import to_drjit
from svu_mi.core.memory import TILE
from svu_mi.core.progress import Progress, Stage
from svu_mi.core.validation import MAX_LANES
from svu_mi.errors import OptionError
from svu_mi.frequency.spectra import fit_spectra
from svu_mi.posterior.angular import angular_posterior
from svu_mi.posterior.calibrated import calibrated_posterior
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.row_entropy import IMPOSSIBLE
from svu_mi.posterior.spectrum import spectrum_posterior
from svu_mi.posterior.tiled import TiledKernel
from svu_mi.presets import AngularPreset, AnyPreset, Preset, Skip
from svu_mi.statistics.cholesky_factors import Factors, stride
from svu_mi.statistics.gather_statistics import Weighting

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Work to do.

    Attributes:
        copies: number of equal channels that each one stands for.
        levels: (R,) bool, roughness nodes to compute.
    """

    channels: int
    light_channels: int
    copies: int
    levels: np.ndarray
    skipped: dict[str, int]


@dataclass(frozen=True)
class Run:
    """Inputs of both estimators; ``whole`` keeps the statistics of all texels, however many."""

    observed: Observed
    grid: Any
    prior: Any | None
    plan: Plan
    progress: Progress
    whole: bool


def from_angles(run: Run, switches: AngularPreset) -> Posterior:
    """Compare photographs with what the reflection model predicts for them, by statistics."""
    seen, count = run.observed, len(run.observed.seen)
    # What is global is made once, for all tiles.
    if seen.texels.count <= TILE:  # seen or not: what is announced does not know
        return _of_all(run, switches)
    if run.whole:
        return _of_all_in_tiles(run, switches)
    with run.progress.stage("Gathering statistics", count) as stage:
        observed = counted(seen, switches) > 0
        kernel = TiledKernel(
            grid=run.grid, observed=observed, report=stage.update,
            make=lambda texels: _of_tile(run, switches, texels).kernel,
        )  # fmt: skip
        tiled = Posterior(kernel=kernel, observed=observed)
        tiled.entropy()
    return tiled


def _of_all(run: Run, switches: AngularPreset) -> Posterior:
    seen = run.observed
    if switches.traced:
        with run.progress.stage("Tracing occlusion"):
            seen.light_visibility(switches.cells, occluded=switches.occluded)
    with run.progress.stage("Gathering statistics"):
        chosen = np.flatnonzero(seen.coverage) if _leaves_clipped_out(seen, switches) else None
        factors = _factors(run, seen, switches, chosen)
    return _posterior(run, switches, factors, _rounding(seen, switches), seen.texels.count)


def _of_all_in_tiles(run: Run, switches: AngularPreset) -> Posterior:
    """The same, but of no more than a tile are there sums, and what reaches it of the light."""
    seen, texels = run.observed, run.observed.seen
    if _leaves_clipped_out(seen, switches):
        texels = np.flatnonzero(seen.coverage)
    rows = stride(len(_levels(run, switches)), run.plan.channels)
    if rows * len(texels) > MAX_LANES:
        raise OptionError(
            f"{len(texels)} texels that are seen are too many to keep the statistics of; use at "
            f"most {MAX_LANES // rows}, with fewer texels per side (--resolution)."
        )
    rounded: list[np.ndarray | None] = []

    def of_tiles(stage: Stage) -> Iterator[Factors]:
        for first in range(0, len(texels), TiledKernel.size):
            part = seen.subset(texels[first : first + TiledKernel.size])
            yield _factors(run, part, switches, None)
            rounded.append(_rounding(part, switches))
            stage.update(first + len(part.seen), len(texels))

    with run.progress.stage("Gathering statistics", len(texels)) as stage:
        factors = Factors.concatenated(of_tiles(stage), len(texels))
        dr.flush_malloc_cache()  # the sums of a tile, which nobody needs any more
    told = [part for part in rounded if part is not None]  # of all tiles, or of none
    rounding = np.concatenate(told) if told else None
    return _posterior(run, switches, factors, rounding, seen.texels.count)


def _of_tile(run: Run, switches: AngularPreset, texels: np.ndarray) -> Posterior:
    """Return the posterior of some texels, which it numbers from 0."""
    part = run.observed.subset(texels)
    own = np.arange(len(texels))
    if _leaves_clipped_out(part, switches):
        own = np.flatnonzero(part.coverage[texels])
        part = part.subset(texels[own])
    factors = _factors(run, part, switches, None)
    factors = replace(factors, texel=to_drjit(mi.UInt32, own.astype(np.uint32)))
    return _posterior(run, switches, factors, _rounding(part, switches), len(texels))


def _factors(
    run: Run, seen: Observed, switches: AngularPreset, texels: np.ndarray | None
) -> Factors:
    """Gather the statistics of texels, by default of those of ``seen``, and factor them."""
    return seen.factors(
        _levels(run, switches), switches, run.plan.channels,
        light_channels=run.plan.light_channels, weighting=_weighting(seen, switches), texels=texels,
    )  # fmt: skip


def _weighting(seen: Observed, switches: AngularPreset) -> Weighting:
    edges = switches.edges if switches.noise == "estimated" else 0.0
    return Weighting(switches.kappa(seen.unit), edges)


def _rounding(seen: Observed, switches: AngularPreset) -> np.ndarray | None:
    """Return what rounding does to the texels of ``seen``, where noise is estimated."""
    return seen.rounding(_weighting(seen, switches)) if switches.noise == "estimated" else None


def _posterior(
    run: Run, switches: AngularPreset, factors: Factors, rounding: np.ndarray | None, texels: int
) -> Posterior:
    plan, seen = run.plan, run.observed
    if switches.noise == "estimated":
        return calibrated_posterior(
            factors, run.grid, seen.unit, switches, prior=run.prior, copies=plan.copies,
            texels=texels, light_uncertainty=seen.capture.light_uncertainty, rounding=rounding,
        )  # fmt: skip
    return angular_posterior(
        factors, run.grid, seen.unit, switches,
        prior=run.prior, copies=plan.copies, levels=plan.levels, texels=texels,
    )  # fmt: skip


def _leaves_clipped_out(seen: Observed, switches: AngularPreset) -> bool:
    return seen.clipped_coverage is not None and not takes_clipped(switches)


def counted(seen: Observed, switches: AnyPreset) -> np.ndarray:
    """Return the number of views that show each texel to an estimator, (T,) uint32."""
    if seen.clipped_coverage is None or not takes_clipped(switches):
        return seen.coverage
    return seen.shown


def _levels(run: Run, switches: AngularPreset) -> np.ndarray:
    """Levels of roughness to gather at: those of the grid that are possible, or even ones."""
    nodes = run.grid.roughness_nodes
    if switches.noise == "estimated" and len(nodes) > 1:
        return np.linspace(0, 1, switches.levels)
    return np.asarray(nodes[run.plan.levels])


def from_spectra(run: Run, switches: Preset) -> Posterior:
    """Compare the power spectra of photographs and light (Sec. 3.3 of the paper)."""
    plan, seen = run.plan, run.observed
    irradiance = None
    if isinstance(run.grid, PrincipledGrid):
        with run.progress.stage("Tracing occlusion"):
            irradiance = _irradiance(seen, plan, switches)
    with run.progress.stage("Fitting spectra"):
        spectra = fit_spectra(
            seen, switches, channels=plan.channels, light_channels=plan.light_channels,
            skip_unseen=len(seen.seen) < seen.texels.count,
        )  # fmt: skip
    with run.progress.stage("Computing entropy"):
        return spectrum_posterior(
            spectra.incoming,
            spectra.outgoing,
            run.grid,
            preset=switches,
            prefilter=seen.lighting.prefilter,
            prior=run.prior,
            observed=seen.visibility.coverage > 0,
            irradiance=irradiance,
            copies=plan.copies,
        )


def _irradiance(seen: Observed, plan: Plan, switches: Preset) -> np.ndarray:
    """(T, C) irradiance of texels that may be seen; 0 for others."""
    result = np.zeros((seen.texels.count, plan.channels), np.float32)
    light = seen.irradiance(switches, plan.light_channels)
    result[seen.seen] = np.stack([value.numpy() for value in light], axis=-1)
    return result  # one channel of grey light is all of them


def takes_clipped(switches: AnyPreset) -> bool:
    """Return whether texels are seen, too, where they are brighter than photographs can say."""
    return isinstance(switches, AngularPreset) and switches.kappa(1.0) < np.inf


def widened(switches: AnyPreset, capture: Capture) -> AnyPreset:
    """Return switches of a posterior that knows how uncertain the light is."""
    uncertainty = capture.light_uncertainty
    if uncertainty is None or not isinstance(switches, AngularPreset):
        return switches
    return replace(switches, overdispersion=switches.overdispersion * uncertainty.widening)


def make_plan(
    skip: Skip,
    switches: AnyPreset,
    observed: Observed,
    grid: ParameterGrid | PrincipledGrid,
    prior: tuple[np.ndarray, np.ndarray] | None,
) -> Plan:
    """Plan the work; ``prior`` are the tables of ``streaming.log_prior``."""
    grey_light = skip.channels and switches.colors == 3 and observed.lighting.environment.grey
    # Grey photographs of coloured light: no less work.
    grey = grey_light and observed.views.grey
    levels = np.ones(grid.shape[0], bool)
    if skip.levels and prior is not None:
        levels = np.any(prior[0].reshape(grid.shape[0], -1) < IMPOSSIBLE, axis=1)
    texels, capture = observed.texels, observed.capture
    width, height = texels.resolution
    skipped = {
        "texels outside the charts": width * height - texels.count - texels.overlapping,
        "texels on overlapping charts": texels.overlapping,
        "texels never seen": int((observed.shown == 0).sum()),
        "views left out": capture.count - sum(capture.used),
        "views that show no texel": int((observed.visibility.per_view == 0).sum()),
        "channels of the light equal to another": 2 if grey_light else 0,
        "channels of the photographs equal to another": 2 if grey else 0,
        "roughness levels that the prior excludes": int((~levels).sum()),
        "parameters known": len(grid.known),
    }
    for reason, count in skipped.items():
        if count:
            log.info("Skipped: %d %s.", count, reason)
    return Plan(
        channels=1 if grey else switches.colors,
        light_channels=1 if grey_light else switches.colors,
        copies=3 if grey else 1,
        levels=levels,
        skipped=skipped,
    )


def with_known(
    grid: ParameterGrid | PrincipledGrid, known: Mapping[str, float] | str | None, shape: Any
) -> Any:
    """Return a grid without known parameters: values by name, or ``"scene"`` for its constants."""
    constants = constant_parameters(shape)
    constants = {name: value for name, value in constants.items() if name in grid.axes}
    if isinstance(known, str):
        if known != "scene":
            raise OptionError(f"known must be values by parameter, or 'scene', got {known!r}.")
        known = constants
    elif known is not None and not isinstance(known, Mapping):
        raise OptionError(f"known must be values by parameter, or 'scene', got {known!r}.")
    elif constants and not known:
        log.info(
            "The scene's material does not vary %s; if that is not a placeholder, known='scene' "
            "(--known scene) takes it as known.",
            " and ".join(constants),
        )
    return replace(grid, known={**grid.known, **known}) if known else grid
