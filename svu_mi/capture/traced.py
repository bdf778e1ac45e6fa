"""Chosen pixels of many pictures, traced in one launch.

A page compares dozens of small renders with photographs, on the object alone. As pictures of
their own, most of the time would go into launching them, and into their backgrounds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.poses import film_size
from svu_mi.capture.rays import evenly, pixel_rays, table_of
from svu_mi.interop import owned

LAUNCH = 1 << 22  # rays at a time
MASK_GRID = 3  # mask rays per pixel side; any miss puts a pixel off the object


@dataclass(frozen=True)
class Pictures:
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
            hit = scene.ray_intersect_preliminary(rays(evenly(MASK_GRID)), coherent=True)
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
        table = table_of(self.sensors)
        size = max(LAUNCH // rays, 1)
        for start in range(0, len(pixels), size):
            span = slice(start, min(start + size, len(pixels)))
            parts = tuple(
                owned(mi.UInt32, part[span].astype(np.uint32)) for part in (view, row, column)
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
