"""Pictures of the object from the sensors of a capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import mesh as meshes
from svu_mi.capture import picture as pictures
from svu_mi.capture.poses import (
    bounding_sphere,
    directions_of,
    film_size,
    scaled_sensor,
)
from svu_mi.capture.rays import evenly, pixel_rays, table_of
from svu_mi.guidance.baselines import farthest
from svu_mi.interop import owned

SIDE = 512  # pixels of the longer side of a picture
SAMPLES = 3  # along each side of a pixel
AMBIENT = 0.35  # brightness of a surface that is seen edge on
MARGIN = 0.06  # around the object, in parts of its size
WHITE = 0.95  # part of the object's pixels that a tone-mapped photograph does not clip
Window = tuple[float, float, float, float]  # left, right, top, bottom, in parts of a picture


def far_apart(
    capture: Any, seen_per_view: Sequence[int] | None = None, count: int = 2
) -> list[int]:
    """Choose the used sensor that sees most texels, and those farthest from it in direction.

    Args:
        capture: the ``Capture``.
        seen_per_view: texels seen by each used view; by default the first view is taken.
        count: how many sensors; each is the farthest from all before it.

    Returns:
        Indices into ``capture.sensors``: ``count``, or fewer if there are fewer.
    """
    used = [index for index, used in enumerate(capture.used) if used]
    if len(used) < 2:
        return used
    center, _ = bounding_sphere(capture.mesh)
    first = 0 if seen_per_view is None else int(np.argmax(seen_per_view))
    chosen = farthest(directions_of((capture.sensors[index] for index in used), center),
                      [first], count - 1)
    return [used[index] for index in chosen]


def picture(capture: Any, texture: np.ndarray, sensor: Any) -> np.ndarray:
    """Render a texture on the mesh of a capture alone, as ``Look.painted`` does.

    The picture is at most 512 pixels on its longer side.
    """
    return Look.at(alone(capture), sensor).painted(texture)


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
        height, width = texture.shape[:2]
        texels = owned(mi.Float, np.asarray(texture, np.float32).ravel())
        column, row = (
            mi.UInt32(dr.clip(at * dr.opaque(mi.Float, size), 0, dr.opaque(mi.Float, size - 1)))
            for at, size in ((self.uv.x, width), (self.uv.y, height))
        )
        place = row * dr.opaque(mi.UInt32, width) + column
        # Antialiasing and shading work on screen values: good enough here.
        color = self.shade * dr.gather(mi.Color3f, texels, place)
        color = dr.select(self.shade > 0, color, 1)
        dr.eval(color)
        mean = [dr.block_sum(channel, SAMPLES**2) / SAMPLES**2 for channel in color]
        dr.eval(mean)
        image = np.stack([channel.numpy() for channel in mean], axis=-1)
        image = image.reshape(*self.covered.shape, 3)
        return np.clip(np.dstack([image, self.covered]), 0, 1)


def alone(capture: Any) -> Any:
    """Return a scene of the capture's ``mesh`` and nothing else."""
    return mi.load_dict(
        # A copy: a live shape belongs to one scene, and the capture's may have no UVs.
        {"type": "scene", "object": meshes.make("object", meshes.arrays(capture.mesh))},
        optimize=False,
    )


def object_window(alpha: np.ndarray) -> Window:
    """Return the window of an object with a margin, given where it is (H, W).

    Square in pixels where the image allows; the whole image if the object is not in it.
    """
    height, width = alpha.shape
    rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
    if len(rows) == 0:
        return 0.0, 1.0, 0.0, 1.0
    side = (1 + 2 * MARGIN) * (1 + max(float(np.ptp(rows)), float(np.ptp(columns))))
    left, right = _span((columns[0] + columns[-1] + 1) / 2, side, width)
    top, bottom = _span((rows[0] + rows[-1] + 1) / 2, side, height)
    return left, right, top, bottom


def crop(image: np.ndarray, window: Window) -> np.ndarray:
    """Cut a window out of an (H, W, ...) image."""
    height, width = image.shape[:2]
    left, right = int(window[0] * width), int(np.ceil(window[1] * width))
    top, bottom = int(window[2] * height), int(np.ceil(window[3] * height))
    return image[top:bottom, left:right]


def exposure(photograph: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the radiance that becomes white when a photograph is exposed for its object.

    Arguments are those of ``tone_mapped``.
    """
    brightness = photograph.max(axis=2)
    chosen = brightness[mask] if mask is not None and mask.any() else brightness
    chosen = chosen[np.isfinite(chosen)]
    white = float(np.quantile(chosen, WHITE)) if len(chosen) else 1.0
    return white if white > 0 else 1.0


def tone_mapped(
    photograph: np.ndarray, mask: np.ndarray | None = None, white: float | None = None
) -> np.ndarray:
    """Expose a photograph for its object and encode it as sRGB.

    Args:
        photograph: (H, W, 3) linear radiance; NaN = not usable, becomes middle grey.
        mask: (H, W) bool, the pixels to expose for; all of them by default.
        white: radiance that becomes white; by default that of ``exposure``.

    Returns:
        (H, W, 3) float32 in [0, 1].
    """
    linear = photograph / (exposure(photograph, mask) if white is None else white)
    return srgb(np.clip(linear, 0, 1))


def resized(photograph: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a photograph in (width, height) pixels; unusable ones leave NaN around them."""
    height, width = photograph.shape[:2]
    if (width, height) == size:
        return np.array(photograph)
    if width % size[0] == 0 and height % size[1] == 0:
        return shrunk(photograph, width // size[0], height // size[1])
    unusable = ~np.isfinite(photograph).all(axis=2, keepdims=True)
    planes = np.concatenate([np.where(unusable, 0, photograph), unusable], axis=2)
    bitmap = mi.Bitmap(np.ascontiguousarray(planes, np.float32)).resample(mi.ScalarVector2u(size))
    small = np.array(bitmap, np.float32)
    return np.where(np.abs(small[..., 3:]) > 1e-3, np.nan, np.maximum(small[..., :3], 0))


def shrunk(photograph: np.ndarray, across: int, down: int) -> np.ndarray:
    """Return means of so many pixels across and down; those left over at the ends are cut off."""
    height, width = photograph.shape[0] // down, photograph.shape[1] // across
    means = np.zeros((height, width, photograph.shape[2]), np.float32)
    for row in range(down):
        for column in range(across):
            means += photograph[row : down * height : down, column : across * width : across]
    return means / (across * down)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in [0, 1] as sRGB, float32; NaN becomes middle grey."""
    encoded = pictures.srgb(linear)
    return np.where(np.isfinite(encoded), encoded, 0.5).astype(np.float32)


def _span(center: float, side: float, size: int) -> tuple[float, float]:
    side = min(side, size)
    first = min(max(center - side / 2, 0), size - side)
    return first / size, (first + side) / size
