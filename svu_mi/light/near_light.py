"""Light that arrives from other surfaces: shapes around the object, and the object itself."""

from dataclasses import dataclass, replace
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.band_limited import MOMENTS, diffuse_moments

GOLDEN = (5**0.5 - 1) / 2
RAYS = 64  # number of rays of each texel
STEPS = 3242174889, 2447445414  # of Roberts' R2 sequence, times 2^32


class Surfaces(Protocol):
    """Surfaces around texels, such as ``NearSurfaces``."""

    def radiance_along(self, origin: Any, direction: Any, active: Any, size: Any) -> Any:
        """Return the radiance that active rays of solid angle ``size`` meet, Color3f."""


@dataclass(frozen=True)
class NearLight:
    """Light from other surfaces at S texels.

    Attributes:
        surfaces: The surfaces, which lobes sample.
        row: Number of each texel when rays were traced.
        rays: Number of rays of each texel, UInt32.
        colors: Radiance along each ray of the first row, then of the next, Color3f.
        moments: Diffuse moments (``LightVisibility.diffuse``), 8 (S,) Floats for R, G and B.
    """

    surfaces: Surfaces
    row: Any
    rays: Any
    colors: Any
    moments: list[list[Any]]

    def subset(self, lanes: np.ndarray) -> "NearLight":
        """Return the light at selected texels."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        row, moments = dr.gather(list, [self.row, self.moments], chosen)
        return replace(self, row=row, moments=moments)

    def ray(self, number: Any) -> tuple[Any, Any]:
        """Return the direction of a ray in the frame of the normal, and its radiance, Color3f."""
        color = dr.gather(mi.Color3f, self.colors, self.row * self.rays + number)
        return _direction(self.row, number, self.rays), color


def _direction(row: Any, ray: Any, rays: Any) -> Any:
    """Return the direction of a ray: a Fibonacci lattice on the hemisphere, moved by row."""
    jitter, turn = (mi.Float(row * k) * 2**-32 for k in STEPS)
    z = (mi.Float(ray) + jitter) / mi.Float(rays)
    azimuth = mi.Float(ray) * GOLDEN + turn
    sine, cosine = dr.sincos(2 * dr.pi * (azimuth - dr.floor(azimuth)))
    radius = dr.sqrt(1 - z * z)
    return mi.Vector3f(radius * cosine, radius * sine, z)


def trace_near_light(surfaces: Surfaces, surface: TexelLanes, rays: int = RAYS) -> NearLight:
    """Trace rays from texels to other surfaces."""
    count, row, colors = surface.count, surface.lane, dr.empty(mi.Color3f, rays * surface.count)
    number, frame = dr.opaque(mi.UInt32, rays), mi.Frame3f(surface.normal)
    part = 2 * np.pi * dr.rcp(mi.Float(number))  # solid angle of a ray
    origin = surface.position + surface.offset * surface.geometric_normal

    def add(ray: Any, colors: Any, *sums: Any) -> tuple[Any, ...]:
        local = _direction(row, ray, number)
        world = frame.to_world(local)
        up = dr.dot(surface.geometric_normal, world) > 0
        color = surfaces.radiance_along(origin, world, up, part)
        dr.scatter(colors, color, row * number + ray, mode=dr.ReduceMode.NoConflicts)
        added = [x for value in color for x in diffuse_moments(value, local.z, world)]
        return (ray + 1, colors, *(a + b for a, b in zip(sums, added, strict=True)))

    colors, *sums = fold(0, number, add, colors, *[dr.zeros(mi.Float, count)] * (3 * MOMENTS))
    sums = [part * total for total in sums]
    moments = [sums[first : first + MOMENTS] for first in range(0, len(sums), MOMENTS)]
    dr.eval(row, colors, moments)
    return NearLight(surfaces, row, number, colors, moments)
