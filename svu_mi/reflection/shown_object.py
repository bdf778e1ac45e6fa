"""Radiance of surfaces around texels: other shapes, and the object itself.

The object is shaded by materials estimated from the photographs. Rays that hit it read the diffuse
radiance of the nearest texel, and the light in the lobe around the mirror direction. Where that
meets the object again, texels look alike from all sides.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.geometry.sample_view import mirror_direction
from svu_mi.light.panorama import Panorama
from svu_mi.reflection.mix_columns import mixed_radiance
from svu_mi.reflection.render_model import PrefilteredModel, lobe_light


@dataclass(frozen=True)
class ShownObject:
    """The first shape of a scene, which emits its mean radiance.

    Attributes:
        light: distant light and lobes.
        values: (8 W H,) Float: radiance (3) without lobes, roughness, base colour (3) and metallic
            of each texel, row 0 at v = 0.
        size: Width and height.
        others: Light of other shapes; None if they are black.
    """

    scene: Any
    light: PrefilteredModel
    values: Any
    size: tuple[int, int]
    others: Panorama | None = None

    def radiance(self, ray: Any, met: Any, active: Any) -> Any:
        """Return the radiance of active hits of the object toward the origins of rays, Color3f."""
        return dr.if_stmt((ray, met), active, self._shaded, lambda *_: mi.Color3f(0))

    def _shaded(self, ray: Any, met: Any) -> Any:
        hit = met.compute_surface_interaction(ray, mi.RayFlags.All)
        shape, toward, normal = self.scene.shapes()[0], -ray.d, mi.Vector3f(hit.sh_frame.n)
        front = dr.dot(hit.n, toward) > 0
        x, y = (dr.clip(mi.Int32(dr.floor(place * count)), 0, count - 1)
                for place, count in zip(hit.uv, self.size, strict=True))  # fmt: skip
        texel = mi.UInt32(y * self.size[0] + x)
        diffuse, paint = (dr.gather(mi.Vector4f, self.values, 2 * texel + k) for k in (0, 1))
        light, (A, B, D) = lobe_light(self.light, diffuse.w, normal, toward)
        mirror = mirror_direction(normal, toward)
        up = front & (dr.dot(hit.n, mirror) > 0)
        behind = self.scene.ray_intersect(hit.spawn_ray(mirror), mi.RayFlags.UV, False, up)
        met, itself = up & behind.is_valid(), behind.shape == mi.ShapePtr(shape)
        glow = shape.emitter().eval(behind, met & itself)
        if self.others is not None:
            glow += self.others.radiance(behind.p, met & ~itself & ~behind.shape.is_emitter())
        light = [dr.select(met, own, dr.select(up, distant, 0))
                 for own, distant in zip(glow, light, strict=True)]  # fmt: skip
        parts = [(mi.Float(0), A * value, B * value, D * value) for value in light]
        shine = mixed_radiance(parts, [paint.x, paint.y, paint.z], [paint.w])
        color = mi.Color3f(diffuse.x, diffuse.y, diffuse.z) + mi.Color3f(*shine)
        return dr.select(front, color, 0)


@dataclass(frozen=True)
class NearSurfaces:
    """The object, which is the first shape of a scene, and other shapes; None if black."""

    scene: Any
    shown: ShownObject | None
    others: Panorama | None

    def radiance_along(self, origin: Any, direction: Any, active: Any) -> Any:
        """Return the radiance of the first surface on each active ray, Color3f; lamps are black."""
        ray = mi.Ray3f(origin, direction)
        met = self.scene.ray_intersect_preliminary(ray, False, active)
        hits, itself = active & met.is_valid(), met.shape == mi.ShapePtr(self.scene.shapes()[0])
        color = mi.Color3f(0)
        if self.shown is not None:
            color += self.shown.radiance(ray, met, hits & itself)
        if self.others is not None:  # lamps are sampled directly
            lit = hits & ~itself & ~met.shape.is_emitter()
            color += self.others.radiance(ray(met.t), lit)
        return color
