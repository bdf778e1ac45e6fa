"""Batches of pixels from all views, in random order, of those that show the object alone."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.poses import describe, film_size, make_sensor
from svu_mi.capture.rays import film_ray, table_of
from svu_mi.capture.trust import own_plugin
from svu_mi.errors import CaptureError, OptionError
from svu_mi.interop import owned
from svu_mi.visibility.views import Views, pack_views

TILE = 4  # pixels per side that stay together when the order is shuffled, unless asked otherwise


def proxy_sensor(sensor: Any, size: tuple[int, int], label: str = "view") -> Any:
    """Make a sensor with a film of another size whose pixels are those of the original.

    Crop windows become whole films, every pixel format RGB, and the film is continued to the
    right and below: pixel (i, j) of the original's photograph is pixel (i, j) of the proxy's.

    Args:
        sensor: a perspective sensor.
        size: (width, height) in pixels, at least that of the original's crop window.
        label: its name in messages.

    Raises:
        CaptureError: Mitsuba refuses it.
    """
    record = describe(sensor)
    full, offset = record["film"], record["crop_offset"]
    focal = full[0] / (2 * math.tan(math.radians(record["x_fov"]) / 2))
    shift = record["principal_point_offset"]
    # The principal point in pixels from the corner of the crop window.
    center = [full[axis] * (0.5 - shift[axis]) - offset[axis] for axis in range(2)]
    return make_sensor(
        record
        | {
            "x_fov": math.degrees(2 * math.atan(size[0] / (2 * focal))),
            "principal_point_offset": [0.5 - center[axis] / size[axis] for axis in range(2)],
            "film": size,
            "crop_offset": [0, 0],
            "crop_size": size,
        },
        label,
    )


class PixelBatches:
    """What to render at each step, and what it should look like.

    A batch is a function of its step: every ``epoch`` steps all usable pixels come once, in
    squares of pixels, or one by one, that are shuffled again for each epoch. (Those of the last
    batch are filled up with pixels of the first.)

    Attributes:
        sensors: V sensors with films of one size.
        loader: the ``mitsuba.ad.loaders.RayDataLoader`` behind it.
        size: pixels per batch.
        pixels: number of usable pixels.
        epoch: steps per epoch.
        mean: mean radiance of the usable pixels, over all channels.
    """

    def __init__(
        self, capture: Capture, size: int | None, seed: int = 0, views: Views | None = None, *,
        tile: int = TILE,
    ) -> None:  # fmt: skip
        """Find the usable pixels of all used views.

        Args:
            capture: the photographs.
            size: pixels per batch; fewer if there are not as many; None for as many as a used
                photograph has on average.
            seed: of the order.
            views: the views as ``pack_views`` lays them out, if that was done already.
            tile: pixels per side of a square that stays together.

        Raises:
            OptionError: an empty batch, a negative seed, or an empty square.
            CaptureError: no photograph shows the object in a usable pixel.
        """
        if (size is not None and size < 1) or seed < 0:
            raise OptionError(
                f"Batches need at least 1 pixel and a seed of at least 0, got {size} and {seed}."
            )
        if tile < 1:
            raise OptionError(f"Squares of pixels need at least 1 per side, got {tile}.")
        views = pack_views(capture) if views is None else views
        kept = [index for index in range(capture.count) if capture.used[index]]
        sizes = np.array([film_size(capture.sensors[index]) for index in kept])
        # Smaller films than a tile are a special case of the loader's.
        width, height = np.maximum(sizes.max(axis=0), tile + 1).tolist()
        common = (width, height)
        self.sensors = tuple(
            proxy_sensor(capture.sensors[index], common, capture.names[index]) for index in kept
        )
        usable, targets = _padded(capture, kept, views, common)
        self.pixels = int(usable.sum())
        if self.pixels == 0:
            raise CaptureError(
                "No photograph shows the object in a usable pixel; check masks and poses."
            )
        self.size = min(size or -(-self.pixels // len(kept)), self.pixels)
        self.mean = sum(float(t.sum(dtype=np.float64)) for t in targets) / (3 * self.pixels)
        tensors = [mi.TensorXf(owned(mi.Float, t.ravel()), shape=t.shape) for t in targets]
        self.loader = _classes(mi.variant())[1](
            list(self.sensors), tensors, owned(mi.Bool, usable.ravel()), self.size, seed,
            tile,
        )  # fmt: skip
        self.epoch = int(self.loader.iter_shuffle)

    def at(self, step: int) -> tuple[Any, Any]:
        """Return (target, sensor) of a step: TensorXf (1, size, 3) and the sensor to render.

        The sensor is one and the same object, aimed again by every call.
        """
        return self.loader.at(step)


def _padded(
    capture: Capture, kept: Sequence[int], views: Views, common: tuple[int, int]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return flags (V, H, W) and V images (H, W, 3) on films of one size."""
    width, height = common
    flat, offsets = views.usable.numpy(), views.offset.numpy()
    usable = np.zeros((len(kept), height, width), bool)
    targets = []
    for number, index in enumerate(kept):
        image = capture.images[index]
        rows, columns = image.shape[:2]
        start = int(offsets[number])
        good = flat[start : start + rows * columns].reshape(rows, columns)
        usable[number, :rows, :columns] = good
        target = np.zeros((height, width, 3), np.float32)
        target[:rows, :columns] = np.where(good[..., None], image, 0)
        targets.append(target)
    return usable, targets


@cache
def _classes(variant: str) -> tuple[Any, Any]:
    """Make sensor and loader of a variant; Mitsuba's own are those of the one it was loaded in."""
    assert variant == mi.variant()
    loaders: Any = importlib.import_module("mitsuba.ad.loaders")
    if not issubclass(loaders.ray_loader.FlatSensor, mi.Sensor):
        loaders = importlib.reload(loaders)  # was imported under another one

    class FilmRays(loaders.ray_loader.FlatSensor):
        """Mitsuba's sensor of chosen pixels; the same rays without a call per view.

        To call V sensors is traced V times at each step, which takes longer than the rays.
        """

        def aim(self, floats: Any) -> None:
            """Set what the rays are made of: (V * 24,) Float, see ``table_of``."""
            self.floats = floats

        def sample_ray_differential(
            self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
        ) -> tuple[Any, Any]:
            # A pinhole has no use for these, and its shutter is always open.
            del time, sample1, sample3, active
            pixel = dr.repeat(self.pixel_idx, dr.width(sample2) // dr.width(self.pixel_idx))
            # Opaque: another size of film would be another kernel.
            width = dr.opaque(mi.UInt32, self.source_film_width)
            view = pixel // (width * dr.opaque(mi.UInt32, self.source_film_height))
            row = pixel // width - view * dr.opaque(mi.UInt32, self.source_film_height)
            across = sample2 * mi.ScalarVector2f(self.film().crop_size())
            jitter = across - mi.Vector2i(across)
            ray = film_ray(
                self.floats, view, mi.Float(pixel % width) + jitter.x, mi.Float(row) + jitter.y
            )
            return mi.RayDifferential3f(ray), mi.Spectrum(1)

    mi.register_sensor("svu_film_rays", lambda props: FilmRays(props))

    class MaskedRays(loaders.RayDataLoader):
        """Mitsuba's loader, of chosen pixels only, and with a batch for any step."""

        def __init__(
            self, sensors: list[Any], targets: list[Any], usable: Any, size: int, seed: int,
            tile: int,
        ) -> None:  # fmt: skip
            super().__init__(sensors, targets, size, seed=seed, tile_size=tile)
            me: Any = self  # what Mitsuba's own loader defines is not typed
            aimed = own_plugin({"type": "svu_film_rays", "film": me.flat_sensor.film()})
            aimed.initialize(sensors, size)
            aimed.aim(table_of(sensors))
            me.flat_sensor = aimed
            if tile == 1:  # for which the loader makes no table
                me._initialize_tile_pixel_table()
            # The loader itself marks what lies outside a film in this way.
            table, nothing = me.tile_pixel_table, me.total_pixels
            chosen = dr.gather(mi.Bool, usable, table, table < nothing)
            me.tile_pixel_table = dr.select(chosen, table, nothing)
            dr.eval(me.tile_pixel_table)
            count = int(dr.count(usable)[0])
            self.iter_shuffle = -(-count // size)
            self.effective_total_pixels = self.iter_shuffle * size
            self._first = -1

        def shuffle_pixel_index(self, seed: Any) -> None:
            # By the table for single pixels, too: the loader's own way does not look at it.
            me: Any = self
            me._shuffle_pixel_index_tiled(seed)
            me._update_target_image_buffer()

        def at(self, step: int) -> tuple[Any, Any]:
            first = step - step % self.iter_shuffle
            if first != self._first:
                self.shuffle_pixel_index(dr.opaque(mi.UInt32, (self.seed + first) % 2**32))
                self._first = first
            # Counted from 1: at 0 the loader would shuffle by itself, to the same end.
            self.counter = self.iter_shuffle + step - first
            return self.next()

    return FilmRays, MaskedRays
