"""Points of the surface, and what the photographs show there under any poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.mesh import arrays, faces_at, unit_vectors
from svu_mi.checking.frames import Frames
from svu_mi.interop import owned
from svu_mi.visibility.observe import Surface, observe
from svu_mi.visibility.reach import is_open

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

    def surface(self, index: Any) -> Surface:
        """Return some of the points, UInt32 (M,) by their numbers, as the lanes of a kernel."""

        def of(kind: Any, values: np.ndarray) -> Any:
            return dr.gather(kind, owned(mi.Float, values.astype(np.float32).ravel()), index)

        return Surface(
            position=of(mi.Point3f, self.position), normal=of(mi.Normal3f, self.normal),
            geometric_normal=of(mi.Normal3f, self.facing), offset=dr.opaque(mi.Float, self.offset),
        )  # fmt: skip


def scatter_points(mesh: Any, count: int = COUNT) -> Points:
    """Draw points on a mesh, by area; always the same ones."""
    source = arrays(mesh)
    crosses = source.crosses
    random = np.random.default_rng(SEED)
    # Stratified by area: as even as random points get.
    face = faces_at(crosses, (np.arange(count) + random.random(count)) / count)
    a, b = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - a, a * (1 - b), a * b], axis=-1)

    def mixed(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nki->ni", weights, values[source.faces[face]])

    flat = unit_vectors(crosses[face])
    normal = flat if source.normals is None else unit_vectors(mixed(source.normals))
    side = np.where(np.einsum("ni,ni->n", flat, normal) < 0, -1, 1)
    return Points(
        position=mixed(source.positions),
        normal=normal,
        facing=flat * side[:, None],
        uv=None if source.uvs is None else mixed(source.uvs),
        offset=OFFSET * float(np.linalg.norm(np.ptp(source.positions, axis=0))),
    )


@dataclass(frozen=True)
class Sightings:
    """What V photographs show of N points.

    Attributes:
        seen: (V, N) bool, the point is in the picture, nothing hides it, and its pixels are usable.
        radiance: (V, N, 3) float32; 0 where not seen.
        toward: (V, N, 3) float32, unit directions to the cameras, in the frame of the mesh.
    """

    seen: np.ndarray
    radiance: np.ndarray
    toward: np.ndarray


def look(points: Points, frames: Frames) -> Sightings:
    """Look every point up in every photograph.

    Args:
        points: N of them.
        frames: V photographs; their poses are relative to the mesh as it is in the scene.
    """
    shape = frames.views.number, len(points.position)
    view, point = _pairs(shape)
    surface = points.surface(point)
    found = observe(frames.views, surface, view)
    facing = dr.minimum(found.cosine, dr.dot(surface.geometric_normal, found.direction)) > FACING
    seen = found.seen & facing
    return Sightings(
        seen=seen.numpy().reshape(shape),
        radiance=dr.select(seen, found.radiance, 0).numpy().T.reshape(*shape, 3),
        toward=found.direction.numpy().T.reshape(*shape, 3),
    )


def open_cosines(scene: Any, points: Points, directions: np.ndarray) -> np.ndarray:
    """Trace which light can reach points.

    Args:
        scene: what hides.
        points: N points.
        directions: (K, 3), where light comes from.

    Returns:
        (N, K) float32 cosines at which light arrives, 0 where hidden.
    """
    shape = len(points.position), len(directions)
    point, cell = _pairs(shape)
    surface = points.surface(point)
    toward = owned(mi.Float, directions.astype(np.float32).ravel())
    direction = dr.gather(mi.Vector3f, toward, cell)
    cosine = dr.dot(surface.normal, direction)
    above = (cosine > 0) & (dr.dot(surface.geometric_normal, direction) > 0)
    free = is_open(scene, surface, direction, above, coherent=False)
    return dr.select(free, cosine, 0).numpy().reshape(shape)


def _pairs(shape: tuple[int, int]) -> tuple[Any, Any]:
    """Return row and column of every place of a table, UInt32."""
    place, width = dr.arange(mi.UInt32, shape[0] * shape[1]), dr.opaque(mi.UInt32, shape[1])
    row = place // width
    return row, place - row * width
