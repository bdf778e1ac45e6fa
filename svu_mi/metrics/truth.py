"""Ground truth of a synthetic capture, the textures of its scene, and errors against it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.metrics.checks import pair
from svu_mi.reflection.principled import specular_from_principled
from svu_mi.surface import Texels
from svu_mi.surface.material import parameters_at


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """True parameters of T texels, all in [0, 1]; colours are linear.

    Attributes:
        base_color: (T, 3).
        roughness: (T,).
        metallic: (T,).
    """

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray

    @property
    def specular(self) -> np.ndarray:
        """Ks = 0.04 + (base_color - 0.04) metallic, (T, 3)."""
        return specular_from_principled(self.base_color, self.metallic[:, None])

    def grey(self, name: str) -> np.ndarray:
        """Return a parameter as (T,), the mean over channels for a colour."""
        values: np.ndarray = getattr(self, name)
        return values.mean(axis=1) if values.ndim == 2 else values


def ground_truth(capture: Capture, texels: Texels) -> GroundTruth:
    """Evaluate the target's BSDF parameters at every texel's centre.

    Only the scene of a synthetic capture knows them; that of real photographs holds a guess.

    Args:
        capture: its ``shape`` must have a ``principled`` BSDF, and its own UVs.
        texels: T texels of ``capture.mesh``.

    Raises:
        SceneError: another BSDF, or a mesh that was unwrapped anew.
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
