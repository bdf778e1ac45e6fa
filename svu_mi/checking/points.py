"""Points of the surface, and what the photographs show there under any poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.mesh import arrays
from svu_mi.checking.frames import Frames
from svu_mi.interop import owned

COUNT = 2000
SEED = 6151
FACING = 0.25  # cosine from which a point is seen: towards the rim pixels mix with the background
OFFSET = 1e-4  # of the object's size, that rays start above the surface


@dataclass(frozen=True)
class Points:
    """N points, evenly spread over the surface of a mesh.

    Attributes:
        position: (N, 3) float64.
        normal: (N, 3) float64, unit shading normals.
        facing: (N, 3) float64, unit face normals on the side of the shading normals.
        uv: (N, 2) float64, or None when the mesh has none.
        offset: distance from the surface that rays start at.
    """

    position: np.ndarray
    normal: np.ndarray
    facing: np.ndarray
    uv: np.ndarray | None
    offset: float


def scatter_points(mesh: Any, count: int = COUNT) -> Points:
    """Draw points on a mesh, by area; always the same ones."""
    source = arrays(mesh)
    corners = source.positions[source.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    random = np.random.default_rng(SEED)
    # Stratified by area: as even as random points get.
    place = (np.arange(count) + random.random(count)) / count
    total = np.cumsum(length)
    face = np.minimum(np.searchsorted(total, place * total[-1], side="right"), len(length) - 1)
    a, b = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - a, a * (1 - b), a * b], axis=-1)

    def mixed(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nki->ni", weights, values[source.faces[face]])

    flat = cross[face] / length[face, None]
    normal = flat if source.normals is None else _unit(mixed(source.normals))
    side = np.where(np.einsum("ni,ni->n", flat, normal) < 0, -1, 1)
    return Points(
        position=mixed(source.positions),
        normal=normal,
        facing=flat * side[:, None],
        uv=None if source.uvs is None else mixed(source.uvs),
        offset=OFFSET * float(np.linalg.norm(np.ptp(source.positions, axis=0))),
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


@dataclass(frozen=True)
class Sightings:
    """What V photographs show of N points.

    Attributes:
        seen: (V, N) bool, the point is in the picture, nothing hides it, and its pixel is usable.
        radiance: (V, N, 3) float32; 0 where not seen.
        toward: (V, N, 3) float64, unit directions to the cameras, in the frame of the mesh.
    """

    seen: np.ndarray
    radiance: np.ndarray
    toward: np.ndarray


def look(capture: Capture, points: Points, frames: Frames) -> Sightings:
    """Look every point up in every photograph.

    Args:
        capture: its scene hides points.
        points: N of them.
        frames: V photographs; their poses are relative to the mesh as it is in the scene.
    """
    ray = frames.poses[:, None, :3, 3] - points.position
    distance = np.linalg.norm(ray, axis=-1)
    toward = ray / np.maximum(distance, 1e-12)[..., None]
    pixel, depth = frames.project(points.position)
    inside = (depth > 0) & (pixel >= 0).all(-1) & (pixel < frames.size[:, None]).all(-1)
    front = np.einsum("vni,ni->vn", toward, points.normal) > FACING
    front &= np.einsum("vni,ni->vn", toward, points.facing) > FACING
    seen = inside & front
    seen[seen] = _open(capture.scene, points, np.nonzero(seen)[1], toward[seen], distance[seen])
    radiance = np.zeros((*seen.shape, 3), np.float32)
    for view, image in enumerate(frames.radiance):
        scale = np.array(image.shape[1::-1]) / frames.size[view]
        column, row = (pixel[view, seen[view]] * scale).astype(int).T
        values = image[row, column]
        mask = frames.masks[view]
        good = np.isfinite(values).all(-1) & (True if mask is None else mask[row, column])
        radiance[view, seen[view]] = np.where(good[:, None], values, 0)
        seen[view, seen[view]] = good
    return Sightings(seen=seen, radiance=radiance, toward=toward)


def _open(
    scene: Any, points: Points, index: np.ndarray, toward: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """Return which rays (M,) from points of these indices meet nothing."""
    if len(index) == 0:
        return np.zeros(0, bool)
    origin = points.position[index] + points.offset * points.facing[index]
    ray = mi.Ray3f(
        owned(mi.Point3f, origin.T.astype(np.float32)),
        owned(mi.Vector3f, toward.T.astype(np.float32)),
        owned(mi.Float, (distance - 2 * points.offset).astype(np.float32)),
        0.0,
        [],
    )
    return ~np.broadcast_to(np.array(scene.ray_test(ray), bool), len(index))
