"""All views of a capture in flat arrays that one kernel can index by view.

Memory: 12 bytes per pixel for the photographs (float32 RGB) and 1 byte per pixel for the
flag that says whether a pixel may be used, V * H * W pixels in all; nothing here depends
on the number of texels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture, scene
from svu_mi.capture.poses import describe, film_size
from svu_mi.errors import CaptureError
from svu_mi.interop import owned
from svu_mi.radiance.silhouette import interior

CAMERA_FLOATS = 16  # rows x, y, w of the projection (4 each), position (3), near clip


@dataclass(frozen=True)
class Views:
    """The V views of a capture that may be used.

    Attributes:
        cameras: (V * 16,) Float: projection rows x, y, w (pixels of the crop window, times
            depth), position in world space, near clip as a depth.
        width, height: (V,) UInt32, size of each photograph in pixels.
        offset: (V,) UInt32, index of each photograph's first pixel.
        pixels: (3 P,) Float, interleaved RGB radiance of all photographs; NaN = not usable.
        usable: (P,) Bool, the pixel shows nothing but the object and holds a radiance.
        count: V, an opaque UInt32, so that its value is not part of a kernel.
        number: V as a Python int.
        scene: the ``mi.Scene`` that visibility is traced in.
    """

    cameras: Any
    width: Any
    height: Any
    offset: Any
    pixels: Any
    usable: Any
    count: Any
    number: int
    scene: Any


def pack_views(capture: Capture) -> Views:
    """Lay the used views of a capture out for the gather kernels."""
    kept = [index for index in range(capture.count) if capture.used[index]]
    sensors = [capture.sensors[index] for index in kept]
    sizes = np.array([film_size(sensor) for sensor in sensors], np.uint32).reshape(-1, 2)
    pixels_per_view = sizes[:, 0].astype(np.int64) * sizes[:, 1]
    offset = np.concatenate([[0], np.cumsum(pixels_per_view)])
    if offset[-1] * 3 >= 2**32:
        raise CaptureError(
            f"The photographs have {offset[-1]} pixels in all, but 32-bit indices reach only "
            f"{2**32 // 3}: reduce their resolution."
        )
    usable = np.zeros(offset[-1], bool)
    pixels = np.zeros((offset[-1], 3), np.float32)
    for slot, index in enumerate(kept):
        span = slice(offset[slot], offset[slot + 1])
        image, mask = capture.images[index], capture.masks[index]
        pixels[span] = image.reshape(-1, 3)
        good = interior(capture.scene, capture.shape, sensors[slot]).numpy()
        if mask is not None:
            good = good & mask.ravel()
        usable[span] = good & np.isfinite(pixels[span]).all(axis=-1)
    return Views(
        cameras=owned(mi.Float, np.array([_camera(s) for s in sensors], np.float32).ravel()),
        width=owned(mi.UInt32, sizes[:, 0]),
        height=owned(mi.UInt32, sizes[:, 1]),
        offset=owned(mi.UInt32, offset[:-1].astype(np.uint32)),
        # The two large arrays stay where they are; they are only looked up, never streamed.
        pixels=mi.Float(pixels.ravel()),
        usable=mi.Bool(usable),
        count=dr.opaque(mi.UInt32, len(kept)),
        number=len(kept),
        scene=capture.scene,
    )


def _camera(sensor: Any) -> np.ndarray:
    """Return the 16 floats of one view (see ``Views.cameras``)."""
    width, height = film_size(sensor)
    to_world = scene.to_world(sensor)
    projection = np.array(sensor.projection_transform().matrix, np.float64).reshape(4, 4)
    # Mitsuba projects to [0, 1]^2 of the crop window; row 2 is depth, which is not needed. The
    # principal point, in units of the full film, is not part of that projection.
    pixel = np.diag([width, height, 1.0, 1.0])
    record = describe(sensor)
    for axis in range(2):
        pixel[axis, 3] = -record["principal_point_offset"][axis] * record["film"][axis]
    world_to_pixel = pixel @ projection @ np.linalg.inv(to_world)
    return np.concatenate(
        [
            world_to_pixel[0],
            world_to_pixel[1],
            world_to_pixel[3],
            to_world[:3, 3],
            [float(sensor.near_clip())],
        ]
    )
