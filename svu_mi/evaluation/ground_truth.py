"""Ground truth of a synthetic capture (textures of its scene), and errors against it."""

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.core.validation import require_known
from svu_mi.geometry.texel_materials import parameters_at
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import MIXED, NAMES, ByParameter
from svu_mi.reflection.principled import specular_from_principled


class GroundTruth(ByParameter):
    """True parameters of T texels, all in [0, 1]: base_color (T, 3), linear, and others (T,)."""

    @property
    def specular(self) -> np.ndarray:
        """Specular reflectance Ks = R0 of a ``ParameterGrid``, (T, 3)."""
        mixed = (self[name][:, None] for name in MIXED)
        return np.asarray(specular_from_principled(self.base_color, *mixed))

    def grey(self, name: str) -> np.ndarray:
        """Return a parameter, or ``specular``, as (T,): colours are averaged over channels."""
        require_known([name], (*NAMES, "specular"), "parameter")
        values: np.ndarray = self.specular if name == "specular" else self[name]
        return values.mean(axis=1) if values.ndim == 2 else values


def ground_truth(capture: Capture, texels: Texels) -> GroundTruth:
    """Evaluate the BSDF parameters of the capture's object at the texel centres.

    Only synthetic captures contain the truth; the scene of real photographs contains a guess.

    Args:
        capture: Capture whose ``shape`` has a ``principled`` BSDF and UVs.
        texels: T texels of ``capture.mesh``.
    """
    return GroundTruth(**parameters_at(capture, texels))
