"""Radiance of surfaces around texels: other shapes, and the object itself.

The object is shaded by materials estimated from the photographs. Rays that hit it read the diffuse
radiance of the nearest texel, and the light in the lobe around the mirror direction. Where that
meets the object again, texels look alike from all sides. Rays stand for the directions around them,
so that lobes are widened, as at a mirror that is curved [Krivanek and Colbert 2008].
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.geometry.sample_view import mirror_direction
from svu_mi.light.panorama import Panorama
from svu_mi.reflection.mix_columns import mixed_radiance
from svu_mi.reflection.render_model import PrefilteredModel, lobe_light

WIDENED = 0.5 / dr.pi  # square of the alpha that lobes gain, relative to the solid angle of rays


@dataclass(frozen=True)
class ShownObject:
    """Materials of the object's texels.

    Attributes:
        light: distant light and lobes.
        values: (8 W H,) Float: radiance (3) without lobes, roughness, base colour (3) and metallic
            of each texel, row 0 at v = 0.
        size: Width and height.
        glow: mean radiance, a Texture.
    """

    light: PrefilteredModel
    values: Any
    size: tuple[int, int]
    glow: Any

    def at(self, uv: Any) -> tuple[Any, ...]:
        """Return radiance and roughness, and base colour and metallic, a Vector4f each."""
        x, y = (dr.clip(mi.Int32(dr.floor(place * count)), 0, count - 1)
                for place, count in zip(uv, self.size, strict=True))  # fmt: skip
        texel = mi.UInt32(y * self.size[0] + x)
        return tuple(dr.gather(mi.Vector4f, self.values, 2 * texel + k) for k in (0, 1))


@dataclass(frozen=True)
class NearSurfaces:
    """The first shape of a scene, which is the object, and other shapes.

    Attributes:
        shown: The object; None if it is black.
        others: Light of other shapes; None if they are black.
    """

    scene: Any
    shown: ShownObject | None
    others: Panorama | None

    def radiance_along(self, origin: Any, direction: Any, active: Any, size: Any) -> Any:
        """Return the radiance that active rays of solid angle ``size`` meet; lamps are black."""
        ray = mi.Ray3f(origin, direction)
        met = self.scene.ray_intersect_preliminary(ray, False, active)
        hits, itself = active & met.is_valid(), self._is_object(met)
        color = mi.Color3f(0)
        if self.shown is not None:
            color = dr.if_stmt((ray, met, size), hits & itself, self._shaded, lambda *_: color)
        return color + self._of_others(ray(met.t), met, hits)

    def _shaded(self, ray: Any, met: Any, size: Any) -> Any:
        """Return the radiance of hits of the object toward the origins of rays, Color3f."""
        assert self.shown is not None
        shape = self.scene.shapes()[0]  # a virtual call would depend on all shapes in memory
        hit = shape.compute_surface_interaction(ray, met, mi.RayFlags.All)
        toward, normal = -ray.d, mi.Vector3f(hit.sh_frame.n)
        front = dr.dot(hit.n, toward) > 0
        diffuse, paint = self.shown.at(hit.uv)
        roughness = dr.sqrt(dr.sqrt(dr.square(dr.square(diffuse.w)) + WIDENED * size))
        light, (A, B, D) = lobe_light(self.shown.light, roughness, normal, toward)
        mirror = mirror_direction(normal, toward)
        up = front & (dr.dot(hit.n, mirror) > 0)
        ray = hit.spawn_ray(mirror)
        met = self.scene.ray_intersect_preliminary(ray, False, up)
        hidden = up & met.is_valid()
        behind = shape.compute_surface_interaction(ray, met, mi.RayFlags.UV)
        itself = hidden & self._is_object(met) & (dr.dot(behind.n, mirror) < 0)
        glow = dr.select(itself, mi.Color3f(self.shown.glow.eval(behind, itself)), 0)
        glow += self._of_others(ray(met.t), met, hidden)
        light = [x + dr.select(up & ~hidden, y, 0) for x, y in zip(glow, light, strict=True)]
        parts = [(mi.Float(0), A * value, B * value, D * value) for value in light]
        shine = mixed_radiance(parts, [paint.x, paint.y, paint.z], [paint.w])
        color = mi.Color3f(diffuse.x, diffuse.y, diffuse.z) + mi.Color3f(*shine)
        return dr.select(front, color, 0)

    def _of_others(self, point: Any, met: Any, active: Any) -> Any:
        """Return the radiance of hits of other shapes; lamps are sampled directly."""
        if self.others is None:
            return mi.Color3f(0)
        return self.others.radiance(point, active & ~self._is_object(met) & ~met.shape.is_emitter())

    def _is_object(self, met: Any) -> Any:
        return met.shape == mi.ShapePtr(self.scene.shapes()[0])
