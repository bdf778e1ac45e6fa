"""Radiance of the object toward itself, shaded by materials estimated from the photographs.

Rays that hit the object read the diffuse radiance of the nearest texel, and the light in the lobe
around the mirror direction. Where that meets the object again, texels look alike from all sides.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.geometry.sample_view import mirror_direction
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
    """

    scene: Any
    light: PrefilteredModel
    values: Any
    size: tuple[int, int]

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
        met = up & behind.is_valid()
        glow = shape.emitter().eval(behind, met & (behind.shape == mi.ShapePtr(shape)))
        light = [dr.select(met, own, dr.select(up, distant, 0))
                 for own, distant in zip(glow, light, strict=True)]  # fmt: skip
        parts = [(mi.Float(0), A * value, B * value, D * value) for value in light]
        shine = mixed_radiance(parts, [paint.x, paint.y, paint.z], [paint.w])
        color = mi.Color3f(diffuse.x, diffuse.y, diffuse.z) + mi.Color3f(*shine)
        return dr.select(front, color, 0)
