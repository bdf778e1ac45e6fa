"""Rays through the films of all views, and chosen pixels of many pictures, in few launches.

Rays are Mitsuba's own (``PerspectiveCamera::sample_ray``), step by step: equal to the last bit on
LLVM, so that it does not matter which of the two a pixel was judged by.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import describe, film_size
from svu_mi.core.arrays import to_drjit

RAY_FLOATS = 24  # per view, in groups of four: a kernel reads a group at once
LAUNCH = 1 << 22  # rays at a time
MASK_GRID = 3  # mask rays per pixel side; any miss puts a pixel off the object


def ray_floats(sensor: Any) -> np.ndarray:
    """Return (24,) float32, what the rays of one view are made of.

    Film to camera space (scale and shift of x, the same of y); depth and divisor there, shift
    of the principal point in crop windows; three rows of ``to_world``; near and far clip, width
    and height of the crop window in pixels.
    """
    film, principal_point = sensor.film(), describe(sensor)["principal_point_offset"]
    size = np.array(film.crop_size(), np.float32)
    # Mitsuba multiplies by the rounded reciprocal.
    shift = np.array(film.size(), np.float32) * np.array(principal_point, np.float32) * (1 / size)
    unproject = np.array(sensor.projection_transform().inverse().matrix, np.float32).reshape(4, 4)
    return np.concatenate(
        [
            unproject[[0, 0, 1, 1, 2, 3], [0, 3, 1, 3, 3, 3]],
            shift,
            to_world(sensor)[:3].ravel(),
            [sensor.near_clip(), sensor.far_clip(), *size],
        ],
        dtype=np.float32,
    )


def ray_table(sensors: Sequence[Any]) -> Any:
    """Return (V * 24,) Float, what the rays of V perspective sensors are made of."""
    return to_drjit(mi.Float, np.array([ray_floats(each) for each in sensors], np.float32).ravel())


def film_ray(floats: Any, view: Any, x: Any, y: Any) -> Any:
    """Make the ``mi.Ray3f`` of a view through a point of its film, in pixels.

    Args:
        floats: (V * 24,) Float, see ``ray_floats``.
        view: UInt32, index of the view.
        x: Float, 0 to the width of the crop window.
        y: Float, 0 to its height.
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
    """Make so many ``mi.Ray3f`` through each of N pixels, those of a pixel one after the other.

    Args:
        floats: (V * 24,) Float, see ``ray_table``.
        pixels: (N,) UInt32 each: number of the view, row and column.
        count: rays of a pixel.
        place: where in its pixel ray k is, UInt32 -> two Floats in [0, 1]; such as ``stratified``.
    """
    index, number = dr.arange(mi.UInt32, dr.width(pixels[0]) * count), dr.opaque(mi.UInt32, count)
    of_pixel = index // number
    view, row, column = (dr.gather(mi.UInt32, part, of_pixel) for part in pixels)
    x, y = place(index - of_pixel * number)
    return film_ray(floats, view, mi.Float(column) + x, mi.Float(row) + y)


def stratified(side: int) -> Callable[[Any], Any]:
    """Return a ``place`` for ``side``^2 rays, on a grid in the pixel."""
    return lambda k: ((mi.Float(k % side) + 0.5) / side, (mi.Float(k // side) + 0.5) / side)


@dataclass(frozen=True)
class SensorPixels:
    """Pictures of V perspective sensors, pixel by pixel; all are numbered, one row after another.

    Attributes:
        sensors: the sensors.
    """

    sensors: Sequence[Any]

    @cached_property
    def sizes(self) -> np.ndarray:
        """(V, 2) int64, widths and heights in pixels."""
        return np.array([film_size(sensor) for sensor in self.sensors], np.int64).reshape(-1, 2)

    @cached_property
    def first(self) -> np.ndarray:
        """(V + 1,) int64, number of the first pixel of each picture; and how many there are."""
        return np.concatenate([[0], np.cumsum(self.sizes.prod(axis=1))])

    def covered(self, scene: Any, target: Any) -> list[np.ndarray]:
        """Return (h, w) float32 of each picture: the part of each pixel that the target covers,
        unoccluded; 1 where it shows nothing else."""
        part = np.zeros(self.first[-1], np.float32)
        for span, rays in self._launches(np.arange(self.first[-1]), MASK_GRID**2):
            hit = scene.ray_intersect_preliminary(rays(stratified(MASK_GRID)), coherent=True)
            # Opaque: as a literal, every scene would get a kernel of its own.
            on_target = hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, target))
            hits = dr.block_sum(dr.select(on_target, mi.UInt32(1), 0), MASK_GRID**2)
            part[span] = np.array(hits) / np.float32(MASK_GRID**2)
        return self._apart(part)

    def traced(
        self, scene: Any, integrator: Any, wanted: Sequence[np.ndarray], spp: int, seed: int = 0
    ) -> list[np.ndarray]:
        """Render pixels; a box is their filter.

        Args:
            scene: the ``mi.Scene``.
            integrator: a sampling integrator.
            wanted: (h, w) bool of each picture, pixels to render.
            spp: samples per pixel, rounded to a square: they are spread evenly, not at random.
            seed: of the samples.

        Returns:
            (h, w, 3) float32 radiance of each picture, 0 in other pixels.
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
            dr.eval(color)  # sums of one channel at a time would trace the paths three times
            mean = [dr.block_sum(channel, spp) / spp for channel in color]
            dr.eval(mean)
            image[pixels] = np.stack([channel.numpy() for channel in mean], axis=1)
        return self._apart(image)

    def _launches(self, pixels: np.ndarray, rays: int) -> Iterator[tuple[slice, Any]]:
        """Yield parts of some pixels, and what makes rays through them, so many to a pixel, from
        where in the pixel the rays of a number are."""
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

    def _apart(self, values: np.ndarray) -> list[np.ndarray]:
        """Values (N, ...) of all pixels, as pictures (h, w, ...)."""
        return [
            values[begin:end].reshape(height, width, *values.shape[1:])
            for begin, end, (width, height) in zip(
                self.first[:-1], self.first[1:], self.sizes, strict=True
            )
        ]
