"""The pipeline, from a capture to the posterior of every texel: the file to read first.

    capture -> texels -> observations: visibility, light -> plan
            -> statistics of all views -> posterior     (angular, Eq. 3 to 6)
            -> SH fit -> power spectra -> posterior     (spectrum, Eq. 7 to 12)

Captures are loaded by ``capture/loading.py``, texels laid out by ``geometry/texels.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.scene import require_light, require_variant
from svu_mi.core.arrays import to_drjit
from svu_mi.core.memory import TILE
from svu_mi.core.progress import Progress
from svu_mi.frequency.spectra import fit_spectra
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.angular import angular_grid
from svu_mi.posterior.estimate import Estimate, capture_and_texels, observations_of
from svu_mi.posterior.estimators import (
    EstimatorInputs,
    gather_factors,
    inflated,
    statistics_posterior,
    tiled_posterior,
    view_counts,
)
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.row_entropy import log_prior
from svu_mi.posterior.spectrum import spectrum_grid, spectrum_posterior
from svu_mi.posterior.tiled import TiledKernel
from svu_mi.posterior.work_plan import make_plan, with_known
from svu_mi.presets import AngularPreset, AnyPreset, Method, Preset, Skip
from svu_mi.presets import preset as find_preset


def estimate(
    source: Capture | Observed | Estimate,
    texels: Texels | None = None,
    method: Method = "angular",
    preset: str | AnyPreset = "default",
    *,
    grid: ParameterGrid | PrincipledGrid | None = None,
    prior: Any | None = None,
    known: Mapping[str, float] | Literal["scene"] | None = None,
    skip: Skip | None = None,
    whole: bool = False,
    progress: Progress | None = None,
) -> Estimate:
    """Estimate how much a capture says about the reflectance of every texel.

    Args:
        source: a capture (scene, photographs and light); an estimate of one, whose rays need not
            be traced again.
        texels: texels of ``capture.mesh``; those of the estimate if there is one.
        method: the estimator. ``angular`` compares photographs with what the reflection model
            predicts for them, by statistics of all views; ``spectrum`` compares their power
            spectra (Sec. 3.3 of the paper).
        preset: ``default``, ``paper``, ``fast``, ``fixed`` (angular), or a preset of the
            method.
        grid: nodes of the parameter grid; by default 8 per parameter: roughness, metallic and
            base colour (``PrincipledGrid``), or roughness and Ks (``ParameterGrid``), as the
            preset's ``parameters`` say.
        prior: non-negative weights of the grid's cells, of its shape; or one per roughness. By
            default uniform, but for metallic of angular ``default`` and ``fast``, which is 0 or 1
            with a probability of .8 (the preset's ``metals``); weights take its place.
        known: parameters that are not in question, such as ``{"metallic": 0.0}``: they leave
            the grid, and the entropy is that of the others. ``"scene"`` takes what the scene's
            own ``principled`` material does not vary. Nothing by default: in a scene made for
            photographs, a constant is more often a placeholder than a fact.
        skip: work to leave out where it changes nothing; all of it by default.
        whole: keep the statistics of all texels in memory (3 kB per texel), as recovery and
            guidance need them. Otherwise more than 2^18 texels are worked on tile by tile, and
            what maps do not show is computed again when it is asked for (``TiledKernel``).
        progress: shows what is going on and collects timings.

    Raises:
        OptionError: an unknown method or preset, a grid of other parameters, a bad prior, a
            known value that is none, or texels that do not belong to the source.
        ShapeError: a prior that does not fit the grid.
        CaptureError: no texel is seen in any photograph.
        SceneError: the capture has no light.
        SvuEnvironmentError: no suitable Mitsuba variant is active.
    """
    require_variant()
    switches: Any = find_preset(preset, method=method)
    progress, skip = progress or Progress(), skip or Skip()
    capture, texels = capture_and_texels(source, texels)
    grid_of: Any = angular_grid if isinstance(switches, AngularPreset) else spectrum_grid
    nodes = with_known(grid_of(grid, switches), known, capture.shape)
    prior_tables = log_prior(prior, nodes.shape, "estimate()")  # refused before any work
    observed = _observations(source, texels, skip, progress)
    plan = make_plan(skip, switches, observed, nodes, prior_tables)
    return _computed(
        EstimatorInputs(observed, nodes, prior, plan, progress, whole), method, switches
    )


def _observations(
    source: Capture | Observed | Estimate, texels: Texels, skip: Skip, progress: Progress
) -> Observed:
    """Trace which photographs show which texels, unless that is known, and read the light."""
    require_light(capture_and_texels(source, texels)[0])
    observed = observations_of(source, texels, progress, skip)
    with progress.stage("Reading the light"):
        _ = observed.lighting
    return observed


def _computed(inputs: EstimatorInputs, method: Method, switches: Any) -> Estimate:
    """Compute the posterior by the method of ``switches``, and its entropy."""
    observed, progress = inputs.observed, inputs.progress
    sure: Any = inflated(switches, observed.capture)
    from_views = _from_statistics if isinstance(sure, AngularPreset) else _from_spectra
    posterior = from_views(inputs, sure)
    with progress.stage("Computing entropy"):
        result = Estimate(
            method=method, preset=switches, texels=observed.texels, posterior=posterior,
            coverage=to_drjit(mi.UInt32, view_counts(observed, switches)),
            seen_per_view=observed.visibility.per_view, skipped=inputs.plan.skipped,
            timings=progress.timings, observed=observed, prior=inputs.prior,
        )  # fmt: skip
        dr.eval(result.entropy)
    return result


def _from_statistics(inputs: EstimatorInputs, switches: AngularPreset) -> Posterior:
    """Compare photographs with what the reflection model predicts, by sums over all views."""
    observed, progress = inputs.observed, inputs.progress
    if observed.texels.count > TILE:  # seen or not: what is announced does not know
        return tiled_posterior(inputs, switches)
    if switches.traced:
        with progress.stage("Tracing occlusion"):
            observed.light_visibility(switches.cells, occluded=switches.occluded)
    with progress.stage("Gathering statistics"):
        factors = gather_factors(inputs, switches)
    return statistics_posterior(inputs, switches, factors)


def _from_spectra(inputs: EstimatorInputs, switches: Preset) -> Posterior:
    """Compare the power spectra of photographs and of the light they mirror (Sec. 3.3)."""
    observed, plan, progress = inputs.observed, inputs.plan, inputs.progress
    irradiance = None
    if isinstance(inputs.grid, PrincipledGrid):
        with progress.stage("Tracing occlusion"):
            per_channel = observed.irradiance(switches, plan.light_channels)
            irradiance = np.zeros((observed.texels.count, plan.channels), np.float32)
            irradiance[observed.seen] = np.stack([e.numpy() for e in per_channel], axis=-1)
    with progress.stage("Fitting spectra"):
        spectra = fit_spectra(
            observed, switches, channels=plan.channels, light_channels=plan.light_channels,
            skip_unseen=len(observed.seen) < observed.texels.count,
        )  # fmt: skip
    with progress.stage("Computing entropy"):
        return spectrum_posterior(
            spectra.incoming, spectra.outgoing, inputs.grid, preset=switches,
            prefilter=observed.lighting.prefilter, prior=inputs.prior,
            observed=observed.visibility.coverage > 0, irradiance=irradiance, copies=plan.copies,
        )  # fmt: skip


def materialized(result: Estimate, progress: Progress | None = None) -> Estimate:
    """Return an estimate with the statistics of all texels; made again if it works in tiles."""
    if not isinstance(result.posterior.kernel, TiledKernel):
        return result
    grid: Any = result.posterior.grid
    method: Any = result.method
    return estimate(
        result, None, method, result.preset, grid=grid, prior=result.prior, whole=True,
        progress=progress,
    )  # fmt: skip
