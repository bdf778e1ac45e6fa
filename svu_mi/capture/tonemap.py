"""Images for display: tone-mapped photographs and rendered textures."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import image_io as pictures
from svu_mi.capture import mesh as meshes
from svu_mi.capture.film_rays import pixel_rays, ray_table, stratified
from svu_mi.capture.sensors import film_size, projected, scaled_sensor
from svu_mi.core.arrays import to_drjit

WHITE = 0.95  # quantile of the object's pixels that becomes white
SIDE = 512  # pixels of the longer side of an image
SAMPLES = 2  # rays per side of a pixel
MANY = 2**17  # vertices; for larger meshes the bounding box is projected, which is faster
AMBIENT = 0.35  # shading factor at grazing angles


def white_radiance(photograph: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the radiance that becomes white by default; arguments: see ``tone_mapped``."""
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
        photograph: (H, W, 3) linear radiance.
        mask: (H, W) bool, True on the object; None uses all pixels.
        white: Radiance that becomes white; default: a quantile of the object's pixels.

    Returns:
        (H, W, 3) float32 in [0, 1]; NaN is grey.
    """
    linear = photograph / (white_radiance(photograph, mask) if white is None else white)
    return srgb(np.clip(linear, 0, 1))


def with_bounds(capture: Any, view: int) -> np.ndarray:
    """Return a photograph (H, W, 3) with lower bounds in place of its saturated channels."""
    image, saturation = capture.images[view], capture.clipped[view] if capture.clipped else None
    return image if saturation is None else np.where(saturation.flags, saturation.least, image)


def resized(photograph: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resample a photograph to (width, height); NaN pixels make their neighbours NaN."""
    height, width = photograph.shape[:2]
    if (width, height) == size:
        return np.array(photograph)
    if width % size[0] == 0 and height % size[1] == 0:
        return block_means(photograph, width // size[0], height // size[1])
    unusable = ~np.isfinite(photograph).all(axis=2, keepdims=True)
    planes = np.concatenate([np.where(unusable, 0, photograph), unusable], axis=2)
    bitmap = mi.Bitmap(np.ascontiguousarray(planes, np.float32)).resample(mi.ScalarVector2u(size))
    small = np.array(bitmap, np.float32)
    return np.where(np.abs(small[..., 3:]) > 1e-3, np.nan, np.maximum(small[..., :3], 0))


def block_means(photograph: np.ndarray, across: int, down: int) -> np.ndarray:
    """Return means of blocks of ``down`` x ``across`` pixels; omit incomplete blocks."""
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


@dataclass(frozen=True)
class ObjectView:
    """View of an object, traced once and reused for any number of textures.

    Attributes:
        window: Rows and columns that contain the object.
        uv: (N,) Point2f, UVs of all samples in the window, pixel by pixel.
        shade: (N,) Float, shading factors; 0 for samples that miss the object.
        covered: (h, w) float32, fraction of each pixel that shows the object.
    """

    window: tuple[slice, slice]
    uv: Any
    shade: Any
    covered: np.ndarray

    @staticmethod
    def of(scene: Any, sensor: Any) -> "ObjectView":
        """Trace the rays of a sensor in an ``object_only_scene``."""
        width, height = film_size(sensor)
        rows, columns = window = _window(scene.shapes()[0], sensor)
        shape = rows.stop - rows.start, columns.stop - columns.start
        across, top, left = (dr.opaque(mi.UInt32, n) for n in (shape[1], rows.start, columns.start))
        pixel = dr.arange(mi.UInt32, shape[0] * shape[1])
        row = pixel // across
        place = dr.zeros(mi.UInt32, dr.width(pixel)), top + row, left + pixel - row * across
        ray = pixel_rays(ray_table([sensor]), place, SAMPLES**2, stratified(SAMPLES))
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        hit = si.is_valid()
        # Darkening at grazing angles makes the geometry visible.
        shade = dr.lerp(AMBIENT, 1, dr.abs(dr.dot(si.sh_frame.n, ray.d)))
        uv, shade = dr.select(hit, si.uv, 0), dr.select(hit, shade, 0)
        dr.eval(uv, shade)
        part = dr.block_sum(dr.select(shade > 0, mi.Float(1), 0), SAMPLES**2) / SAMPLES**2
        covered = np.zeros((height, width), np.float32)
        covered[window] = part.numpy().reshape(shape)
        return ObjectView(window, uv, shade, covered)

    @staticmethod
    def at(scene: Any, sensor: Any, side: int = SIDE) -> "ObjectView":
        """Trace a sensor scaled down to at most ``side`` pixels per side."""
        return ObjectView.of(scene, scaled_sensor(sensor, side))

    def painted(self, texture: np.ndarray) -> np.ndarray:
        """Show a texture on the object, slightly shaded.

        Returns:
            (h, w, 4) float32 in [0, 1]: colour over white, and the covered fraction of the pixel.
        """
        # Averages encoded values: accurate enough for display.
        color = dr.select(self.shade > 0, self.shade * self._texel(texture), 1)
        return np.clip(np.dstack([self._mean(color, 1), self.covered]), 0, 1)

    def values(self, texture: np.ndarray) -> np.ndarray:
        """Return the texture's mean in each pixel, (h, w, 3); 0 off the object."""
        mean = self._mean(dr.select(self.shade > 0, self._texel(texture), 0), 0)
        return mean / np.maximum(self.covered, 1 / SAMPLES**2)[..., None]

    def _texel(self, texture: np.ndarray) -> Any:
        """Return the texture's nearest value at every sample, Color3f."""
        height, width = texture.shape[:2]
        texels = to_drjit(mi.Float, np.asarray(texture, np.float32).ravel())
        column, row = (
            mi.UInt32(dr.clip(at * dr.opaque(mi.Float, size), 0, dr.opaque(mi.Float, size - 1)))
            for at, size in ((self.uv.x, width), (self.uv.y, height))
        )
        return dr.gather(mi.Color3f, texels, row * dr.opaque(mi.UInt32, width) + column)

    def _mean(self, color: Any, beyond: float) -> np.ndarray:
        """Return means of samples per pixel, (h, w, 3); ``beyond`` outside of the window."""
        dr.eval(color)
        mean = [dr.block_sum(channel, SAMPLES**2) / SAMPLES**2 for channel in color]
        dr.eval(mean)
        image = np.full((*self.covered.shape, 3), beyond, np.float32)
        inside = image[self.window]
        inside[...] = np.stack([channel.numpy() for channel in mean], -1).reshape(inside.shape)
        return image


def _window(shape: Any, sensor: Any) -> tuple[slice, slice]:
    """Return the rows and columns that contain a mesh, at least one each.

    Return the whole film if a part of the mesh is not in front of the camera.
    """
    box = shape.bbox()
    points = np.array([box.corner(k) for k in range(8)], np.float64)
    if shape.vertex_count() <= MANY:
        points = meshes.positions(shape)
    width, height = film_size(sensor)
    places, depth = projected(sensor, points)
    if not (depth > 0).all():
        return slice(0, height), slice(0, width)
    low, high = np.floor(places.min(axis=0)) - 1, np.ceil(places.max(axis=0)) + 1
    left, top = (int(x) for x in np.clip(low, 0, (width - 1, height - 1)))
    right, bottom = (int(x) for x in np.clip(high, (left + 1, top + 1), (width, height)))
    return slice(top, bottom), slice(left, right)


def object_only_scene(capture: Any) -> Any:
    """Return a scene that contains only the capture's ``mesh``."""
    return mi.load_dict(
        # A copy, because Mitsuba shapes belong to one scene.
        {"type": "scene", "object": meshes.make_mesh("object", meshes.arrays(capture.mesh))},
        optimize=False,
    )
