"""Lobes of light from other surfaces (``light/near_light.py``), sampled by rays.

Wide lobes need many rays, but a texel has the same incident light in all views. So rays are traced
from each texel, and more of them for the narrow lobes of each sample; all lobes read both.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.near_light import NearLight
from svu_mi.reflection.albedo_table import AlbedoTable
from svu_mi.reflection.lobes import ggx, smith_g1
from svu_mi.reflection.wide_lobes import Lobe

FAINT = 0.02  # minimum sum of weights
RAYS, WIDTHS = 36, (0.02, 0.05, 0.1, 0.2)  # number of rays of each sample, and their alpha
FIRST = 10  # rays after which samples stop that met no light
NARROWEST = 0.01  # smallest alpha of lobes that they sample
GRAZING = 0.01  # smallest cosine of their viewing angle
LATTICE = 0.7548776662466927, 0.5698402909980532  # steps of Roberts' R2 sequence
INSIDE = 1e-6  # distance of its points from edges, where normals are NaN


@dataclass(frozen=True)
class NearLobes:
    """Lobes of (K,) widths ``alpha``; ``channels`` is 3, or 1 for the mean of R, G and B."""

    near: NearLight
    channels: int
    alpha: np.ndarray
    albedo: AlbedoTable

    def reflect(self, surface: TexelLanes, direction: Any, cosine: Any) -> list[Lobe]:
        """Return the light reflected by each lobe."""
        sampled, result = self._sample(surface, direction), []
        for level, (alpha, color) in enumerate(zip(self.alpha.tolist(), sampled, strict=True)):
            light = [sum(color) / 3] if self.channels == 1 else color
            A, B, D = self.albedo.at(level, alpha, cosine)
            result.append([(A * value, B * value, D * value) for value in light])
        return result

    def _sample(self, surface: TexelLanes, direction: Any) -> list[list[Any]]:
        """Return R, G and B of other surfaces in each lobe.

        Rays of a sample follow visible GGX normals of all widths in turn, rays of a texel are
        uniform. Each lobe weights all rays by the ratio of its density to their density (balance
        heuristic [Veach and Guibas 1995]).
        """
        frame = mi.Frame3f(surface.normal)
        widths, lobe = np.unique(np.maximum(self.alpha, NARROWEST), return_inverse=True)
        table = to_drjit(mi.Float, np.array(WIDTHS))
        origin = surface.position + surface.offset * surface.geometric_normal
        local = mi.Vector3f(frame.to_local(direction))
        local.z = dr.maximum(local.z, GRAZING)
        lobes, sampled = ([(width, smith_g1(local.z, width)) for width in some]
                          for some in (widths.tolist(), WIDTHS))  # fmt: skip
        unit = 4 * local.z * (len(WIDTHS) / RAYS)  # of solid angles, for densities of normals
        uniform = unit * mi.Float(self.near.rays) / (2 * dr.pi)
        bits = (dr.reinterpret_array(mi.UInt32, x) for x in (direction.x, direction.y))
        turns = [mi.Float(number) * 2**-32 for number in mi.sample_tea_32(*bits)]

        def of_ray(up: Any) -> Any:
            return dr.rcp(sum(ggx(up, a) * masking for a, masking in sampled) + uniform)

        def added(sums: tuple[Any, ...], toward: Any, up: Any, part: Any, color: Any) -> list[Any]:
            incident = dr.maximum(toward.z, GRAZING)
            weights = [ggx(up, a) * g * smith_g1(incident, a) * part for a, g in lobes]
            more = [weight * value for weight in weights for value in (1, *color)]
            return [old + new for old, new in zip(sums, more, strict=True)]

        def cast(ray: Any, *sums: Any) -> tuple[Any, ...]:
            point = [turn + mi.Float(ray) * step for turn, step in zip(turns, LATTICE, strict=True)]
            point = [dr.clip(x - dr.floor(x), INSIDE, 1 - INSIDE) for x in point]
            width = dr.gather(mi.Float, table, ray % len(WIDTHS))
            own = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, width)
            normal = own.sample(local, mi.Point2f(*point))[0]
            toward = mi.reflect(local, normal)
            world = frame.to_world(toward)
            up = (toward.z > 0) & (dr.dot(surface.geometric_normal, world) > 0)
            part = dr.select(toward.z > 0, of_ray(normal.z), 0)
            color = self.near.surfaces.radiance_along(origin, world, up, part * unit)
            total = added(sums, toward, normal.z, part, color)
            dark = (ray + 1 == FIRST) & (sum(total[-3:]) == 0)  # as are the others, very likely
            following, factor = dr.select(dark, RAYS, ray + 1), dr.select(dark, RAYS / FIRST, 1)
            return following, *(factor * x for x in total)

        def read(ray: Any, *sums: Any) -> tuple[Any, ...]:
            toward, color = self.near.ray(ray)
            up = dr.normalize(toward + local).z
            return ray + 1, *added(sums, toward, up, of_ray(up), color)

        lit = sum(x[0] for x in self.near.moments) > 0
        sums = (dr.zeros(mi.Float, surface.count),) * (4 * len(widths))
        for rays, body in ((dr.opaque(mi.UInt32, RAYS), cast), (self.near.rays, read)):
            sums = fold(0, dr.select(lit, rays, 0), body, *sums)
        return [[x / dr.maximum(sums[4 * k], FAINT) for x in sums[4 * k + 1 : 4 * k + 4]]
                for k in lobe.tolist()]  # fmt: skip
