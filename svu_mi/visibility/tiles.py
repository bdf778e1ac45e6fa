"""The squares of all films that can show the object: the work list of the silhouettes.

A tile is a square of TILE x TILE pixel corners, and of the pixels between them, one fewer each
way. Only tiles that the object's projected bounding box and the photograph's mask reach are
listed; no other pixel can be a measurement of the object.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

TILE = 32  # corners per side, a power of two: lanes of a kernel are split into tiles by shifts
MARGIN = 1  # pixels around the projected box: its projection is rounded


def find_tiles(
    projections: np.ndarray,
    near: np.ndarray,
    sizes: np.ndarray,
    bounds: np.ndarray,
    masks: Sequence[np.ndarray | None],
) -> np.ndarray:
    """List the tiles of V views.

    Args:
        projections: (V, 3, 4), world space to (x * depth, y * depth, depth), in pixels.
        near: (V,) near clip of each view, as a depth.
        sizes: (V, 2) width and height of each photograph.
        bounds: (2, 3) least and greatest corner of the object's bounding box, world space.
        masks: V arrays (H, W) bool, True where a pixel may be used, or None for all of them.

    Returns:
        (N, 3) uint32: view, column and row of the first pixel. Tiles do not share pixels.
    """
    windows = _windows(projections, near, sizes, bounds)
    found = [
        _tiles_of(view, window, mask)
        for view, (window, mask) in enumerate(zip(windows, masks, strict=True))
    ]
    return np.concatenate([np.zeros((0, 3), np.uint32), *found])


def _windows(
    projections: np.ndarray, near: np.ndarray, sizes: np.ndarray, bounds: np.ndarray
) -> np.ndarray:
    """Return (V, 2, 2) int: first pixel and end of the box's projection, each (x, y)."""
    corners = np.stack(np.meshgrid(*bounds.T, [1.0], indexing="ij"), axis=-1).reshape(8, 4)
    points = np.einsum("vij,cj->vci", projections, corners)
    in_front = (points[..., 2] > near[:, None]).all(axis=1)
    depth = np.where(in_front[:, None], points[..., 2], 1.0)
    pixels = points[..., :2] / depth[..., None]
    # A box that reaches behind the camera can be anywhere on the film.
    first = np.where(in_front[:, None], np.floor(pixels.min(axis=1)) - MARGIN, 0)
    end = np.where(in_front[:, None], np.ceil(pixels.max(axis=1)) + MARGIN, sizes)
    return np.clip(np.stack([first, end], axis=1), 0, sizes[:, None]).astype(np.int64)


def _tiles_of(view: int, window: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return (N, 3) uint32, the tiles of one view."""
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
