"""Small copies of the photographs, and rays through their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.poses import describe
from svu_mi.capture.scene import to_world
from svu_mi.errors import CaptureError
from svu_mi.visibility.rays import ray_floats

POSE = slice(8, 20)  # where ``ray_floats`` keeps three rows of to_world


@dataclass(frozen=True)
class Frames:
    """V photographs, reduced.

    Attributes:
        radiance: V arrays (h, w, 3) float32, mean over the usable pixels of a block, NaN
            without any; the median of all pixels that are not black is 1.
        masks: V arrays (h, w) bool or None.
        size: (V, 2) float64, (width, height) of the films in their own pixels.
        lenses: (V, 24) float32, see ``ray_floats``.
        poses: (V, 4, 4) float64, camera to world.
        views: V indices into the capture's.
    """

    radiance: tuple[np.ndarray, ...]
    masks: tuple[np.ndarray | None, ...]
    size: np.ndarray
    lenses: np.ndarray
    poses: np.ndarray
    views: tuple[int, ...]

    @property
    def count(self) -> int:
        """Number of views V."""
        return len(self.views)

    @cached_property
    def spread(self) -> float:
        """Variance of the tone-mapped photographs."""
        values = np.concatenate([image.reshape(-1, 3) for image in self.radiance])
        shown = tone(values[np.isfinite(values).all(axis=1)])
        return float(shown.var(axis=0).mean()) if len(shown) else 0.0

    @property
    def masked(self) -> np.ndarray:
        """(V,) bool, whether a view has a mask with anything in it."""
        return np.array([mask is not None and bool(mask.any()) for mask in self.masks], bool)

    def some(self, chosen: Sequence[int]) -> Frames:
        """Return only some of the views."""
        rows = list(chosen)
        return Frames(
            radiance=tuple(self.radiance[i] for i in rows),
            masks=tuple(self.masks[i] for i in rows),
            size=self.size[rows],
            lenses=self.lenses[rows],
            poses=self.poses[rows],
            views=tuple(self.views[i] for i in rows),
        )

    def posed(self, poses: np.ndarray) -> Frames:
        """Return the same photographs, taken from elsewhere."""
        lenses = self.lenses.copy()
        lenses[:, POSE] = poses[:, :3].reshape(-1, 12)
        return replace(self, poses=poses, lenses=lenses)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (N, 3).

        Returns:
            (V, N, 2) pixels of the films, and (V, N) depths; behind the camera these are negative.
        """
        inverse = np.linalg.inv(self.poses)
        local = points @ inverse[:, :3, :3].transpose(0, 2, 1) + inverse[:, None, :3, 3]
        depth = local[..., 2]
        lens = self.lenses[:, None, :].astype(np.float64)
        slope = local[..., :2] / np.where(depth == 0, 1e-30, depth)[..., None]
        part = (slope * lens[..., 4:5] - lens[..., [1, 3]]) / lens[..., [0, 2]] - lens[..., 6:8]
        return part * self.size[:, None], depth


def tone(radiance: np.ndarray) -> np.ndarray:
    """Compress radiance to [0, 1); the unit must be about 1."""
    return radiance / (1 + radiance)


def reduced(capture: Capture, side: int) -> Frames:
    """Reduce the photographs that are used to at most ``side`` pixels per side.

    Raises:
        CaptureError: none is used.
    """
    views = [index for index in range(capture.count) if capture.used[index]]
    if not views:
        raise CaptureError(
            f"There is no photograph to check: {capture.count} were given, and none can be used."
        )
    radiance, masks = [], []
    for index in views:
        image, mask = capture.images[index], capture.masks[index]
        edges = [_edges(length, max(image.shape[:2]), side) for length in image.shape[:2]]
        radiance.append(_mean(image, edges))
        masks.append(None if mask is None else _share(mask, edges) >= 0.5)
    sensors = [capture.sensors[index] for index in views]
    offsets = [describe(sensor)["principal_point_offset"] for sensor in sensors]
    unit = _unit(radiance)
    return Frames(
        radiance=tuple(image / unit for image in radiance),
        masks=tuple(masks),
        size=np.array([image.shape[1::-1] for image in (capture.images[v] for v in views)], float),
        lenses=np.array([ray_floats(*pair) for pair in zip(sensors, offsets, strict=True)]),
        poses=np.array([to_world(sensor) for sensor in sensors]),
        views=tuple(views),
    )


def _unit(images: Sequence[np.ndarray]) -> np.float32:
    grey = np.concatenate([image.mean(axis=2).ravel() for image in images])
    lit = grey[grey > 0]  # NaN is not
    return np.float32(np.median(lit) if len(lit) else 1)


def _edges(length: int, longest: int, side: int) -> np.ndarray:
    """Where the blocks of pixels along one side of a photograph begin."""
    blocks = max(1, min(length, round(length * side / longest)))
    return np.arange(blocks) * length // blocks


def _mean(image: np.ndarray, edges: Sequence[np.ndarray]) -> np.ndarray:
    usable = np.isfinite(image).all(axis=2)
    total = block_sums(np.where(usable[..., None], image, 0), edges)
    count = block_sums(usable.astype(np.float32), edges)[..., None]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _share(mask: np.ndarray, edges: Sequence[np.ndarray]) -> np.ndarray:
    whole = block_sums(np.ones(mask.shape, np.float32), edges)
    return block_sums(mask.astype(np.float32), edges) / whole


def block_sums(values: np.ndarray, edges: Sequence[np.ndarray]) -> np.ndarray:
    """Return the sums over blocks of an image (H, W, ...), which begin at rows and columns."""
    return np.add.reduceat(np.add.reduceat(values, edges[0], axis=0), edges[1], axis=1)
