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
SAMPLES, FEWEST, MOST = 2**22, 64, 96  # rays of all texels, and of each


class Surfaces(Protocol):
    """Surfaces around texels, such as ``NearSurfaces``."""

    def radiance_along(self, origin: Any, direction: Any, active: Any, size: Any) -> Any:
        """Return the radiance that active rays of solid angle ``size`` meet, Color3f."""


@dataclass(frozen=True)
class NearLight:
    """Light from other surfaces at S texels.

    Attributes:
        surfaces: The surfaces, which lobes sample.
        moments: Diffuse moments (``LightVisibility.diffuse``), 8 (S,) Floats for R, G and B.
    """

    surfaces: Surfaces
    moments: list[list[Any]]

    def subset(self, lanes: np.ndarray) -> "NearLight":
        """Return the light at selected texels."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        return replace(self, moments=dr.gather(list, self.moments, chosen))


def trace_near_light(surfaces: Surfaces, surface: TexelLanes, rays: int = 0) -> NearLight:
    """Trace rays from texels to other surfaces (0: their number depends on that of the texels)."""
    count, sampler = surface.count, mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, 0), count)
    rays = rays or int(np.clip(SAMPLES // max(count, 1), FEWEST, MOST))
    number, frame = dr.opaque(mi.UInt32, rays), mi.Frame3f(surface.normal)
    step, turn = dr.rcp(mi.Float(number)), sampler.next_1d()
    origin = surface.position + surface.offset * surface.geometric_normal

    def add(ray: Any, sampler: Any, *sums: Any) -> tuple[Any, ...]:
        # A Fibonacci lattice on the hemisphere, turned and jittered for each texel.
        z = (mi.Float(ray) + sampler.next_1d()) * step
        turns = mi.Float(ray) * GOLDEN + turn
        turns -= dr.floor(turns)
        world = frame.to_world(mi.sph_to_dir(dr.acos(z), 2 * np.pi * turns))
        up = dr.dot(surface.geometric_normal, world) > 0
        color = surfaces.radiance_along(origin, world, up, 2 * np.pi * step)
        added = [x for value in color for x in diffuse_moments(value, z, world)]
        return (ray + 1, sampler, *(a + b for a, b in zip(sums, added, strict=True)))

    _, *sums = fold(0, number, add, sampler, *[dr.zeros(mi.Float, count)] * (3 * MOMENTS))
    sums = [2 * np.pi * step * total for total in sums]
    moments = [sums[first : first + MOMENTS] for first in range(0, len(sums), MOMENTS)]
    dr.eval(moments)
    return NearLight(surfaces, moments)
