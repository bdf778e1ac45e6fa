"""Pipeline from a capture to the posterior of each texel; read this module first.

    capture -> texels -> observations: visibility, light -> plan
            -> statistics of all views -> posterior     (angular, Eq. 3 to 6)
            -> SH fit -> power spectra -> posterior     (spectrum, Eq. 7 to 12)

``capture/loading.py`` loads captures, ``geometry/texels.py`` rasterises the UV map into texels.
"""

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
    with_metal_share,
)
from svu_mi.posterior.fold_comparison import with_folds
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.prediction import HeldOutPrediction
from svu_mi.posterior.row_entropy import log_prior
from svu_mi.posterior.spectrum import spectrum_grid, spectrum_posterior
from svu_mi.posterior.support_plane import with_plane
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
    """Compute the posterior of the reflectance of each texel of a capture.

    Args:
        source: a capture (scene, photographs and light), or an estimate. An estimate provides its
            capture, texels and traced visibility.
        texels: texels of ``capture.mesh``; required for a capture.
        method: ``angular`` compares the photographs with radiance predicted by the reflection
            model; ``spectrum`` compares power spectra (Sec. 3.3 of the paper).
        preset: ``default``, ``paper``, ``fast``, ``fixed`` (angular), or a preset object, such as
            ``svu.preset("default", bounces=True)`` for light that the object reflects onto itself.
        grid: parameter grid, by default with 8 nodes per parameter. The preset's ``parameters``
            select a ``PrincipledGrid`` (roughness, metallic, base colour) or a ``ParameterGrid``
            (roughness, Ks).
        prior: non-negative weights of the grid's bins, in the grid's shape; or one weight per
            roughness node. Default: uniform, except metallic of the angular presets ``default``
            and ``fast``: 0 or 1 with probability 0.8 (``AngularPreset.metals``).
        known: known parameters by name, such as ``{"metallic": 0.0}``. They are removed from the
            grid and from the entropy. ``"scene"`` selects all constants of the scene's
            ``principled`` material. Default: none, because they are often placeholders.
        skip: optimisations that do not change results; default: all.
        whole: keep the statistics of all texels in memory (3 kB per texel), as recovery and
            guidance require. By default, more than 2^18 texels are processed in tiles, and results
            other than maps are recomputed on request (``TiledKernel``).
        progress: progress display and timings.

    Raises:
        OptionError: an unknown method or preset, a grid with other parameters than the preset's,
            an invalid prior or ``known``, or texels that differ from the estimate's.
        ShapeError: the shape of the prior differs from the grid's.
        CaptureError: no photograph shows any texel.
        SceneError: the capture has no light.
        SvuEnvironmentError: the active Mitsuba variant is not supported.

    Example:
        >>> estimate = svu.estimate(capture, texels)
        >>> estimate.image("entropy").shape
        (64, 64)
        >>> again = svu.estimate(estimate, known={"metallic": 0.0})  # no rays are traced again
        >>> again.skipped["parameters known"]
        1
    """
    require_variant()
    switches: Any = find_preset(preset, method=method)
    progress, skip = progress or Progress(), skip or Skip()
    capture, texels = capture_and_texels(source, texels)
    grid_of: Any = angular_grid if isinstance(switches, AngularPreset) else spectrum_grid
    nodes = with_known(grid_of(grid, switches), known, capture.shape)
    prior_tables = log_prior(prior, nodes.shape, "estimate()")  # raises before any rays are traced
    observed = _observations(source, texels, skip, progress)
    plan = make_plan(skip, switches, observed, nodes, prior_tables)
    return _computed(
        EstimatorInputs(observed, nodes, prior, plan, progress, whole), method, switches
    )


def _observations(
    source: Capture | Observed | Estimate, texels: Texels, skip: Skip, progress: Progress
) -> Observed:
    """Return the ``Observed`` of ``source``, with the light loaded."""
    require_light(capture_and_texels(source, texels)[0])
    observed = observations_of(source, texels, progress, skip)
    with progress.stage("Reading the light"):
        _ = observed.distant_light
    return observed


def _computed(inputs: EstimatorInputs, method: Method, switches: Any) -> Estimate:
    """Compute the posterior by ``method``, and its entropy."""
    sure: Any = inflated(switches, inputs.observed.capture)
    inputs = with_plane(inputs, sure)
    observed = inputs.observed
    from_views = _from_statistics if isinstance(sure, AngularPreset) else _from_spectra
    posterior, prediction = from_views(inputs, sure)
    return Estimate(
        method=method, preset=switches, texels=observed.texels, posterior=posterior,
        coverage=to_drjit(mi.UInt32, view_counts(observed, switches)),
        seen_per_view=observed.visibility.per_view, skipped=inputs.plan.skipped,
        timings=inputs.progress.timings, observed=observed, prior=inputs.prior,
        prediction=prediction,
    )  # fmt: skip


def _from_statistics(
    inputs: EstimatorInputs, switches: AngularPreset
) -> tuple[Posterior, HeldOutPrediction | None]:
    """Return the posterior from statistics of all views (Eq. 3 to 6), and its test by folds."""
    observed, progress = inputs.observed, inputs.progress
    # Unseen texels count, too: the memory estimate is printed before visibility is traced.
    if observed.texels.count > TILE:
        switches = with_metal_share(inputs, switches)
        inputs = with_folds(inputs, switches)
        return tiled_posterior(inputs, switches), inputs.test.prediction
    factors = gather_factors(inputs, switches)
    switches = with_metal_share(inputs, switches, factors)
    inputs = with_folds(inputs, switches)
    with progress.stage("Computing entropy"):
        posterior = statistics_posterior(inputs, switches, factors)
        dr.eval(posterior.entropy())
    return posterior, inputs.test.prediction


def _from_spectra(inputs: EstimatorInputs, switches: Preset) -> tuple[Posterior, None]:
    """Return the posterior from power spectra (Sec. 3.3)."""
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
        posterior = spectrum_posterior(
            spectra.incoming, spectra.outgoing, inputs.grid, preset=switches,
            prefilter=observed.lighting.prefilter, prior=inputs.prior,
            observed=observed.visibility.coverage > 0, irradiance=irradiance, copies=plan.copies,
        )  # fmt: skip
        dr.eval(posterior.entropy())
    return posterior, None


def materialized(result: Estimate, progress: Progress | None = None) -> Estimate:
    """Return an estimate with statistics of all texels in memory; compute it again if tiled."""
    if not isinstance(result.posterior.kernel, TiledKernel):
        return result
    grid: Any = result.posterior.grid
    method: Any = result.method
    return estimate(
        result, None, method, result.preset, grid=grid, prior=result.prior, whole=True,
        progress=progress,
    )  # fmt: skip
