"""Error of base colour by light that the object reflects onto itself, which the model lacks.

Let the directions in which a texel sees the object instead of the light, weighted by the cosine, be
a share h of its hemisphere. If they are as bright as the photographs, of mean radiance L, a texel
of base colour c and mean radiance B owes to them the share

    s = m / (1 + m),    m = c h L / B,

of c. Surfaces that face concave places are darker, because they are shaded, too: base colour is
assumed to be (1 - u s) c, with u uniform in [0, ``MOST``].
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.replace_material import other_shapes
from svu_mi.capture.tonemap import object_only_scene
from svu_mi.core.arrays import fibonacci, fold, to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.light_visibility import is_unoccluded
from svu_mi.posterior.observations import Observed

# Photographs with all bounces need 1/2, those without need 0 (notebooks/design/calibration.md).
MOST = 0.25
MISSING_MEAN, MISSING_SD, MISSING_RMS = MOST / 2, MOST / np.sqrt(12), MOST / np.sqrt(3)  # of u
RAYS = 64  # per texel, over the sphere


def missing_share(observed: Observed, texels: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return s of (S,) texels with base colours (S, g), (S, g) float32."""
    capture, scene = observed.capture, observed.views.scene
    if other_shapes(scene, capture.shape):  # a black cloth hides light, but reflects none
        scene = object_only_scene(capture)
    hidden = hidden_share(scene, observed.lanes(texels))
    seen = observed.visibility
    own = (seen.total.numpy() / np.maximum(seen.coverage.numpy(), 1))[texels]
    own = np.where(own > 0, own, seen.scale)  # only saturated, or black
    missing = color * (hidden * seen.scale)[:, None]
    return np.asarray(missing / np.maximum(own[:, None] + missing, 1e-30), np.float32)


def hidden_share(scene: Any, surface: TexelLanes) -> np.ndarray:
    """Return the share of directions that surfaces hide, weighted by the cosine, (S,)."""
    directions = to_drjit(mi.Float, fibonacci(RAYS).astype(np.float32).ravel())

    def add(number: Any, whole: Any, free: Any) -> tuple[Any, Any, Any]:
        toward = dr.gather(mi.Vector3f, directions, number)
        above = dr.dot(surface.geometric_normal, toward) > 0
        cosine = dr.select(above, dr.maximum(dr.dot(surface.normal, toward), 0), 0)
        is_open = is_unoccluded(scene, surface, toward, cosine > 0, coherent=True)
        return number + 1, whole + cosine, free + dr.select(is_open, cosine, 0)

    zero = dr.zeros(mi.Float, surface.count)
    whole, free = fold(0, dr.opaque(mi.UInt32, RAYS), add, zero, zero)
    return dr.select(whole > 0, 1 - free / whole, 0).numpy()
