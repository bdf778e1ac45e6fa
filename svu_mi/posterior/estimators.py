"""Posterior from statistics of all views: for all texels at once, or in tiles.

Statistics and posterior of all texels at once are read from the cache if it contains them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.up_direction import up_direction
from svu_mi.core.arrays import evenly_spaced, to_drjit
from svu_mi.core.progress import Progress, Stage
from svu_mi.core.validation import MAX_LANES
from svu_mi.errors import OptionError
from svu_mi.posterior.angular import angular_posterior
from svu_mi.posterior.calibrated import CalibratedKernel, calibrated_posterior, posterior_of
from svu_mi.posterior.calibrated_fit import fit, problem_of
from svu_mi.posterior.kept_results import (
    pack_factors,
    pack_fit,
    pack_share,
    restore_factors,
    restore_fit,
    restore_share,
)
from svu_mi.posterior.kernel import observed_by
from svu_mi.posterior.metal_share import METAL_SAMPLE, knows_metals, learned_metal_share
from svu_mi.posterior.missing_light import missing_share
from svu_mi.posterior.neighbor_error import distance_from_neighbors
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.prediction import FoldTest
from svu_mi.posterior.sample_statistics import sample_factors, sample_statistics
from svu_mi.posterior.support_error import may_stand, support_error
from svu_mi.posterior.tiled import TiledKernel
from svu_mi.posterior.work_plan import Plan
from svu_mi.presets import AngularPreset, AnyPreset
from svu_mi.reflection.roughness_levels import roughness_levels
from svu_mi.statistics.cholesky_factors import Factors, stride
from svu_mi.statistics.gather_statistics import Weighting
from svu_mi.statistics.statistics import Statistics


@dataclass(frozen=True)
class EstimatorInputs:
    """Inputs of both estimators.

    Attributes:
        whole: True disables tiles (see ``pipeline.estimate``).
        test: test by folds of the views (``fold_comparison``).
    """

    observed: Observed
    grid: Any
    prior: Any | None
    plan: Plan
    progress: Progress
    whole: bool
    test: FoldTest = FoldTest()


def gather_factors(inputs: EstimatorInputs, switches: AngularPreset) -> Factors:
    """Gather the statistics of all seen texels and factorise them, or read them from the cache."""
    observed, progress = inputs.observed, inputs.progress
    texels = _used_texels(observed, switches)
    levels, channels = gathered_levels(inputs, switches), inputs.plan.channels

    def gather() -> Factors:
        if switches.traced:
            with progress.stage("Tracing occlusion"):
                observed.trace_light(switches)
        with progress.stage("Gathering statistics"):
            return _factors(inputs, observed, switches, texels)

    return observed.cache.recall(
        "statistics", _statistics_inputs(inputs, switches), gather, pack_factors,
        partial(restore_factors, texel=texels, roughness=levels, channels=channels),
    )  # fmt: skip


def statistics_posterior(
    inputs: EstimatorInputs, switches: AngularPreset, factors: Factors
) -> Posterior:
    """Return the posterior of all texels from their statistics."""
    observed, count = inputs.observed, inputs.observed.texels.count
    if switches.noise != "estimated":
        return _posterior(inputs, switches, factors, None, count)
    scale, copies = observed.unit, inputs.plan.copies
    problem = problem_of(factors, inputs.grid, scale, switches, inputs.prior, copies)
    fitted = observed.cache.recall(
        "posterior", posterior_inputs(inputs, switches),
        lambda: fit(problem, switches, scale, _rounding(observed, switches)),
        pack_fit, partial(restore_fit, problem=problem),
    )  # fmt: skip
    seen = observed_by("estimate()", factors, copies, count)
    posterior = posterior_of(fitted, inputs.grid, seen, observed.capture.light_uncertainty)
    return replace(posterior, kernel=_widened(posterior.kernel, inputs, switches))


def _statistics_inputs(inputs: EstimatorInputs, switches: AngularPreset) -> list[Any]:
    """Return all inputs of the statistics that ``observed.cache`` does not contain."""
    plan = inputs.plan
    return [switches, gathered_levels(inputs, switches), plan.channels, plan.light_channels]


def posterior_inputs(inputs: EstimatorInputs, switches: AngularPreset) -> list[Any]:
    """Return all inputs of the posterior that ``observed.cache`` does not contain."""
    prior = None if inputs.prior is None else np.asarray(inputs.prior)
    return [*_statistics_inputs(inputs, switches), inputs.grid, prior, inputs.plan.copies]


def _widened(
    kernel: CalibratedKernel, inputs: EstimatorInputs, switches: AngularPreset
) -> CalibratedKernel:
    """Return the kernel of texels of the capture with wider error bars.

    By the test by folds, neighbours, a plane that the object may stand on, and missing light.
    """
    if not inputs.test.spread:
        return kernel
    observed, support, missing = inputs.observed, None, None
    lanes, texels = kernel.problem.factors.texel, observed.texels
    if may_stand(observed.capture):
        own = dr.gather(type(texels.normal), texels.normal, lanes)
        normal = np.stack([x.numpy() for x in own], axis=1)
        light, up = observed.distant_light.environment, up_direction(observed.capture)
        support = support_error(light, up, normal, found=observed.plane is not None)
    index = dr.gather(mi.UInt32, texels.index, lanes).numpy().astype(np.int64)
    shown = kernel.problem.factors.views.numpy()[:, None] > 0
    means = {name: kernel.moments(name, lanes.numpy())[0] for name in kernel.grid.axes}
    apart = {name: distance_from_neighbors(np.where(shown, x, np.nan), index, texels.resolution)
             for name, x in means.items()}  # fmt: skip
    if switches.occluded and not ("base_color" in inputs.grid.known or switches.bounces):
        cells = switches.cells or AngularPreset.cells
        missing = missing_share(observed, cells, lanes.numpy(), means["base_color"])
    return replace(kernel, spread=inputs.test.spread, support=support, missing=missing, apart=apart)


def with_metal_share(
    inputs: EstimatorInputs, switches: AngularPreset, factors: Factors | None = None
) -> AngularPreset:
    """Return options with the share of metals on the object (``metal_share``).

    ``factors`` are the statistics of all seen texels; default: they are gathered for a sample.
    With a found light, no metal is expected to be bright: its level is uncertain.
    """
    if inputs.observed.capture.light_uncertainty is not None:
        switches = replace(switches, bare_metals=0.0)
    given = inputs.prior is not None or switches.metal_share is not None
    if given or switches.noise != "estimated" or knows_metals(inputs.grid):
        return switches
    seen = inputs.observed

    def learn() -> float:
        shown = view_counts(seen, switches) if factors is None else factors.views.numpy()
        lanes = np.flatnonzero(shown)
        lanes = lanes[evenly_spaced(len(lanes), METAL_SAMPLE)]
        part = seen.subset(lanes if factors is None else factors.texel.numpy()[lanes])
        sample = factors.subset(lanes) if factors else gather_sums(inputs, part, switches).factor()
        return learned_metal_share(
            sample, inputs.grid, seen.unit, switches, copies=inputs.plan.copies,
            rounding=_rounding(part, switches),
        )  # fmt: skip

    share = seen.cache.recall(
        "metals", posterior_inputs(inputs, switches), learn, pack_share, restore_share
    )
    return replace(switches, metal_share=share)


def gather_sums(inputs: EstimatorInputs, parts: Observed, switches: AngularPreset) -> Statistics:
    plan = inputs.plan
    model = parts.model(gathered_levels(inputs, switches), switches, plan.light_channels)
    return sample_statistics(parts, model, plan.channels, weighting_of(inputs.observed, switches))


def tiled_posterior(inputs: EstimatorInputs, switches: AngularPreset) -> Posterior:
    """Return the posterior of more texels than one tile holds.

    Statistics are computed again for results other than maps, unless ``inputs.whole`` keeps them.
    """
    if inputs.whole:
        return _joined_tiles(inputs, switches)
    seen = inputs.observed
    with inputs.progress.stage("Gathering statistics", len(seen.seen)) as stage:
        observed = view_counts(seen, switches) > 0
        kernel = TiledKernel(
            grid=inputs.grid, observed=observed, report=stage.update,
            make=lambda texels: _of_tile(inputs, switches, texels).kernel,
            widened=lambda kernel: _widened(kernel, inputs, switches),
        )  # fmt: skip
        tiled = Posterior(kernel=kernel, observed=observed)
        tiled.entropy()
    return tiled


def _joined_tiles(inputs: EstimatorInputs, switches: AngularPreset) -> Posterior:
    """Return the posterior of all texels; keep the sums of only one tile in memory."""
    seen, texels = inputs.observed, _used_texels(inputs.observed, switches)
    rows = stride(len(gathered_levels(inputs, switches)), inputs.plan.channels)
    if rows * len(texels) > MAX_LANES:
        raise OptionError(
            f"The statistics of {len(texels)} seen texels exceed the size of an array; at most "
            f"{MAX_LANES // rows} are possible: lower the resolution (--resolution)."
        )
    rounded: list[np.ndarray | None] = []

    def of_tiles(stage: Stage) -> Iterator[Factors]:
        for first in range(0, len(texels), TiledKernel.size):
            part = seen.subset(texels[first : first + TiledKernel.size])
            yield _factors(inputs, part, switches, None)
            rounded.append(_rounding(part, switches))
            stage.update(first + len(part.seen), len(texels))

    with inputs.progress.stage("Gathering statistics", len(texels)) as stage:
        factors = Factors.concatenated(of_tiles(stage), len(texels))
        dr.flush_malloc_cache()  # releases the sums of the last tile
    known = [part for part in rounded if part is not None]  # either all tiles have one, or none
    rounding = np.concatenate(known) if known else None
    posterior = _posterior(inputs, switches, factors, rounding, seen.texels.count)
    return replace(posterior, kernel=_widened(posterior.kernel, inputs, switches))


def _of_tile(inputs: EstimatorInputs, switches: AngularPreset, texels: np.ndarray) -> Posterior:
    """Return the posterior of ``texels``, which get the numbers 0, 1, ... in the result."""
    part = inputs.observed.subset(texels)
    part = part.subset(_used_texels(part, switches))
    own = np.flatnonzero(np.isin(texels, part.seen))
    factors = _factors(inputs, part, switches, None)
    factors = replace(factors, texel=to_drjit(mi.UInt32, own.astype(np.uint32)))
    rounding = _rounding(part, switches)
    return _posterior(inputs, switches, factors, rounding, len(texels))


def _factors(
    inputs: EstimatorInputs, seen: Observed, switches: AngularPreset, texels: np.ndarray | None
) -> Factors:
    """Gather the statistics of texels (default: ``seen.seen``) and factorise them."""
    plan = inputs.plan
    model = seen.model(gathered_levels(inputs, switches), switches, plan.light_channels, texels)
    return sample_factors(seen, model, plan.channels, weighting_of(seen, switches))


def weighting_of(seen: Observed, switches: AngularPreset) -> Weighting:
    edges = switches.edges if switches.noise == "estimated" else 0.0
    return Weighting(switches.kappa(seen.unit), edges)


def _rounding(seen: Observed, switches: AngularPreset) -> np.ndarray | None:
    """Return the rounding variance of each texel; None unless noise is estimated."""
    return seen.rounding(weighting_of(seen, switches)) if switches.noise == "estimated" else None


def _posterior(
    inputs: EstimatorInputs,
    switches: AngularPreset,
    factors: Factors,
    rounding: np.ndarray | None,
    texels: int,
) -> Posterior:
    """Return the posterior of ``texels`` texels, without wider error bars."""
    plan, seen = inputs.plan, inputs.observed
    if switches.noise == "estimated":
        return calibrated_posterior(
            factors, inputs.grid, seen.unit, switches, prior=inputs.prior, copies=plan.copies,
            texels=texels, light_uncertainty=seen.capture.light_uncertainty, rounding=rounding,
        )  # fmt: skip
    return angular_posterior(
        factors, inputs.grid, seen.unit, switches,
        prior=inputs.prior, copies=plan.copies, levels=plan.levels, texels=texels,
    )  # fmt: skip


def _used_texels(seen: Observed, switches: AngularPreset) -> np.ndarray:
    """Return the seen texels with a sample that the preset uses."""
    whole = seen.clipped_coverage is None or uses_saturated_samples(switches)
    return seen.seen if whole else seen.seen[seen.coverage[seen.seen] > 0]


def view_counts(seen: Observed, switches: AnyPreset) -> np.ndarray:
    """Return the number of views used by the estimator for each texel, (T,) uint32."""
    return seen.shown if uses_saturated_samples(switches) else seen.coverage


def gathered_levels(inputs: EstimatorInputs, switches: AngularPreset) -> np.ndarray:
    """Return the statistics' roughness levels: ``roughness_levels``, or the planned grid nodes."""
    nodes = inputs.grid.roughness_nodes
    if switches.noise == "estimated" and len(nodes) > 1:
        return roughness_levels(switches.levels)
    return np.asarray(nodes[inputs.plan.levels])


def uses_saturated_samples(switches: AnyPreset) -> bool:
    """Return True if saturated samples count as lower bounds of radiance."""
    return isinstance(switches, AngularPreset) and switches.kappa(1.0) < np.inf


def inflated(switches: AnyPreset, capture: Capture) -> AnyPreset:
    """Return options with overdispersion increased by the uncertainty of estimated light."""
    uncertainty = capture.light_uncertainty
    if uncertainty is None or not isinstance(switches, AngularPreset):
        return switches
    return replace(switches, overdispersion=switches.overdispersion * uncertainty.widening)
