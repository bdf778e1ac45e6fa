"""How well held-out samples are predicted, as a whole and by photograph and side."""

from dataclasses import replace

import numpy as np

from svu_mi.posterior.held_out_samples import HeldOutSamples
from svu_mi.posterior.likely_cause import ResidualPatterns, clear_cause, likely_cause
from svu_mi.posterior.prediction import SIDES, HeldOutPrediction, PartPrediction
from svu_mi.posterior.residuals import Surroundings, explained

FEWEST = 50  # samples of a photograph or side
NINETY = 1.645  # standard deviations of a 90 % interval


def judged(samples: HeldOutSamples, around: Surroundings) -> HeldOutPrediction | None:
    """Judge predicted samples; None without samples that differ."""
    if not len(samples.view) or not np.ptp(samples.radiance) > 0:
        return None
    patterns = ResidualPatterns(samples, around)
    diffuse = patterns.compressed(samples.scaled_to_others(samples.diffuse, 1.0))
    square = np.square(patterns.shown - patterns.predicted).mean(axis=1)
    square /= max(float(patterns.shown.var(axis=0).mean()), 1e-12)
    within = np.abs(samples.radiance - samples.predicted) <= NINETY * samples.sd
    normal = around.normal[samples.texel] @ around.frame.T
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (normal[np.arange(len(axis)), axis] < 0)
    found = HeldOutPrediction(
            1 - patterns.error, 1 - patterns.error_of_means, explained(patterns.shown, diffuse),
            float(within.mean()), clear_cause(patterns),
            _parts(samples.view, len(around.cameras), square, within),
            dict(zip(SIDES, _parts(side, len(SIDES), square, within), strict=True)),
        )  # fmt: skip
    return found if found.reliable else replace(found, cause=likely_cause(patterns))


def _parts(
    group: np.ndarray, groups: int, square: np.ndarray, within: np.ndarray
) -> tuple[PartPrediction, ...]:
    """Return the predictions of groups of samples, of relative squared errors (S,)."""
    count = np.bincount(group, minlength=groups)
    sums = (np.bincount(group, x, groups) for x in (square, within.mean(axis=1)))
    error, inside = (np.where(count >= FEWEST, s / np.maximum(count, 1), np.nan) for s in sums)
    both = zip((1 - error).tolist(), inside.tolist(), strict=True)
    return tuple(PartPrediction(*each) for each in both)
