"""Light that arrives from other surfaces: shapes around the object, and the object itself.

It varies slowly over directions. Above each texel, its radiance L and the hidden part H (1 where a
ray hits something) are expanded into spherical harmonics in the frame of the normal. Both are
mirrored below the horizon, which makes them smooth there: only coefficients with even l + m remain.
They exclude the object as shown, which each lobe samples by rays (``NearLobes``).
"""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.core.local_memory import scatter_strided
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.band_limited import MOMENTS, diffuse_moments

DEGREE = 6
EVEN = [l * l + l + m for l in range(DEGREE + 1) for m in range(-l, l + 1) if (l + m) % 2 == 0]
PARTS = 4  # R, G and B of L, and H
GOLDEN = (5**0.5 - 1) / 2
SAMPLES, FEWEST = 2**22, 64  # rays of all texels, and of each
MOST = 128, 512  # rays of each texel to the object only, and to other shapes


@dataclass(frozen=True)
class NearLight:
    """Light from other surfaces at S texels.

    Attributes:
        values: (4 K N,) Float: K coefficients of R, G, B and H in the order of ``EVEN``, each at
            all N traced texels; empty if other shapes are black.
        moments: Diffuse moments (``LightVisibility.diffuse``), 8 (S,) Floats for R, G and B.
        count: Opaque UInt32, N.
        place: (S,) UInt32, index of each texel among the traced ones.
        shown: The object (``ShownObject``); None if it is black.
    """

    values: Any
    moments: list[list[Any]]
    count: Any
    place: Any
    shown: Any = None

    def subset(self, lanes: np.ndarray) -> "NearLight":
        """Return the light at selected texels."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        moments, place = dr.gather(list, [self.moments, self.place], chosen)
        return replace(self, moments=moments, place=place)

    def at(self, lane: Any, local: Any) -> list[list[Any]]:
        """Evaluate R, G, B and H in a direction of the local frame: a Float for each degree."""
        if not dr.width(self.values):
            return [[mi.Float(0)] * (DEGREE + 1)] * PARTS
        basis, size = dr.sh_eval(local, DEGREE), len(EVEN)
        place = dr.gather(mi.UInt32, self.place, lane)
        parts = [[mi.Float(0)] * (DEGREE + 1) for _ in range(PARTS)]
        for part, of_degree in enumerate(parts):
            for k, index in enumerate(EVEN):
                value = dr.gather(mi.Float, self.values, (part * size + k) * self.count + place)
                l = int(index**0.5)
                of_degree[l] = dr.fma(value, basis[index], of_degree[l])
        return parts


def ray_count(texels: int, others: bool) -> int:
    """Return the number of rays of each texel, to the object itself and perhaps ``others``."""
    return int(np.clip(SAMPLES // max(texels, 1), FEWEST, MOST[others]))


def trace_near_light(
    scene: Any, integrator: Any, surface: TexelLanes, rays: int, shown: Any = None
) -> NearLight:
    """Trace rays to other surfaces.

    ``integrator`` returns the radiance of other shapes; None if they are black. If the object is
    ``shown``, its radiance is in the moments only.
    """
    count, sampler = surface.count, mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, 0), count)
    number, frame = dr.opaque(mi.UInt32, rays), mi.Frame3f(surface.normal)
    step, turn = dr.rcp(mi.Float(number)), sampler.next_1d()
    origin = surface.position + surface.offset * surface.geometric_normal
    target = scene.shapes()[0]  # the object (``surroundings``)

    def add(ray: Any, sampler: Any, *sums: Any) -> tuple[Any, ...]:
        # A Fibonacci lattice on the hemisphere, turned and jittered for each texel.
        z = (mi.Float(ray) + sampler.next_1d()) * step
        turns = mi.Float(ray) * GOLDEN + turn
        sin, cos = dr.sincos(2 * np.pi * (turns - dr.floor(turns)))
        r = dr.sqrt(dr.maximum(1 - z * z, 0))
        local = mi.Vector3f(r * cos, r * sin, z)
        world = frame.to_world(local)
        toward = mi.RayDifferential3f(origin, world)
        up = dr.dot(surface.geometric_normal, world) > 0
        met = scene.ray_intersect_preliminary(toward, active=up)
        hidden, own = up & met.is_valid(), met.shape == mi.ShapePtr(target)
        glow = mi.Color3f(0)
        if shown is not None:
            glow = shown.radiance(toward, met, hidden & own)
            hidden &= ~own
        added = []
        if integrator is not None:
            # Lamps are sampled directly (``lamps``).
            shines = hidden & (~met.shape.is_emitter() | own)
            color, _, _ = integrator.sample(scene, sampler, toward, None, shines)
            color = dr.select(shines & dr.all(dr.isfinite(color)), color, 0)
            glow += color
            basis = dr.sh_eval(local, DEGREE)
            expanded = [*color, dr.select(hidden, mi.Float(1), 0)]
            added = [2 * value * basis[index] for value in expanded for index in EVEN]
        for value in glow:
            added += diffuse_moments(value, z, world)
        return (ray + 1, sampler, *(a + b for a, b in zip(sums, added, strict=True)))

    size, zero = PARTS * len(EVEN) * (integrator is not None), dr.zeros(mi.Float, count)
    _, *sums = fold(0, number, add, sampler, *[zero] * (size + 3 * MOMENTS))
    sums = [2 * np.pi * step * total for total in sums]
    lanes = dr.opaque(mi.UInt32, count)
    values = dr.zeros(mi.Float, size * count)
    if size:
        values = scatter_strided(values, sums[:size], surface.lane, lanes)
    moments = [sums[first : first + MOMENTS] for first in range(size, len(sums), MOMENTS)]
    dr.eval(values, moments)
    return NearLight(values, moments, lanes, surface.lane, shown)
