"""Error of base colour by light that the object reflects onto itself, which the model lacks.

Let the directions in which a texel sees the object instead of the light, weighted by the cosine, be
a share h of its hemisphere. If they are as bright as the photographs, of mean radiance L, a texel
of base colour c and mean radiance B owes to them the share

    s = m / (1 + m),    m = c h L / B,

of c. Surfaces that face concave places are darker, because they are shaded, too: base colour is
assumed to be (1 - u s) c, with u uniform in [0, ``MOST``].
"""

from dataclasses import replace

import numpy as np

from svu_mi.capture.replace_material import other_shapes
from svu_mi.capture.tonemap import object_only_scene
from svu_mi.core.memory import TILE
from svu_mi.posterior.observations import Observed

# Photographs with all bounces need 1/2, those without need 0 (notebooks/design/calibration.md).
MOST = 0.25
ALONE = 256  # maximum number of light cells whose visibility is traced without other shapes
MISSING_MEAN, MISSING_SD, MISSING_RMS = MOST / 2, MOST / np.sqrt(12), MOST / np.sqrt(3)  # of u


def missing_share(
    observed: Observed, cells: int, texels: np.ndarray, color: np.ndarray
) -> np.ndarray:
    """Return s of (S,) texels with base colours (S, g), (S, g) float32; ``cells``: of the light."""
    seen, hidden = observed.visibility, hidden_share(observed, cells, texels)
    own = (seen.total.numpy() / np.maximum(seen.coverage.numpy(), 1))[texels]
    own = np.where(own > 0, own, seen.scale)  # only saturated, or black
    missing = color * (hidden * seen.scale)[:, None]
    return np.asarray(missing / np.maximum(own[:, None] + missing, 1e-30), np.float32)


def hidden_share(observed: Observed, cells: int, texels: np.ndarray) -> np.ndarray:
    """Return the share of directions that the object hides from texels, cosine-weighted, (S,)."""
    scene, hidden = observed.capture.scene, [np.empty(0, np.float32)]
    if other_shapes(scene, observed.capture.shape):  # a black cloth hides light, but reflects none
        alone = replace(observed.views, scene=object_only_scene(observed.capture))
        observed, cells = replace(observed.subset(observed.seen), views=alone), min(cells, ALONE)
    for first in range(0, len(texels), TILE):
        own = texels[first : first + TILE]
        part = observed if observed.texels.count <= TILE else observed.subset(own)
        light = part.light_visibility(cells).subset(part.lane[own])
        hidden.append(light.hidden_share(part.lanes(own)))
    return np.concatenate(hidden)
