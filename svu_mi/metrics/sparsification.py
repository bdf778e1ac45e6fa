"""Does removing the most uncertain texels remove the largest errors?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from svu_mi.errors import OptionError
from svu_mi.metrics.checks import pair


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
        found = {name: np.interp(at, self.removed, curve) for name, curve in curves.items()}
        return {name: values.round(5).tolist() for name, values in {"removed": at, **found}.items()}


def sparsification(error: Any, uncertainty: Any) -> Sparsification:
    """Return the sparsification curves of an uncertainty, and the area between them.

    Args:
        error: (n,) non-negative errors of an estimate.
        uncertainty: (n,) what was said of them, in any unit; only its order matters.

    Raises:
        ShapeError: the arrays are empty or their lengths differ.
        OptionError: negative errors, or values that are not finite.
    """
    errors, said = pair(error, uncertainty, ("error", "uncertainty"))
    if (errors < 0).any():
        raise OptionError("sparsification(): an error is negative; give absolute errors.")
    count = len(errors)
    removed = np.arange(count) / count
    curve, oracle = _remaining(_tied(errors, said)), _remaining(np.sort(errors))
    area = float(scipy.integrate.trapezoid(curve - oracle, removed))
    # Rounding of two equal orders, summed differently.
    area = area if abs(area) > 1e-12 else 0.0
    chance = float(scipy.integrate.trapezoid(1 - oracle, removed))
    return Sparsification(removed, curve, oracle, area, area / chance if chance > 1e-12 else 0.0)


def _tied(errors: np.ndarray, said: np.ndarray) -> np.ndarray:
    """Return the errors from the most certain on; equally certain ones share their mean."""
    _, group, counts = np.unique(said, return_inverse=True, return_counts=True)
    means = np.bincount(group, errors) / counts
    return np.repeat(means, counts)


def _remaining(ascending: np.ndarray) -> np.ndarray:
    """Return the mean of the first n, n - 1, ... 1 values over the mean of all."""
    means = np.cumsum(ascending) / np.arange(1, len(ascending) + 1)
    return means[::-1] / means[-1] if means[-1] > 0 else np.ones(len(ascending))
