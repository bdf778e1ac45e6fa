"""Interior pixels: pixels that are not at a silhouette of the object.

A pixel is interior if rays through its four corners hit the object at distances that are consistent
with a smooth surface. Rays of many views share a kernel launch. A tile is a square of TILE x TILE
pixel corners; the 16 lanes of a packet are 4 x 4 neighbouring corners. Only tiles within the
object's projected bounding box and the photograph's mask are traced.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.film_rays import film_ray
from svu_mi.capture.mesh import face_normals
from svu_mi.core.arrays import to_drjit

TILE = 32  # corners per side; a power of two, because lanes are split by bit shifts
MARGIN = 1  # pixels around the projected bounding box, for rounding errors
SLOPE_MARGIN = 3.0  # largest slope of a smooth surface, relative to its tangent plane
MIN_COSINE = 0.05  # lower bound of the cosine, which limits slopes at grazing angles
BLOCK = 1024  # tiles per launch: 1 M rays, 8 MiB


@dataclass(frozen=True, kw_only=True)
class Films:
    """Pixel layout of V views, and the rays through the pixels.

    Attributes:
        offset: (V,) UInt32, index of each view's first pixel.
        angle: (V,) Float, radians between neighbouring pixels at the film's centre.
        rays: (V * 24,) Float, see ``ray_floats``.
    """

    width: Any
    height: Any
    offset: Any
    angle: Any
    rays: Any


@dataclass(frozen=True)
class Outline:
    """Lazy test for interior pixels of an object in V views."""

    target: Any
    films: Films

    def encloses(self, scene: Any, view: Any, pixel: Any, active: Any) -> Any:
        """Return whether ``pixel`` and those to its right and below are interior (nine rays)."""
        films = self.films
        width = dr.gather(mi.UInt32, films.width, view)
        place = pixel - dr.gather(mi.UInt32, films.offset, view)
        row = place // dr.maximum(width, 1)  # the width is 0 in inactive lanes
        column = place - row * width

        def corner(i: int, j: int) -> tuple[Any, Any]:
            ray = film_ray(films.rays, view, mi.Float(column + i), mi.Float(row + j))
            return _trace(scene, self.target, ray, active)

        hits = {(i, j): corner(i, j) for i in range(3) for j in range(3)}
        angle = SLOPE_MARGIN * dr.gather(mi.Float, films.angle, view)
        for i, j in product(range(2), range(2)):
            corners = [hits[i + k, j + m] for m in (0, 1) for k in (0, 1)]
            near, far = _extremes([distance for distance, _ in corners])
            least, _ = _extremes([slope for _, slope in corners])
            active &= dr.isfinite(far) & _is_explained(far - near, angle * far, least)
        return active


def find_tiles(
    projections: np.ndarray,
    near: np.ndarray,
    sizes: np.ndarray,
    bounds: np.ndarray,
    masks: Sequence[np.ndarray | None],
) -> np.ndarray:
    """Return tiles that may show the object: view, first column, first row; (N, 3)."""
    windows = _windows(projections, near, sizes, bounds)
    of_views = [
        _tiles_of(view, window, mask)
        for view, (window, mask) in enumerate(zip(windows, masks, strict=True))
    ]
    return np.concatenate([np.zeros((0, 3), np.uint32), *of_views])


def _windows(
    projections: np.ndarray, near: np.ndarray, sizes: np.ndarray, bounds: np.ndarray
) -> np.ndarray:
    """Return first pixel and end, each (x, y), of the projected box: (V, 2, 2) int64."""
    corners = np.stack(np.meshgrid(*bounds.T, [1.0], indexing="ij"), axis=-1).reshape(8, 4)
    points = np.einsum("vij,cj->vci", projections, corners)
    in_front = (points[..., 2] > near[:, None]).all(axis=1)
    depth = np.where(in_front[:, None], points[..., 2], 1.0)
    pixels = points[..., :2] / depth[..., None]
    # The projection of a box that is partly behind the camera is unbounded.
    first = np.where(in_front[:, None], np.floor(pixels.min(axis=1)) - MARGIN, 0)
    end = np.where(in_front[:, None], np.ceil(pixels.max(axis=1)) + MARGIN, sizes)
    return np.clip(np.stack([first, end], axis=1), 0, sizes[:, None]).astype(np.int64)


def _tiles_of(view: int, window: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return the tiles of one view, (N, 3) uint32."""
    (left, top), (right, bottom) = window
    columns, rows = np.arange(left, right, TILE - 1), np.arange(top, bottom, TILE - 1)
    if not (columns.size and rows.size):
        return np.zeros((0, 3), np.uint32)
    reached = np.ones((rows.size, columns.size), bool)
    if mask is not None:
        inside = mask[top:bottom, left:right].view(np.uint8)
        by_row = np.maximum.reduceat(inside, rows - top, axis=0)
        reached = np.maximum.reduceat(by_row, columns - left, axis=1) > 0
    row, column = np.nonzero(reached)
    return np.stack([np.full(row.size, view), columns[column], rows[row]], axis=1).astype(np.uint32)


def interior(scene: Any, target: Any, films: Films, tiles: np.ndarray) -> Iterator[tuple[Any, Any]]:
    """Yield pixel indices (UInt32), and whether they are interior; each pixel occurs once."""
    for start in range(0, len(tiles), BLOCK):
        block = tiles[start : start + BLOCK]
        table = to_drjit(mi.UInt32, np.pad(block, ((0, 0), (0, 1))).ravel())
        lane = dr.arange(mi.UInt32, len(block) * TILE * TILE)
        column, row = _corner(lane & (TILE * TILE - 1))
        view, left, top, _ = dr.gather(mi.Vector4u, table, lane // (TILE * TILE))
        width = dr.gather(mi.UInt32, films.width, view)
        height = dr.gather(mi.UInt32, films.height, view)
        x, y = left + column, top + row
        ray = film_ray(films.rays, view, mi.Float(x), mi.Float(y))
        hit = _trace(scene, target, ray, (x <= width) & (y <= height))
        dr.eval(hit)
        corners = [_lane(lane, column + i, row + j) for j in (0, 1) for i in (0, 1)]
        pixel = (column < TILE - 1) & (row < TILE - 1) & (x < width) & (y < height)
        angle = SLOPE_MARGIN * dr.gather(mi.Float, films.angle, view, pixel)
        index = dr.gather(mi.UInt32, films.offset, view, pixel) + y * width + x
        yield index, _is_smooth(hit, corners, angle, pixel)
        del hit  # frees memory before the next block


def _corner(lane: Any) -> tuple[Any, Any]:
    """Return column and row of a lane's pixel corner in its tile."""
    high = TILE - 4
    return (lane & 3) | ((lane >> 2) & high), ((lane >> 2) & 3) | ((lane >> 5) & high)


def _lane(lane: Any, column: Any, row: Any) -> Any:
    """Return the lane of the corner (column, row) in the tile of ``lane``."""
    high = TILE - 4
    first = lane - (lane & (TILE * TILE - 1))
    low_bits = (column & 3) | ((row & 3) << 2)
    return first | low_bits | ((column & high) << 2) | ((row & high) << 5)


def _trace(scene: Any, target: Any, ray: Any, active: Any) -> tuple[Any, Any]:
    """Return distance along a ray (infinite for a miss), and surface slope."""
    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    # Opaque: a literal would recompile the kernel for every scene.
    on_target = hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, target))
    # A full intersection would compile code for every existing type of shape.
    normal = face_normals(target, hit.prim_index, on_target)
    cosine = dr.maximum(dr.abs(dr.dot(normal, ray.d)), MIN_COSINE)
    slope = dr.safe_sqrt(1 - dr.square(cosine)) / cosine
    return dr.select(on_target, hit.t, dr.inf), slope


def _is_smooth(hit: tuple[Any, Any], corners: list[Any], angle: Any, pixel: Any) -> Any:
    """Return whether a pixel's corners are on one smooth surface."""
    distance, slope = hit
    near, far = _extremes([dr.gather(mi.Float, distance, corner, pixel) for corner in corners])
    depth, reach = far - near, angle * far
    on_object = pixel & dr.isfinite(far)
    steep = on_object & (depth > 0.5 * reach)

    def explained(steep: Any, corners: list[Any]) -> Any:
        slopes = [dr.gather(mi.Float, slope, corner, steep) for corner in corners]
        return _is_explained(depth, reach, _extremes(slopes)[0])

    # Most pixels have almost equal distances; only the others need slopes.
    return on_object & dr.if_stmt((steep, corners), steep, explained, lambda *_: mi.Bool(True))


def _is_explained(depth: Any, reach: Any, slope: Any) -> Any:
    """Return whether a surface of this slope can cause a depth difference."""
    return depth <= reach * (0.5 + slope)


def _extremes(values: list[Any]) -> tuple[Any, Any]:
    low = dr.minimum(dr.minimum(values[0], values[1]), dr.minimum(values[2], values[3]))
    high = dr.maximum(dr.maximum(values[0], values[1]), dr.maximum(values[2], values[3]))
    return low, high
