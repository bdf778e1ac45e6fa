"""Bias, mean absolute error and RMSE of estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.bench.metric_inputs import two_vectors


@dataclass(frozen=True)
class ErrorSummary:
    """Errors, estimate minus truth, in the unit of the parameter.

    Attributes:
        bias: Mean signed error; positive if the estimate is too large.
        mae: Mean absolute error.
        rmse: Root mean square error.
    """

    bias: float
    mae: float
    rmse: float


def error_summary(estimate: Any, truth: Any) -> ErrorSummary:
    """Return bias, MAE and RMSE of (n,) estimates."""
    estimated, true = two_vectors(estimate=estimate, truth=truth)
    error = estimated - true
    return ErrorSummary(
        bias=float(error.mean()),
        mae=float(np.abs(error).mean()),
        rmse=float(np.sqrt((error * error).mean())),
    )
