"""Which precision a fit is computed in.

Single precision halves the time of the dual: a number of all lanes is one register, and a texel's
system stays in the first cache. With k(0) = sum_l (2l + 1) / (4 pi lambda R_l), M = W K W + 1 has a
condition number of at most 1 + n k(0) for n views of weight w <= 1; its rounding reaches the
coefficients through (lambda R)^-1 Y^T W M^-1, which amplifies by sqrt(k(0)) / 2 at most. What
decides is therefore n k(0)^(3/2). Largest error of the power spectrum, relative to the largest
degree, in single precision, over 1 to 256 views (spread, grazing, equal, crowded, on a line),
l* 1 to 9, R_00 = 0 and 1, noise and smooth signals:

    n k(0)^(3/2)    < 10     < 100    < 1e3    < 6e3    < 1e5    < 1e6
    error           2e-5     6e-6     2e-5     8e-5     7e-4     4e-3

Measured and left out: one step of refinement in single precision (error 2e-6 becomes 6e-7)
takes two more passes over views and coefficients, and with them as long as double precision;
sums over views in single precision beside a factorisation in double (0.8 of its time) lose 1e-3
where a hundred views crowd together at lambda = 1e-3.
"""

from __future__ import annotations

import math
from typing import Literal

from svu_mi.frequency import harmonics

Precision = Literal["single", "double"]

LARGEST_AMPLIFICATION = 6e3
"""Up to here single precision keeps 1e-4: at l* = 6 and lambda = 1e-2, 71 views with R_00 = 0."""

LIGHTEST = 1e-15
"""Below, w^2 leaves the range of single precision, and a free constant would be lost."""


def amplification(
    views: int, degree: int, regularizer: float, penalize_constant: bool, heaviest: float = 1.0
) -> float:
    """Return n k(0)^(3/2), with weights up to ``heaviest`` where that is more than 1.

    Args:
        views: n, the most views a lane sees.
        degree: l*.
        regularizer: lambda.
        penalize_constant: R_00 = 1, else 0.
        heaviest: the largest weight w.
    """
    scaled = sum(harmonics.zonal_polynomial(degree, penalize_constant))  # P_l(1) = 1
    kernel = scaled / regularizer * max(heaviest, 1.0) ** 2
    return views * kernel * math.sqrt(kernel)


def choose(
    views: int,
    degree: int,
    regularizer: float,
    penalize_constant: bool,
    weights: tuple[float, float] = (1e-6, 1.0),
) -> Precision:
    """Return the fastest precision that keeps spectra within 1e-4 of the largest degree.

    Args:
        views: the most views a lane sees.
        degree: l*.
        regularizer: lambda.
        penalize_constant: R_00 = 1, else 0.
        weights: the smallest and the largest w > 0.
    """
    lightest, heaviest = weights
    growth = amplification(views, degree, regularizer, penalize_constant, heaviest)
    safe = growth <= LARGEST_AMPLIFICATION and lightest >= LIGHTEST
    return "single" if safe else "double"
