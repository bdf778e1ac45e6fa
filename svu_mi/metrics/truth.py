"""Ground truth of a synthetic capture: the textures of the scene that was rendered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from svu_mi.brdf.principled import specular_from_principled
from svu_mi.capture import Capture
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
