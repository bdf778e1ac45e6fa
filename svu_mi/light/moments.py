"""Diffuse moments of light that nothing hides, by the normal of the surface.

``visibility.reach`` has these moments of texels that light is hidden from; here they are maps by
the normal. All of them are convolutions of the light, times a component of its direction for
the vectors, with a clamped cosine [Ramamoorthi and Hanrahan 2001].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.light import environment as env
from svu_mi.light.environment import Environment
from svu_mi.light.lighting import (
    COSINE_DEGREE,
    COSINE_ROWS,
    degrees,
    lat_long_texture,
    look_up,
    zonal_cosine,
)

MOMENTS = 8  # per channel: two scalars, two vectors


@dataclass(frozen=True)
class MomentMap:
    """c0, m0 (3), c1, m1 (3) (``Reach.diffuse``), vectors in the light's local frame.

    Attributes:
        texture: Texture2f of 8 C channels, those of one colour together.
        to_local: Matrix3f, world to local.
        channels: C, 1 or 3.
    """

    texture: Any
    to_local: Any
    channels: int

    def at(self, normal: Any) -> list[list[Any]]:
        """Look the moments of a world normal up: 8 Floats per channel."""
        flat = look_up(self.texture, self.to_local @ mi.Vector3f(normal))
        return [flat[first : first + MOMENTS] for first in range(0, len(flat), MOMENTS)]

    def in_world(self, normal: Any) -> list[list[Any]]:
        """Look the moments of a world normal up, vectors in world space, evaluated."""
        back, result = self.to_local.T, []
        for c0, x0, y0, z0, c1, x1, y1, z1 in self.at(normal):
            m0, m1 = back @ mi.Vector3f(x0, y0, z0), back @ mi.Vector3f(x1, y1, z1)
            result.append([dr.maximum(c0, 0), *m0, dr.maximum(c1, 0), *m1])
        dr.eval(result)
        return result


def moment_map(environment: Environment, channels: int = 3) -> MomentMap:
    """Convolve the light.

    Args:
        environment: the light.
        channels: 3, or 1 for the mean of the colour channels.
    """
    factors = zonal_cosine(COSINE_DEGREE, 0), zonal_cosine(COSINE_DEGREE, 5)
    expanded = [environment.coefficients(COSINE_DEGREE)]
    expanded += [_along(environment, axis).coefficients(COSINE_DEGREE) for axis in range(3)]
    if channels == 1:
        expanded = [c.mean(axis=1, keepdims=True) for c in expanded]
    wide = [c * f[degrees(COSINE_DEGREE)][:, None] for f in factors for c in expanded]
    by_channel = np.stack(wide, axis=-1).reshape(len(wide[0]), -1)  # (lm, channel * moment)
    grid = env.synthesize(by_channel, 2 * (COSINE_ROWS - 1), COSINE_ROWS)
    return MomentMap(lat_long_texture(grid), mi.Matrix3f(environment.to_local), channels)


def _along(environment: Environment, axis: int) -> Environment:
    """Return the light times a component of its direction."""
    rows, columns = environment.radiance.shape[:2]
    part = env.directions(columns, rows)[..., axis, None]
    return replace(
        environment,
        radiance=environment.radiance * part,
        disk_radiance=environment.disk_radiance * environment.disk_directions[:, axis, None],
    )
