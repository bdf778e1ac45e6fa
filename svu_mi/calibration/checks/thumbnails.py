"""Reduced photographs at arbitrary poses, and silhouettes of the mesh in them."""

from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.capture.capture import Capture
from svu_mi.capture.film_rays import RAY_FLOATS, film_ray
from svu_mi.capture.importers.resampling import square_pixel_frame
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.scene import to_world
from svu_mi.capture.tonemap import block_means
from svu_mi.core.arrays import evenly_spaced, to_drjit
from svu_mi.errors import CaptureError
from svu_mi.geometry.packed_views import CAMERA_FLOATS, Views, pack_views

POSE = slice(8, 20)  # three rows of to_world in ``ray_floats``
ROWS = slice(0, 12)  # three rows of the projection in ``Views.cameras``
POSITION = slice(12, 15)  # camera position in ``Views.cameras``


@dataclass(frozen=True)
class Thumbnails:
    """V used photographs of a reduced capture; poses (V, 4, 4) are camera-to-world matrices."""

    capture: Capture
    views: Views
    poses: np.ndarray

    @staticmethod
    def of(capture: Capture) -> "Thumbnails":
        """Collect the used photographs and poses of a reduced capture."""
        return Thumbnails(
            capture=capture,
            views=pack_views(capture, silhouettes=True),
            poses=np.array([to_world(sensor) for sensor in capture.used_sensors]),
        )

    @property
    def radiance(self) -> list[np.ndarray]:
        """V arrays (h, w, 3) float32; NaN for unusable pixels."""
        return list(compress(self.capture.images, self.capture.used))

    @property
    def masks(self) -> list[np.ndarray | None]:
        """V arrays (h, w) bool, or None."""
        return list(compress(self.capture.masks, self.capture.used))

    @property
    def spread(self) -> float:
        """Variance of the tone-mapped photographs."""
        values = np.concatenate([image.reshape(-1, 3) for image in self.radiance])
        shown = tonemapped(values[np.isfinite(values).all(axis=1)])
        return float(shown.var(axis=0).mean()) if len(shown) else 0.0

    def posed(self, poses: np.ndarray) -> "Thumbnails":
        """Return the photographs with other camera-to-world matrices (V, 4, 4)."""
        rays = self.views.rays.numpy().reshape(-1, RAY_FLOATS).copy()
        cameras = self.views.cameras.numpy().reshape(-1, CAMERA_FLOATS).copy()
        projections = cameras[:, ROWS].reshape(-1, 3, 4) @ self.poses @ np.linalg.inv(poses)
        rays[:, POSE] = poses[:, :3].reshape(-1, 12)
        cameras[:, ROWS], cameras[:, POSITION] = projections.reshape(-1, 12), poses[:, :3, 3]
        kind = type(self.views.cameras)
        packed = {"cameras": to_drjit(kind, cameras.ravel()), "rays": to_drjit(kind, rays.ravel())}
        return replace(self, views=replace(self.views, **packed), poses=poses)


def tonemapped(radiance: np.ndarray) -> np.ndarray:
    """Compress radiance to [0, 1); typical values must be about 1."""
    return radiance / (1 + radiance)


def reduce_photographs(capture: Capture, side: int) -> Capture:
    """Reduce photographs and sensors to at most ``side`` pixels per side.

    Reduction factors are integers. A pixel is the mean of the usable pixels of a block, NaN without
    any; incomplete blocks at the borders are dropped. Radiance is divided by its median over
    non-black pixels, and exposures are multiplied by it. Unused photographs are unchanged.
    """
    if not any(capture.used):
        raise CaptureError(
            f"All {capture.count} photographs are unusable; give others with --images."
        )
    sensors, images, masks = list(capture.sensors), list(capture.images), list(capture.masks)
    exposures = list(capture.exposures)
    used = np.flatnonzero(capture.used)
    for index in used:
        sensor, image, mask = sensors[index], images[index], masks[index]
        block = min(-(-max(image.shape) // side), *image.shape[:2])
        frame, _ = square_pixel_frame(frame_of(sensor, Path(capture.names[index])), block)
        sensors[index] = frame.sensor((sensor.near_clip(), sensor.far_clip()))
        images[index] = _usable_mean(image, block)
        if mask is not None and block > 1:
            masks[index] = block_means(mask[..., None], block, block)[..., 0] >= 0.5
    grey = np.concatenate([images[index].mean(axis=2).ravel() for index in used])
    lit = grey[grey > 0]  # NaN is not
    unit = np.float32(np.median(lit) if len(lit) else 1)
    for index in used:
        images[index] = images[index] / unit
        exposures[index] = exposures[index] * float(unit)
    return replace(
        capture, sensors=tuple(sensors), images=tuple(images), masks=tuple(masks),
        exposures=tuple(exposures), clipped=(), rounding=(), buffer=None,
    )  # fmt: skip


def limit_views(capture: Capture, count: int) -> Capture:
    """Keep at most ``count`` evenly spaced used photographs."""
    used = np.flatnonzero(capture.used)
    chosen = used[evenly_spaced(len(used), count)]
    return replace(capture, used=tuple(index in chosen for index in range(capture.count)))


def _usable_mean(image: np.ndarray, block: int) -> np.ndarray:
    """Average the finite pixels of blocks; NaN for blocks without any."""
    usable = np.isfinite(image).all(axis=2, keepdims=True)
    share = block_means(usable, block, block)
    total = block_means(np.where(usable, image, 0), block, block)
    return np.where(share > 0, total / np.maximum(share, 1e-30), np.nan).astype(np.float32)


def silhouettes(frames: Thumbnails) -> list[np.ndarray]:
    """Trace masks of the object, V arrays (h, w) bool, through pixel centres."""
    shapes = [image.shape[:2] for image in frames.radiance]
    counts = [height * width for height, width in shapes]
    row, column = np.concatenate([np.indices(s).reshape(2, -1) for s in shapes], axis=1) + 0.5
    ray = film_ray(
        frames.views.rays,
        to_drjit(mi.UInt32, np.repeat(np.arange(len(shapes), dtype=np.uint32), counts)),
        to_drjit(mi.Float, column.astype(np.float32)),
        to_drjit(mi.Float, row.astype(np.float32)),
    )
    hit = frames.capture.scene.ray_intersect_preliminary(ray, coherent=True)
    # Opaque, as a literal would need one kernel per scene.
    seen = hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, frames.capture.shape))
    parts = np.split(np.broadcast_to(np.array(seen, bool), sum(counts)), np.cumsum(counts)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def overlap(seen: np.ndarray, mask: np.ndarray) -> float:
    """Return intersection over union of two (h, w) masks; 1 if both are empty."""
    union = (seen | mask).sum()
    return float((seen & mask).sum() / union) if union else 1.0


def outline(seen: np.ndarray) -> np.ndarray:
    """Return flags (h, w) of object pixels with a neighbour outside the object."""
    return np.asarray(seen & ~scipy.ndimage.binary_erosion(seen, border_value=1))


def contrast(radiance: np.ndarray) -> np.ndarray:
    """Return the gradient rank in [0, 1] of each pixel (h, w); NaN marks unusable pixels."""
    grey = np.nan_to_num(radiance.mean(axis=2), nan=np.nanmax(radiance, initial=0))
    # The mean counts, too: the median of a dark background would turn its noise to white.
    shown = grey / (grey + max(float(np.median(grey)), 0.2 * float(grey.mean()), 1e-12))
    gradient = np.hypot(*np.gradient(shown)) if min(shown.shape) > 1 else np.zeros(shown.shape)
    rank = np.searchsorted(np.sort(gradient.ravel()), gradient, side="left")
    return rank / gradient.size
