"""Small copies of the photographs, looked at from wherever a hypothesis says they were taken."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.rays import RAY_FLOATS
from svu_mi.capture.scene import to_world
from svu_mi.errors import CaptureError
from svu_mi.formats.resampling import squared
from svu_mi.formats.source import frame_of
from svu_mi.interop import evenly_spaced, owned
from svu_mi.visibility.views import CAMERA_FLOATS, Views, pack_views

POSE = slice(8, 20)  # where ``ray_floats`` keeps three rows of to_world
ROWS = slice(0, 12)  # where ``Views.cameras`` keeps three rows of the projection
POSITION = slice(12, 15)  # and the camera


@dataclass(frozen=True)
class Frames:
    """The V photographs that are used of a reduced capture, as kernels look them up.

    Attributes:
        capture: see ``reduced``.
        views: the same packed; pixels on silhouettes are among them.
        poses: (V, 4, 4) float64, camera to world.
    """

    capture: Capture
    views: Views
    poses: np.ndarray

    @staticmethod
    def of(capture: Capture) -> Frames:
        """Pack a reduced capture."""
        return Frames(
            capture=capture,
            views=pack_views(capture, silhouettes=True),
            poses=np.array([to_world(sensor) for sensor in capture.used_sensors]),
        )

    @property
    def radiance(self) -> list[np.ndarray]:
        """V arrays (h, w, 3) float32, NaN where no pixel can be used."""
        return list(compress(self.capture.images, self.capture.used))

    @property
    def masks(self) -> list[np.ndarray | None]:
        """V arrays (h, w) bool, or None."""
        return list(compress(self.capture.masks, self.capture.used))

    @property
    def spread(self) -> float:
        """Variance of the tone-mapped photographs."""
        values = np.concatenate([image.reshape(-1, 3) for image in self.radiance])
        shown = tone(values[np.isfinite(values).all(axis=1)])
        return float(shown.var(axis=0).mean()) if len(shown) else 0.0

    def posed(self, poses: np.ndarray) -> Frames:
        """Return the same photographs, taken from elsewhere: (V, 4, 4), camera to world."""
        rays = self.views.rays.numpy().reshape(-1, RAY_FLOATS).copy()
        cameras = self.views.cameras.numpy().reshape(-1, CAMERA_FLOATS)
        rays[:, POSE] = poses[:, :3].reshape(-1, 12)
        projections = cameras[:, ROWS].reshape(-1, 3, 4) @ self.poses @ np.linalg.inv(poses)
        cameras = cameras.copy()
        cameras[:, ROWS], cameras[:, POSITION] = projections.reshape(-1, 12), poses[:, :3, 3]
        kind = type(self.views.cameras)
        views = replace(
            self.views, cameras=owned(kind, cameras.ravel()), rays=owned(kind, rays.ravel())
        )
        return replace(self, views=views, poses=poses)


def tone(radiance: np.ndarray) -> np.ndarray:
    """Compress radiance to [0, 1); the unit must be about 1."""
    return radiance / (1 + radiance)


def reduced(capture: Capture, side: int) -> Capture:
    """Return a capture with photographs of at most ``side`` pixels per side, and their sensors.

    Photographs are reduced by whole numbers, so they may end up smaller than ``side``. A pixel is
    the mean over the usable ones of a block, NaN without any; one that is left over at the end of a
    side belongs to none. The median of all pixels that are not black is 1, which is a part of the
    exposures from then on. Photographs that are not used stay as they are.

    Raises:
        CaptureError: no photograph is used.
    """
    if not any(capture.used):
        raise CaptureError(
            f"There is no photograph to check: none of the {capture.count} given can be used."
        )
    sensors, images, masks = list(capture.sensors), list(capture.images), list(capture.masks)
    exposures = list(capture.exposures)
    for index in np.flatnonzero(capture.used):
        sensor, image, mask = sensors[index], images[index], masks[index]
        block = min(-(-max(image.shape) // side), *image.shape[:2])
        frame, _ = squared(frame_of(sensor, Path(capture.names[index])), block)
        sensors[index] = frame.sensor((sensor.near_clip(), sensor.far_clip()))
        images[index] = _usable_mean(image, block)
        if mask is not None and block > 1:
            masks[index] = _mean(mask[..., None], block)[..., 0] >= 0.5
    grey = np.concatenate([image.mean(axis=2).ravel() for image in compress(images, capture.used)])
    lit = grey[grey > 0]  # NaN is not
    unit = np.float32(np.median(lit) if len(lit) else 1)
    for index in np.flatnonzero(capture.used):
        images[index] = images[index] / unit
        exposures[index] = exposures[index] * float(unit)
    return replace(
        capture, sensors=tuple(sensors), images=tuple(images), masks=tuple(masks),
        exposures=tuple(exposures), clipped=(), rounding=(), buffer=None,
    )  # fmt: skip


def some(capture: Capture, most: int) -> Capture:
    """Return the capture with at most so many of its photographs in use, evenly spread."""
    used = np.flatnonzero(capture.used)
    chosen = used[evenly_spaced(len(used), most)]
    return replace(capture, used=tuple(index in chosen for index in range(capture.count)))


def _mean(values: np.ndarray, block: int) -> np.ndarray:
    """Average (H, W, C) over square blocks; what is left over at the end of a side is left out."""
    height, width = (length // block for length in values.shape[:2])
    blocks = values[: height * block, : width * block].reshape(height, block, width, block, -1)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def _usable_mean(image: np.ndarray, block: int) -> np.ndarray:
    usable = np.isfinite(image).all(axis=2, keepdims=True)
    share = _mean(usable, block)
    total = _mean(np.where(usable, image, 0), block)
    return np.where(share > 0, total / np.maximum(share, 1e-30), np.nan).astype(np.float32)
