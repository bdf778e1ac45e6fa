"""Test of an estimate by folds of the views: spread of its error bars, and held-out prediction."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from svu_mi.core.arrays import evenly_spaced
from svu_mi.core.memory import TILE
from svu_mi.geometry.packed_views import CAMERA_FLOATS
from svu_mi.posterior.calibrated import CalibratedKernel, calibrated_posterior
from svu_mi.posterior.estimators import (
    EstimatorInputs,
    gather_sums,
    gathered_levels,
    posterior_inputs,
    view_counts,
    weighting_of,
)
from svu_mi.posterior.folds import ENOUGH, SAMPLE, UNRELIABLE, compared, folds_of, spread_factors
from svu_mi.posterior.held_out_samples import Values, predict_samples
from svu_mi.posterior.judge_prediction import judged
from svu_mi.posterior.kept_results import pack_test, restore_test
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.prediction import LEAST, FoldTest
from svu_mi.posterior.residuals import Surroundings
from svu_mi.presets import AngularPreset

DRAWS = 8  # for intervals of predicted samples
# Texels times photographs of a sample at most, which take memory; and texels at least.
MOST_SAMPLES, FEWEST_TEXELS = 48000, 200


def with_folds(inputs: EstimatorInputs, switches: AngularPreset) -> EstimatorInputs:
    """Return inputs with the test by folds of the views (``folds``, ``prediction``)."""
    if not switches.folds or switches.noise != "estimated":
        return inputs
    test = inputs.observed.cache.recall(
        "folds", posterior_inputs(inputs, switches),
        lambda: _test_by_folds(inputs, switches), pack_test, restore_test,
    )  # fmt: skip
    return replace(inputs, test=test)


def _test_by_folds(inputs: EstimatorInputs, switches: AngularPreset) -> FoldTest:
    """Compare the posteriors of a sample of texels with those without each fold."""
    observed, plan = inputs.observed, inputs.plan
    seen = np.flatnonzero(view_counts(observed, switches))
    most = max(min(SAMPLE, MOST_SAMPLES // observed.views.number), FEWEST_TEXELS)
    texels = seen[evenly_spaced(len(seen), most)]
    if observed.texels.count > TILE:
        observed = observed.subset(texels)
    with inputs.progress.stage("Testing error bars"):
        cameras = observed.views.cameras.numpy().reshape(-1, CAMERA_FLOATS)[:, 12:15]
        # Component by component: Dr.Jit would compile a kernel for each number of points.
        center = np.array([x.numpy().mean() for x in observed.texels.position])
        folds = folds_of(cameras, center, switches.folds)
        if not folds:
            return FoldTest()
        if switches.traced:
            observed.trace_light(switches)
        parts = observed.without(texels, [np.array([], int), *folds])
        if parts.clipped_coverage is None:  # sums add up: each photograph is read once
            rest = [np.setdiff1d(np.arange(len(cameras)), fold) for fold in folds]
            of_folds = gather_sums(inputs, observed.without(texels, rest), switches)
            statistics = of_folds.left_out(len(folds))
        else:
            statistics = gather_sums(inputs, parts, switches)
        posterior = calibrated_posterior(
            statistics, inputs.grid, inputs.observed.unit, switches, prior=inputs.prior,
            copies=plan.copies,
        )  # fmt: skip
        shape = (1 + len(folds), len(texels))
        moments = {name: posterior.kernel.moments(name, np.arange(posterior.count))
                   for name in posterior.axes}  # fmt: skip
        there = compared(view_counts(parts, switches).reshape(shape))
        spread = spread_factors(len(cameras), there, {
            name: [x.reshape(*shape, -1) for x in both] for name, both in moments.items()
        })  # fmt: skip
        # A side that a few photographs show is not predicted by the others.
        if len(cameras) < ENOUGH:
            return FoldTest(spread)
        # Lower bounds have no residual.
        alone = replace(parts, visibility=replace(parts.visibility, clipped=None))
        model = alone.model(
            gathered_levels(inputs, switches), switches, plan.light_channels, np.arange(len(texels))
        )
        fold_of_view = np.zeros(len(cameras), np.int64)
        for number, views in enumerate(folds):
            fold_of_view[views] = number
        samples = predict_samples(
            alone, model, weighting_of(inputs.observed, switches), fold_of_view, there,
            *_without_folds(posterior, spread, moments, shape),
        )  # fmt: skip
        prediction = judged(samples, Surroundings.of(inputs.observed, texels))
        if (
            prediction is not None and observed.plane is not None
            # A wrong light may fit better with any plane, but does not fit well.
            and (prediction.r2 >= LEAST or not prediction.cause)
        ):  # fmt: skip
            prediction = replace(prediction, cause="surroundings")
        if prediction is not None and not prediction.reliable:
            spread = {name: UNRELIABLE * factor for name, factor in spread.items()}
        return FoldTest(spread, prediction)


def _without_folds(
    posterior: Posterior[CalibratedKernel], spread: Mapping[str, float],
    moments: Mapping[str, Sequence[np.ndarray]], shape: tuple[int, int],
) -> tuple[list[Values], np.ndarray]:  # fmt: skip
    """Return means and draws of the parameters, and the noise, without each fold."""
    wide = replace(posterior, kernel=replace(posterior.kernel, spread=spread))
    drawn = wide.draw(DRAWS)
    values = {}
    for name, (mean, _) in moments.items():
        several = np.array(drawn[name]).reshape(DRAWS, *mean.shape)
        values[name] = np.concatenate([mean[None], several])
    each: list[Values] = [{name: x[k].reshape(*shape, -1)[1:] for name, x in values.items()}
            for k in range(1 + DRAWS)]  # fmt: skip
    noise = posterior.kernel.noise_of(np.arange(posterior.count))
    return each, noise.reshape(shape)[1:]
