"""Random batches of usable pixels from all views."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.film_rays import pixel_rays
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import CaptureError
from svu_mi.geometry.packed_views import Views, pack_views

TILE = 4  # pixels per side of tiles, which are shuffled as a whole for coherent paths


@dataclass(frozen=True)
class PixelBatch:
    """Batch of N pixels.

    Attributes:
        index: (N,) UInt32, indices into the packed pixels of all photographs (``Views``).
        places: View index, row and column, (N,) UInt32 each.
    """

    index: Any
    places: tuple[Any, Any, Any]

    def rays(self, views: Views, sampler: Any, spp: int) -> Any:
        """Return ``spp`` random rays per pixel; rays of one pixel are adjacent."""
        ray = pixel_rays(views.rays, self.places, spp, lambda _: sampler.next_2d())
        return mi.RayDifferential3f(ray)


class PixelBatches:
    """Batches of usable pixels, one per step; the step index alone determines a batch.

    An epoch contains every usable pixel once, in tiles that are shuffled anew per epoch. The last
    batch of an epoch is completed with the first pixels of the epoch.

    Attributes:
        views: Packed photographs.
        size: Pixels per batch.
        pixels: Number of usable pixels.
        epoch: Steps per epoch.
        mean: Mean radiance of the usable pixels, over all channels.
    """

    def __init__(
        self, capture: Capture, size: int | None, seed: int = 0, views: Views | None = None
    ) -> None:
        """Collect the usable pixels of all used views.

        Args:
            capture: Capture with the photographs.
            size: Pixels per batch, limited to all usable ones; None: mean number per photograph.
            seed: Seed of the order.
            views: Packed photographs of the capture; packed here if None.

        Raises:
            CaptureError: No pixel is usable.
        """
        self.views = views = pack_views(capture) if views is None else views
        self._seed = seed
        self._first = views.offset.numpy().astype(np.int64)
        self._width = views.width.numpy().astype(np.int64)
        usable, radiance = views.usable.numpy(), views.pixels.numpy().reshape(-1, 3)
        tiles, counts, total = [], [], 0.0
        for first, width, height in zip(
            self._first, self._width, views.height.numpy(), strict=True
        ):
            own = slice(first, first + width * int(height))
            good = usable[own].reshape(height, width)
            total += float(radiance[own][good.ravel()].sum(dtype=np.float64))
            index = np.arange(own.start, own.stop, dtype=np.uint32).reshape(good.shape)
            good = _tiled(good)
            tiles.append(_tiled(index)[good])
            counts.append(good.sum(axis=1))
        self._tiled = np.concatenate(tiles)  # usable pixels, tile by tile
        self._counts = np.concatenate([each[each > 0] for each in counts])  # of each tile
        self.pixels = len(self._tiled)
        if self.pixels == 0:
            raise CaptureError(
                "No photograph shows the object in a usable pixel; check masks and poses."
            )
        self.size = min(size or -(-self.pixels // views.number), self.pixels)
        self.epoch = -(-self.pixels // self.size)
        self.mean = total / (3 * self.pixels)
        self._order = lru_cache(1)(self._shuffled)  # keeps one epoch

    def at(self, step: int) -> PixelBatch:
        """Return the batch of a step."""
        epoch, number = divmod(step, self.epoch)
        chosen = np.arange(number * self.size, (number + 1) * self.size) % self.pixels
        index = self._order(epoch)[chosen]
        sorted_views = np.argsort(self._first)
        place = np.searchsorted(self._first[sorted_views], index, side="right") - 1
        view = sorted_views[place]
        row, column = np.divmod(index - self._first[view], self._width[view])
        lanes = [to_drjit(mi.UInt32, x.astype(np.uint32)) for x in (index, view, row, column)]
        return PixelBatch(lanes[0], (lanes[1], lanes[2], lanes[3]))

    def _shuffled(self, epoch: int) -> np.ndarray:
        """Return the indices of usable pixels in the order of an epoch."""
        tile = np.random.default_rng((self._seed, epoch)).permutation(len(self._counts))
        counts, begins = self._counts[tile], (np.cumsum(self._counts) - self._counts)[tile]
        within = np.arange(self.pixels) - np.repeat(np.cumsum(counts) - counts, counts)
        return self._tiled[np.repeat(begins, counts) + within]


def _tiled(plane: np.ndarray) -> np.ndarray:
    """Split an (H, W) plane into tiles, (n, TILE^2), padded with 0."""
    height, width = plane.shape
    plane = np.pad(plane, ((0, -height % TILE), (0, -width % TILE)))
    rows, columns = plane.shape[0] // TILE, plane.shape[1] // TILE
    squares = plane.reshape(rows, TILE, columns, TILE).swapaxes(1, 2)
    return squares.reshape(rows * columns, TILE**2)
