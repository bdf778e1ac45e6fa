"""Ground truth of a synthetic capture, the textures of its scene, and errors against it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.core.validation import require_known
from svu_mi.evaluation.metric_inputs import two_vectors
from svu_mi.geometry.texel_materials import parameters_at
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import MIXED, NAMES, ByParameter
from svu_mi.reflection.principled import specular_from_principled


class GroundTruth(ByParameter):
    """True parameters of T texels, all in [0, 1]: base_color (T, 3), linear, and others (T,)."""

    @property
    def specular(self) -> np.ndarray:
        """Ks = R0, (T, 3): what a ``ParameterGrid`` calls so."""
        mixed = (self[name][:, None] for name in MIXED)
        return np.asarray(specular_from_principled(self.base_color, *mixed))

    def grey(self, name: str) -> np.ndarray:
        """Return a parameter, or the ``specular`` of a ``ParameterGrid``, as (T,): the mean over
        channels for a colour.
        """
        require_known([name], (*NAMES, "specular"), "parameter")
        values: np.ndarray = self.specular if name == "specular" else self[name]
        return values.mean(axis=1) if values.ndim == 2 else values


def ground_truth(capture: Capture, texels: Texels) -> GroundTruth:
    """Evaluate the target's BSDF parameters at every texel's centre.

    Only the scene of a synthetic capture knows them; that of real photographs holds a guess.

    Args:
        capture: its ``shape`` must have a ``principled`` BSDF, and its own UVs.
        texels: T texels of ``capture.mesh``.
    """
    return GroundTruth(**parameters_at(capture, texels))


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
    """Return bias, MAE and RMSE of (n,) estimates."""
    estimated, true = two_vectors(estimate=estimate, truth=truth)
    error = estimated - true
    return ErrorSummary(
        bias=float(error.mean()),
        mae=float(np.abs(error).mean()),
        rmse=float(np.sqrt((error * error).mean())),
    )
