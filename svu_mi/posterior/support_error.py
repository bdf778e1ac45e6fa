"""Error of base colour by light from what the object may stand on.

If no photograph is taken from below the object, it may stand on something that the scene lacks. A
horizontal plane below it, of albedo rho = 1/2, would replace the light from below and change the
irradiance of a texel with normal n by

    d(n) = integral over downward w of (rho H / pi - L(w)) max(n . w, 0) dw,

with the irradiance H of the plane. The logarithm of base colour has the standard deviation
|d| / (2 E), with the irradiance E of the texel. Both are expanded in spherical harmonics of degree
4 [Ramamoorthi and Hanrahan 2001]; the object's own shadows are neglected.
"""

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.up_direction import is_seen_from_above
from svu_mi.core.arrays import fibonacci
from svu_mi.light.environment import Environment, basis_at, polar_from_local

ALBEDO, SURE = 0.5, 0.5  # rho; standard deviation relative to |d| / E
LIGHT_DEGREE, POINTS = 8, 1024  # of the light, and directions of its quadrature
LOBE = np.pi * np.repeat([1, 2 / 3, 1 / 4, 0, -1 / 24], [1, 3, 5, 7, 9])  # of max(n . w, 0)
DARKEST = 0.05  # least irradiance, relative to that of uniform light


def may_stand(capture: Capture) -> bool:
    """Return whether the object may stand on something that the scene lacks.

    Light estimated from the photographs includes what is below the object. Lamps and a flash light
    the plane in another way.
    """
    scene = capture.scene
    alone = len(scene.shapes()) == len(scene.emitters()) == 1 and scene.environment() is not None
    lit = alone and capture.flash is None and capture.light_uncertainty is None
    return lit and is_seen_from_above(capture)


def support_error(
    light: Environment, up: np.ndarray, normal: np.ndarray, *, found: bool = False
) -> np.ndarray:
    """Return the standard deviation of the log of base colour at S normals, (S, 3) float32.

    If ``light`` is above a plane that was ``found``, d is all light from below.
    """
    world = fibonacci(POINTS)
    to_polar = polar_from_local(world @ light.to_local.T)
    radiance = np.maximum(basis_at(to_polar, LIGHT_DEGREE) @ light.coefficients(LIGHT_DEGREE), 0)
    step, height = 4 * np.pi / POINTS, world @ up
    plane = ALBEDO / np.pi * step * (np.maximum(height, 0) @ radiance)
    changed = np.where(height[:, None] < 0, radiance if found else plane - radiance, 0)
    sums = step * LOBE[:, None] * (basis_at(world, 4).T @ np.hstack([changed, radiance]))
    change, whole = np.split(basis_at(normal, 4) @ sums, 2, axis=1)
    least = DARKEST * np.pi * radiance.mean(axis=0)
    return np.asarray(SURE * np.abs(change) / np.maximum(whole, least), np.float32)
