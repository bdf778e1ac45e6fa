"""Lobes of light from other surfaces (``light/near_light.py``), which rays of all lobes sample."""

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
RAYS, WIDTHS = 40, (0.02, 0.05, 0.1, 0.2, 0.5)  # number of rays of each sample, and their alpha
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

        Rays follow visible GGX normals of all widths in turn. Each lobe weights all rays by the
        ratio of its density to their mean one (balance heuristic [Veach and Guibas 1995]).
        """
        frame = mi.Frame3f(surface.normal)
        widths, lobe = np.unique(np.maximum(self.alpha, NARROWEST), return_inverse=True)
        table = to_drjit(mi.Float, np.array(WIDTHS))
        origin = surface.position + surface.offset * surface.geometric_normal
        local = mi.Vector3f(frame.to_local(direction))
        local.z = dr.maximum(local.z, GRAZING)
        lobes = [(width, smith_g1(local.z, width)) for width in widths.tolist()]
        sampled = [(width, smith_g1(local.z, width)) for width in WIDTHS]
        bits = (dr.reinterpret_array(mi.UInt32, x) for x in (direction.x, direction.y))
        turns = [mi.Float(number) * 2**-32 for number in mi.sample_tea_32(*bits)]

        def add(ray: Any, *sums: Any) -> tuple[Any, ...]:
            point = [turn + mi.Float(ray) * step for turn, step in zip(turns, LATTICE, strict=True)]
            point = [dr.clip(x - dr.floor(x), INSIDE, 1 - INSIDE) for x in point]
            width = dr.gather(mi.Float, table, ray % len(WIDTHS))
            own = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, width)
            normal = own.sample(local, mi.Point2f(*point))[0]
            toward = mi.reflect(local, normal)
            world = frame.to_world(toward)
            up = (toward.z > 0) & (dr.dot(surface.geometric_normal, world) > 0)
            incident = dr.maximum(toward.z, GRAZING)
            density = sum(ggx(normal.z, a) * masking for a, masking in sampled)
            scale = dr.select(toward.z > 0, dr.rcp(density), 0)
            size = scale * local.z * (4 * len(WIDTHS) / RAYS)  # solid angle of a ray
            color = self.near.surfaces.radiance_along(origin, world, up, size)
            weights = [ggx(normal.z, a) * g * smith_g1(incident, a) * scale for a, g in lobes]
            added = [weight * value for weight in weights for value in (1, *color)]
            sums = tuple(old + new for old, new in zip(sums, added, strict=True))
            return dr.select((ray + 1 == FIRST) & (sum(sums[-3:]) == 0), RAYS, ray + 1), *sums

        rays = dr.select(sum(x[0] for x in self.near.moments) > 0, dr.opaque(mi.UInt32, RAYS), 0)
        sums = fold(0, rays, add, *[dr.zeros(mi.Float, surface.count)] * (4 * len(widths)))
        return [[x / dr.maximum(sums[4 * k], FAINT) for x in sums[4 * k + 1 : 4 * k + 4]]
                for k in lobe.tolist()]  # fmt: skip
