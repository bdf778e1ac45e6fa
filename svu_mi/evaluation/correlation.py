"""Correlation of two maps, its mean over benchmark cases, and sparsification curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from svu_mi.errors import OptionError
from svu_mi.evaluation.metric_inputs import finite_vector, two_vectors

MIN_OBJECTS = 3
CONFIDENCE = 0.95  # part of the resampled means inside an interval
ROUNDING = 1e-12  # relative spread below which a map counts as constant


def pearson(x: Any, y: Any) -> float:
    """Return Pearson's rho of two (n,) arrays, in [-1, 1].

    A constant says nothing about the other map: 0.0 if either is constant, or n is 1.
    """
    return _correlation(scipy.stats.pearsonr, x, y)


def spearman(x: Any, y: Any) -> float:
    """Return Spearman's rank correlation, ties sharing their mean rank (as ``pearson``)."""
    return _correlation(scipy.stats.spearmanr, x, y)


def _correlation(of: Callable[..., Any], x: Any, y: Any) -> float:
    both = two_vectors(x=x, y=y)
    constant = any(np.ptp(values) <= ROUNDING * np.abs(values).max() for values in both)
    return 0.0 if constant else float(of(*both).statistic)


@dataclass(frozen=True)
class Interval:
    """A mean and its confidence interval.

    Attributes:
        mean: of all cases.
        low, high: ends of the interval; None where there are fewer than three objects, of which
            drawing with replacement tells next to nothing.
        objects: number of objects.
    """

    mean: float
    low: float | None
    high: float | None
    objects: int


def mean_over_objects(values: Any, objects: Sequence[str], *, seed: int = 0) -> Interval:
    """Return the mean over benchmark cases, with a bootstrap interval over objects.

    Cases of one object under several lights are not independent, so whole objects are drawn
    with replacement, 2000 times, and the interval is the central part of the means, wider by
    sqrt(n / (n - 1)) t / z for n objects: percentile intervals of few are too short (Hesterberg,
    What Teachers Should Know about the Bootstrap, 2015, Sec. 3.3, 4.1.2). It may leave [-1, 1].

    Args:
        values: (n,) one figure per case.
        objects: n names; cases of one name are drawn together.
        seed: of the resampling.
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
    """Curves over the part of the texels that was removed (Ilg et al., ECCV 2018, Sec. 5.2).

    Every curve is the mean error of what remains over the mean error of all, so it starts
    at 1. Without any error at all, the curves are 1 and the areas 0.

    Attributes:
        removed: (n,) removed part, 0, 1/n, ... (n - 1)/n.
        by_uncertainty: (n,) the most uncertain go first; among equally uncertain ones in
            random order, on average.
        oracle: (n,) the largest errors go first.
        ause: area between the two curves (trapezoids over ``removed``); 0 is perfect.
        relative: ``ause`` over the area between removal in random order (a curve of 1) and
            the oracle: 0 is perfect, 1 as good as chance, more is worse than chance. It is 0
            where all errors are equal.
    """

    removed: np.ndarray
    by_uncertainty: np.ndarray
    oracle: np.ndarray
    ause: float
    relative: float

    def sampled(self, count: int = 21) -> dict[str, list[float]]:
        """Return ``count`` points of each curve for a plot, from 0 to the last removed part."""
        at = np.linspace(0, self.removed[-1], count)
        curves = {"by_uncertainty": self.by_uncertainty, "oracle": self.oracle}
        values = {name: np.interp(at, self.removed, curve) for name, curve in curves.items()}
        return {name: x.round(5).tolist() for name, x in {"removed": at, **values}.items()}


def sparsification(error: Any, uncertainty: Any) -> Sparsification:
    """Return the sparsification curves of an uncertainty, and the area between them.

    Args:
        error: (n,) non-negative errors of an estimate.
        uncertainty: (n,) what was said of them, in any unit; only its order matters.
    """
    errors, uncertainties = two_vectors(error=error, uncertainty=uncertainty)
    if (errors < 0).any():
        raise OptionError("sparsification(): an error is negative; give absolute errors.")
    count = len(errors)
    removed = np.arange(count) / count
    # Equally uncertain texels share their mean error.
    _, group, counts = np.unique(uncertainties, return_inverse=True, return_counts=True)
    curve = _remaining(np.repeat(np.bincount(group, errors) / counts, counts))
    oracle = _remaining(np.sort(errors))
    area = float(scipy.integrate.trapezoid(curve - oracle, removed))
    # Rounding of two equal orders, summed differently.
    area = area if abs(area) > 1e-12 else 0.0
    chance = float(scipy.integrate.trapezoid(1 - oracle, removed))
    return Sparsification(removed, curve, oracle, area, area / chance if chance > 1e-12 else 0.0)


def _remaining(ascending: np.ndarray) -> np.ndarray:
    """Return the mean of the first n, n - 1, ... 1 values over the mean of all."""
    means = np.cumsum(ascending) / np.arange(1, len(ascending) + 1)
    return means[::-1] / means[-1] if means[-1] > 0 else np.ones(len(ascending))
