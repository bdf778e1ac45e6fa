"""Lobes of light from other surfaces (``light/near_light.py``).

A lobe of width alpha averages the radiance of other surfaces, by zonal factors of each degree. Its
hidden part is averaged likewise, or, for lobes narrower than the expansion, decided by the ray in
the mirror direction. If the object is not black, rays of all lobes sample its radiance and the part
that other surfaces hide.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.geometry.sample_view import TexelLanes, mirror_direction
from svu_mi.light.near_light import DEGREE, NearLight
from svu_mi.presets import AngularPreset
from svu_mi.reflection.albedo_table import AlbedoTable
from svu_mi.reflection.lobes import dominance, ggx, lobe_profile, smith_g1, zonal_factors
from svu_mi.reflection.wide_lobes import Lobe

FAINT = 0.02  # minimum hidden part
RAYS, WIDTHS = 40, (0.02, 0.05, 0.1, 0.2, 0.5)  # number of rays that sample the object, alpha
NARROWEST = 0.01  # smallest alpha of lobes that they sample
GRAZING = 0.01  # smallest cosine of their viewing angle
LATTICE = 0.7548776662466927, 0.5698402909980532  # steps of Roberts' R2 sequence
INSIDE = 1e-6  # distance of its points from edges, where normals are NaN


@dataclass(frozen=True)
class NearLobes:
    """Lobes of K widths.

    Attributes:
        channels: 3, or 1 for the mean of R, G and B.
        zonal: (K, DEGREE + 1) factors of the degrees.
        sharp: (K,) weights of the mirror ray, nearly 1 for the narrowest lobes.
        centers: (K,) centres: 0 is the normal, 1 half way, 2 the mirror direction.
    """

    near: NearLight
    channels: int
    alpha: np.ndarray
    albedo: AlbedoTable
    zonal: np.ndarray
    sharp: np.ndarray
    centers: np.ndarray

    @staticmethod
    def of(
        near: NearLight, channels: int, alpha: np.ndarray, switches: AngularPreset
    ) -> "NearLobes":  # fmt: skip
        """Tabulate the lobes of (K,) widths."""
        profile = lobe_profile(switches.lobe)
        centers = dominance(alpha) if switches.off_specular else np.ones(len(alpha))
        return NearLobes(
            near, channels, alpha, AlbedoTable.of(alpha, switches.fresnel),
            zonal=np.array([zonal_factors(profile, a, DEGREE) for a in alpha.tolist()]),
            sharp=np.exp(-((alpha * (DEGREE + 1)) ** 2)), centers=2 * centers,
        )  # fmt: skip

    def reflect(self, surface: TexelLanes, direction: Any, cosine: Any, free: Any) -> list[Lobe]:
        """Return the light reflected by each lobe; ``free`` marks unoccluded mirror rays."""
        normal = mi.Vector3f(surface.normal)
        mirror = mi.Frame3f(normal).to_local(mirror_direction(normal, direction))
        up = mi.Vector3f(0, 0, 1)
        directions = up, dr.normalize(up + mirror), mirror
        parts = [self.near.at(surface.lane, local) for local in directions]
        some, result = sum(of_channel[0] for of_channel in self.near.moments) > 0, []
        sampled = self.near.shown and self._sample(surface, direction, some)
        for level, alpha in enumerate(self.alpha.tolist()):
            *color, hidden = self._averaged(level, parts)
            part, own = hidden, [mi.Float(0)] * 3
            if sampled:
                *own, part = sampled[level]
            elif free is not None:
                met = dr.select(free, mi.Float(0), 1)
                part = dr.lerp(hidden, met, dr.opaque(mi.Float, self.sharp[level]))
            scale = dr.maximum(part, 0) / dr.maximum(hidden, FAINT)
            color = [dr.fma(scale, dr.maximum(x, 0), y) for x, y in zip(color, own, strict=True)]
            light = [sum(color) / 3] if self.channels == 1 else color
            A, B, D = self.albedo.at(level, alpha, cosine)
            result.append([(A * value, B * value, D * value) for value in light])
        return result

    def _sample(self, surface: TexelLanes, direction: Any, active: Any) -> list[list[Any]]:
        """Return the object's R, G and B in each lobe, and the part of its other hits.

        Rays follow visible GGX normals of all widths in turn. Each lobe weights all rays by the
        ratio of its density to their mean one (balance heuristic [Veach and Guibas 1995]).
        """
        shown, frame = self.near.shown, mi.Frame3f(surface.normal)
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
            path = mi.Ray3f(origin, world)
            met = shown.scene.ray_intersect_preliminary(path, False, up)
            hits, itself = up & met.is_valid(), met.shape == mi.ShapePtr(shown.scene.shapes()[0])
            color = shown.radiance(path, met, hits & itself)
            other = dr.select(hits & ~itself, mi.Float(1), 0)
            incident = dr.maximum(toward.z, GRAZING)
            density = sum(ggx(normal.z, a) * masking for a, masking in sampled)
            scale = dr.select(toward.z > 0, dr.rcp(density), 0)
            weights = [ggx(normal.z, a) * g * smith_g1(incident, a) * scale for a, g in lobes]
            added = [weight * value for weight in weights for value in (1, *color, other)]
            return ray + 1, *(old + new for old, new in zip(sums, added, strict=True))

        zero = dr.zeros(mi.Float, surface.count)
        rays = dr.select(active, dr.opaque(mi.UInt32, RAYS), 0)
        sums = fold(0, rays, add, *[zero] * (5 * len(widths)))
        return [[x / dr.maximum(sums[5 * k], FAINT) for x in sums[5 * k + 1 : 5 * k + 5]]
                for k in lobe.tolist()]  # fmt: skip

    def _averaged(self, level: int, parts: list[list[list[Any]]]) -> list[Any]:
        """Return R, G, B and H averaged by a lobe, between two of the three directions."""
        first = min(int(self.centers[level]), 1)
        zonal = [dr.opaque(mi.Float, x) for x in self.zonal[level].tolist()]
        low, high = (
            [sum(z * x for z, x in zip(zonal, part, strict=True)) for part in parts[first + step]]
            for step in (0, 1)
        )
        place = dr.opaque(mi.Float, self.centers[level] - first)
        return [dr.lerp(a, b, place) for a, b in zip(low, high, strict=True)]
