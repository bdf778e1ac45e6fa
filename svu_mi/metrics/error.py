"""Error of an estimate against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.metrics.checks import pair


@dataclass(frozen=True)
class ErrorSummary:
    """Estimate minus truth, in the parameter's own unit.

    Attributes:
        bias: mean signed error; positive when the estimate is too large.
        mae: mean absolute error.
        rmse: root mean square error.
    """

    bias: float
    mae: float
    rmse: float


def error_summary(estimate: Any, truth: Any) -> ErrorSummary:
    """Return bias, MAE and RMSE of (n,) estimates.

    Raises:
        ShapeError: the arrays are empty or their lengths differ.
        OptionError: NaN or infinite values.
    """
    found, true = pair(estimate, truth, ("estimate", "truth"))
    error = found - true
    return ErrorSummary(
        bias=float(error.mean()),
        mae=float(np.abs(error).mean()),
        rmse=float(np.sqrt((error * error).mean())),
    )
