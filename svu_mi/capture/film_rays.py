"""Camera rays of many views in one kernel launch, and renders of selected pixels.

Rays repeat the arithmetic of ``PerspectiveCamera::sample_ray`` and are bitwise equal on LLVM.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.scene import read_matrix
from svu_mi.capture.sensors import describe, film_size
from svu_mi.core.arrays import to_drjit

RAY_FLOATS = 24  # per view; gathered in vectors of four
LAUNCH = 1 << 22  # rays per kernel launch
MASK_GRID = 3  # mask rays per pixel side; a single miss excludes the pixel from the object


def ray_floats(sensor: Any, record: Mapping[str, Any]) -> np.ndarray:
    """Return the camera parameters of one view, (24,) float32, given ``describe(sensor)``.

    In order: scale and offset of x, scale and offset of y (film to camera space); z and w
    of that map (constant); principal point offset (2) in crop windows; three rows of ``to_world``;
    near clip, far clip, width and height of the crop window in pixels.
    """
    film, size, principal_point = (
        np.array(record[key], np.float32) for key in ("film", "crop_size", "principal_point_offset")
    )
    shift = film * principal_point * (1 / size)  # Mitsuba multiplies by the rounded reciprocal
    unproject = read_matrix(sensor.projection_transform().inverse())
    return np.concatenate(
        [
            unproject[[0, 0, 1, 1, 2, 3], [0, 3, 1, 3, 3, 3]],
            shift,
            np.ravel(record["to_world"][:3]),
            [*record["clip"], *size],
        ],
        dtype=np.float32,
    )


def ray_table(sensors: Sequence[Any]) -> Any:
    """Return the ``ray_floats`` of V sensors as one Float of width V * 24."""
    floats = [ray_floats(sensor, describe(sensor)) for sensor in sensors]
    return to_drjit(mi.Float, np.array(floats, np.float32).ravel())


def film_ray(floats: Any, view: Any, x: Any, y: Any) -> Any:
    """Make the camera ray (``mi.Ray3f``) through a film position in pixels.

    Args:
        floats: (V * 24,) Float, see ``ray_table``.
        view: UInt32, index of the view.
        x: Float in [0, width of the crop window].
        y: Float in [0, height of the crop window].
    """
    scale, lens, right, up, forward, film = (
        dr.gather(mi.Vector4f, floats, view * (RAY_FLOATS // 4) + k) for k in range(6)
    )
    u, v = x / film.z + lens.z, y / film.w + lens.w
    divisor = dr.rcp(lens.y)
    local = dr.normalize(
        mi.Vector3f(
            dr.fma(scale.x, u, scale.y) * divisor,
            dr.fma(scale.z, v, scale.w) * divisor,
            lens.x * divisor,
        )
    )
    rows = (right, up, forward)
    direction = mi.Vector3f(
        *(dr.fma(r.z, local.z, dr.fma(r.y, local.y, r.x * local.x)) for r in rows)
    )
    per_depth = dr.rcp(local.z)
    near, far = film.x * per_depth, film.y * per_depth
    origin = mi.Point3f(*(row.w for row in rows)) + direction * near
    return mi.Ray3f(origin, direction, far - near, 0.0, [])


def pixel_rays(
    floats: Any, pixels: tuple[Any, Any, Any], count: int, place: Callable[[Any], Any]
) -> Any:
    """Make N * count ``mi.Ray3f`` through N pixels, pixel by pixel.

    Args:
        floats: (V * 24,) Float, see ``ray_table``.
        pixels: View, row and column, (N,) UInt32 each.
        count: Number of rays per pixel.
        place: Map from ray number (UInt32) to x and y in the pixel, two Floats in [0, 1].
            See ``stratified``.
    """
    index, number = dr.arange(mi.UInt32, dr.width(pixels[0]) * count), dr.opaque(mi.UInt32, count)
    of_pixel = index // number
    view, row, column = (dr.gather(mi.UInt32, part, of_pixel) for part in pixels)
    x, y = place(index - of_pixel * number)
    return film_ray(floats, view, mi.Float(column) + x, mi.Float(row) + y)


def stratified(side: int) -> Callable[[Any], Any]:
    """Return the ``place`` of ``pixel_rays`` for a grid of ``side``^2 rays."""
    return lambda k: ((mi.Float(k % side) + 0.5) / side, (mi.Float(k // side) + 0.5) / side)


@dataclass(frozen=True)
class SensorPixels:
    """All pixels of V sensors, numbered view by view in row-major order.

    Attributes:
        sensors: V perspective sensors.
    """

    sensors: Sequence[Any]

    @cached_property
    def sizes(self) -> np.ndarray:
        """Widths and heights in pixels, (V, 2) int64."""
        return np.array([film_size(sensor) for sensor in self.sensors], np.int64).reshape(-1, 2)

    @cached_property
    def first(self) -> np.ndarray:
        """Index of each view's first pixel, then the number of all pixels: (V + 1,) int64."""
        return np.concatenate([[0], np.cumsum(self.sizes.prod(axis=1))])

    def covered(self, scene: Any, target: Any) -> list[np.ndarray]:
        """Return the fraction of each pixel that shows the target, V arrays (h, w)."""
        part = np.zeros(self.first[-1], np.float32)
        for span, rays in self._launches(np.arange(self.first[-1]), MASK_GRID**2):
            hit = scene.ray_intersect_preliminary(rays(stratified(MASK_GRID)), coherent=True)
            # Opaque: a literal would recompile the kernel for every scene.
            on_target = hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, target))
            hits = dr.block_sum(dr.select(on_target, mi.UInt32(1), 0), MASK_GRID**2)
            part[span] = np.array(hits) / np.float32(MASK_GRID**2)
        return self._by_view(part)

    def traced(
        self, scene: Any, integrator: Any, wanted: Sequence[np.ndarray], spp: int, seed: int = 0
    ) -> list[np.ndarray]:
        """Render selected pixels with a box filter.

        Args:
            scene: ``mi.Scene`` to render.
            integrator: A sampling integrator.
            wanted: V arrays (h, w) bool, True for pixels to render.
            spp: Samples per pixel, rounded to a square number for stratification.
            seed: Seed of the random numbers.

        Returns:
            V arrays (h, w, 3) float32 of radiance, 0 in other pixels.
        """
        spp = max(round(spp**0.5), 1) ** 2
        sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
        sampler.set_samples_per_wavefront(spp)
        none = np.zeros(0, bool)
        chosen = np.flatnonzero(np.concatenate([none, *(mask.ravel() for mask in wanted)]))
        image = np.zeros((self.first[-1], 3), np.float32)
        for number, (span, rays) in enumerate(self._launches(chosen, spp)):
            pixels = chosen[span]
            sampler.seed((seed + number) % 2**32, len(pixels) * spp)
            ray = rays(lambda _: sampler.next_2d())
            color = integrator.sample(scene, sampler, mi.RayDifferential3f(ray), None, True)[0]
            dr.eval(color)  # otherwise each channel's sum traces the paths again
            mean = [dr.block_sum(channel, spp) / spp for channel in color]
            dr.eval(mean)
            image[pixels] = np.stack([channel.numpy() for channel in mean], axis=1)
        return self._by_view(image)

    def _launches(self, pixels: np.ndarray, rays: int) -> Iterator[tuple[slice, Any]]:
        """Yield slices of ``pixels``, and a function that makes their rays.

        The function takes a ``place`` (see ``pixel_rays``) and makes ``rays`` rays per pixel.
        """
        view = np.searchsorted(self.first, pixels, "right") - 1
        row, column = np.divmod(pixels - self.first[view], self.sizes[view, 0])
        table = ray_table(self.sensors)
        size = max(LAUNCH // rays, 1)
        for start in range(0, len(pixels), size):
            span = slice(start, min(start + size, len(pixels)))
            parts = tuple(
                to_drjit(mi.UInt32, part[span].astype(np.uint32)) for part in (view, row, column)
            )
            yield span, partial(pixel_rays, table, parts, rays)

    def _by_view(self, values: np.ndarray) -> list[np.ndarray]:
        """Split values (N, ...) of all pixels into V arrays (h, w, ...)."""
        return [
            values[begin:end].reshape(height, width, *values.shape[1:])
            for begin, end, (width, height) in zip(
                self.first[:-1], self.first[1:], self.sizes, strict=True
            )
        ]
