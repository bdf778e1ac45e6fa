"""What a sensor sees of the object alone: textures as pictures of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import mesh as meshes
from svu_mi.capture.poses import film_size, scaled_sensor
from svu_mi.capture.rays import evenly, pixel_rays, table_of
from svu_mi.interop import owned

SIDE = 512  # pixels of the longer side of a picture
SAMPLES = 3  # along each side of a pixel
AMBIENT = 0.35  # brightness of a surface that is seen edge on


@dataclass(frozen=True)
class Look:
    """What a sensor sees of an object: traced once, for any number of textures.

    Attributes:
        size: (width, height) of the picture.
        uv: (N,) Point2f of all samples, those of a pixel one after the other.
        shade: (N,) Float, how bright the surface is in each; 0 off the object.
        covered: (h, w) float32, the part of every pixel that the object covers.
    """

    size: tuple[int, int]
    uv: Any
    shade: Any
    covered: np.ndarray

    @staticmethod
    def of(scene: Any, sensor: Any) -> Look:
        """Trace the rays of a sensor, a few to a pixel, in a scene as of ``alone``."""
        width, height = film_size(sensor)
        pixel = dr.arange(mi.UInt32, width * height)
        row = pixel // dr.opaque(mi.UInt32, width)
        place = dr.zeros(mi.UInt32, width * height), row, pixel - row * width
        ray = pixel_rays(table_of([sensor]), place, SAMPLES**2, evenly(SAMPLES))
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        hit = si.is_valid()
        # Darker where the surface turns away, so that its form can be seen.
        shade = dr.lerp(AMBIENT, 1, dr.abs(dr.dot(si.sh_frame.n, ray.d)))
        uv, shade = dr.select(hit, si.uv, 0), dr.select(hit, shade, 0)
        dr.eval(uv, shade)
        covered = dr.block_sum(dr.select(shade > 0, mi.Float(1), 0), SAMPLES**2) / SAMPLES**2
        return Look((width, height), uv, shade, covered.numpy().reshape(height, width))

    @staticmethod
    def at(scene: Any, sensor: Any) -> Look:
        """Trace the rays of a sensor whose picture is made small, 512 pixels on its longer side."""
        return Look.of(scene, scaled_sensor(sensor, SIDE))

    def painted(self, texture: np.ndarray) -> np.ndarray:
        """Show a texture on the object, slightly shaded.

        Args:
            texture: (H, W, 3) colours as they shall appear on the screen, row 0 at v = 0.

        Returns:
            (h, w, 4) float32, colour over white and the part of the pixel that is covered.
        """
        # Antialiasing and shading work on screen values: good enough here.
        color = dr.select(self.shade > 0, self.shade * self._texel(texture), 1)
        return np.clip(np.dstack([self._mean(color), self.covered]), 0, 1)

    def values(self, texture: np.ndarray) -> np.ndarray:
        """Return means (h, w, 3) float32 of a texture (H, W, 3) over what of the object a pixel
        shows; 0 where it shows none."""
        mean = self._mean(dr.select(self.shade > 0, self._texel(texture), 0))
        return mean / np.maximum(self.covered, 1 / SAMPLES**2)[..., None]

    def _texel(self, texture: np.ndarray) -> Any:
        """Color3f, the texel of every sample."""
        height, width = texture.shape[:2]
        texels = owned(mi.Float, np.asarray(texture, np.float32).ravel())
        column, row = (
            mi.UInt32(dr.clip(at * dr.opaque(mi.Float, size), 0, dr.opaque(mi.Float, size - 1)))
            for at, size in ((self.uv.x, width), (self.uv.y, height))
        )
        return dr.gather(mi.Color3f, texels, row * dr.opaque(mi.UInt32, width) + column)

    def _mean(self, color: Any) -> np.ndarray:
        """Means over the samples of a pixel, (h, w, 3)."""
        dr.eval(color)
        mean = [dr.block_sum(channel, SAMPLES**2) / SAMPLES**2 for channel in color]
        dr.eval(mean)
        image = np.stack([channel.numpy() for channel in mean], axis=-1)
        return image.reshape(*self.covered.shape, 3)


def alone(capture: Any) -> Any:
    """Return a scene of the capture's ``mesh`` and nothing else."""
    return mi.load_dict(
        # A copy: a live shape belongs to one scene, and the capture's may have no UVs.
        {"type": "scene", "object": meshes.make("object", meshes.arrays(capture.mesh))},
        optimize=False,
    )
