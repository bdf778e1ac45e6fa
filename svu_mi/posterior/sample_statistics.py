"""Statistics of the samples of all photographs, with saturated samples as lower bounds."""

from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from svu_mi.reflection.reflection_model import ReflectionModel
from svu_mi.statistics.censored import PASSES, find_best_models
from svu_mi.statistics.cholesky_factors import Factors
from svu_mi.statistics.gather_statistics import Weighting, clipped_samples, gather_statistics
from svu_mi.statistics.statistics import LazyStatistics, Statistics

if TYPE_CHECKING:
    from svu_mi.posterior.observations import Observed


def sample_factors(
    observed: "Observed", model: ReflectionModel, channels: int, weighting: Weighting
) -> Factors:
    """Return the factors of ``sample_statistics``; sums are stored only with saturated samples."""
    if _counts_clipped(observed, weighting):
        return sample_statistics(observed, model, channels, weighting).factor()
    return _gather(observed, model, channels, weighting).factor()


def sample_statistics(
    observed: "Observed", model: ReflectionModel, channels: int, weighting: Weighting
) -> Statistics:
    """Gather statistics in which saturated samples count as lower bounds (``censored``)."""
    statistics = _gather(observed, model, channels, weighting).statistics()
    if not _counts_clipped(observed, weighting):
        return statistics
    number, coverage = statistics.texel.numpy(), observed.coverage
    # Samples can be saturated in part of their pixels.
    partly = (observed.shown > coverage)[number] | (coverage[number] != statistics.views.numpy())
    lanes = np.flatnonzero(partly)
    if not len(lanes):
        return statistics
    # The sums of unsaturated samples stay the same in all passes.
    plain, texels = statistics.subset(lanes), number[lanes].astype(np.int64)
    model = observed.model(model.roughness, model.switches, model.channels, texels)
    samples = clipped_samples(observed.views, observed.visibility, model.surface)
    combined = plain
    for _ in range(PASSES):
        models = replace(find_best_models(combined), samples=samples)
        around = replace(weighting, models=models)
        combined = plain + _gather(observed, model, channels, around).statistics()
    return statistics.replaced(lanes, combined)


def _gather(
    observed: "Observed", model: ReflectionModel, channels: int, weighting: Weighting
) -> LazyStatistics:
    mirrors = observed.mirrors if model.reads_mirrors else None
    return gather_statistics(
        observed.views, observed.visibility, model, mirrors, channels, weighting
    )


def _counts_clipped(observed: "Observed", weighting: Weighting) -> bool:
    counts = weighting.current is None and weighting.kappa < inf
    return observed.clipped_coverage is not None and counts
