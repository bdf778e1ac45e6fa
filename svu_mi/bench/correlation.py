"""Correlation of two maps, means over benchmark cases, and sparsification curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from svu_mi.bench.metric_inputs import finite_vector, two_vectors
from svu_mi.errors import OptionError

MIN_OBJECTS = 3
CONFIDENCE = 0.95  # level of the bootstrap interval
ROUNDING = 1e-12  # relative spread below which a map counts as constant


def pearson(x: Any, y: Any) -> float:
    """Return Pearson's correlation of two (n,) arrays, in [-1, 1].

    0.0 if either array is constant, or n is 1.
    """
    return _correlation(scipy.stats.pearsonr, x, y)


def spearman(x: Any, y: Any) -> float:
    """Return Spearman's rank correlation; ties get their mean rank. 0.0 as in ``pearson``."""
    return _correlation(scipy.stats.spearmanr, x, y)


def _correlation(of: Callable[..., Any], x: Any, y: Any) -> float:
    both = two_vectors(x=x, y=y)
    constant = any(np.ptp(values) <= ROUNDING * np.abs(values).max() for values in both)
    return 0.0 if constant else float(of(*both).statistic)


@dataclass(frozen=True)
class Interval:
    """Mean and its confidence interval.

    Attributes:
        mean: Mean over all cases.
        low, high: Ends of the interval; None for fewer than three objects, which are too
            few to resample.
        objects: Number of objects.
    """

    mean: float
    low: float | None
    high: float | None
    objects: int


def mean_over_objects(values: Any, objects: Sequence[str], *, seed: int = 0) -> Interval:
    """Return the mean over benchmark cases, with a bootstrap interval over objects.

    Cases of one object under several lights are not independent, so whole objects are drawn with
    replacement, 2000 times. The central 95 % of the means is widened by sqrt(n / (n - 1)) t / z for
    n objects, because percentile intervals of small samples are too short (Hesterberg, The American
    Statistician 2015, Sec. 3.3, 4.1.2). The interval may extend beyond [-1, 1].

    Args:
        values: (n,) one value per case.
        objects: n object names; cases with the same name are drawn together.
        seed: Seed of the resampling.
    """
    cases = finite_vector(values, "values", len(objects))
    names, owner = np.unique(np.array(objects, str), return_inverse=True)
    mean = float(cases.mean())
    if len(names) < MIN_OBJECTS:
        return Interval(mean, None, None, len(names))
    sums, counts = np.bincount(owner, cases), np.bincount(owner)
    interval = scipy.stats.bootstrap(
        (sums, counts),
        lambda s, c, axis: s.sum(axis=axis) / c.sum(axis=axis),
        paired=True,
        vectorized=True,
        n_resamples=2000,
        confidence_level=CONFIDENCE,
        method="percentile",
        random_state=np.random.default_rng(seed),
    ).confidence_interval
    n, tail = len(names), (1 - CONFIDENCE) / 2
    wider = np.sqrt(n / (n - 1)) * scipy.stats.t.ppf(tail, n - 1) / scipy.stats.norm.ppf(tail)
    low, high = (mean + float(wider) * (float(end) - mean) for end in (interval.low, interval.high))
    return Interval(mean, low, high, n)


@dataclass(frozen=True)
class Sparsification:
    """Sparsification curves: error of the remaining texels (Ilg et al., ECCV 2018, Sec. 5.2).

    Curves are relative to the mean error of all texels, so they start at 1. If all errors are 0,
    the curves are 1 and the areas 0.

    Attributes:
        removed: (n,) removed fraction of the texels, 0, 1/n, ... (n - 1)/n.
        by_uncertainty: (n,) remaining error if the most uncertain texels are removed first;
            averaged over all orders of equal uncertainties.
        oracle: (n,) remaining error if the largest errors are removed first.
        ause: Area between the two curves (trapezoidal rule over ``removed``); 0 is perfect.
        relative: ``ause`` divided by the area between a random order (constant 1) and the oracle:
            0 is perfect, 1 is chance, > 1 is worse than chance; 0 if all errors are equal.
    """

    removed: np.ndarray
    by_uncertainty: np.ndarray
    oracle: np.ndarray
    ause: float
    relative: float

    def sampled(self, count: int = 21) -> dict[str, list[float]]:
        """Return ``count`` points of each curve, for a plot."""
        at = np.linspace(0, self.removed[-1], count)
        curves = {"by_uncertainty": self.by_uncertainty, "oracle": self.oracle}
        values = {name: np.interp(at, self.removed, curve) for name, curve in curves.items()}
        return {name: x.round(5).tolist() for name, x in {"removed": at, **values}.items()}


def sparsification(error: Any, uncertainty: Any) -> Sparsification:
    """Return the sparsification curves of an uncertainty, and the area between them.

    Args:
        error: (n,) non-negative errors of an estimate.
        uncertainty: (n,) estimated uncertainties in any unit; only their order matters.
    """
    errors, uncertainties = two_vectors(error=error, uncertainty=uncertainty)
    if (errors < 0).any():
        raise OptionError("sparsification(): an error is negative; give absolute errors.")
    count = len(errors)
    removed = np.arange(count) / count
    # Ties in uncertainty get their mean error: the average over all orders.
    _, group, counts = np.unique(uncertainties, return_inverse=True, return_counts=True)
    curve = _remaining(np.repeat(np.bincount(group, errors) / counts, counts))
    oracle = _remaining(np.sort(errors))
    area = float(scipy.integrate.trapezoid(curve - oracle, removed))
    # Remove rounding: equal orders may be summed differently.
    area = area if abs(area) > 1e-12 else 0.0
    chance = float(scipy.integrate.trapezoid(1 - oracle, removed))
    return Sparsification(removed, curve, oracle, area, area / chance if chance > 1e-12 else 0.0)


def _remaining(ascending: np.ndarray) -> np.ndarray:
    """Return the means of the first n, n - 1, ... 1 values, divided by the mean of all."""
    means = np.cumsum(ascending) / np.arange(1, len(ascending) + 1)
    return means[::-1] / means[-1] if means[-1] > 0 else np.ones(len(ascending))
