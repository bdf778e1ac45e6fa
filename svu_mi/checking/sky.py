"""The given light, as hypotheses about how it lies look it up."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from svu_mi.checking.frames import block_sums
from svu_mi.checking.points import Points
from svu_mi.interop import owned
from svu_mi.light import environment as env
from svu_mi.light.cells import fibonacci
from svu_mi.light.environment import Environment
from svu_mi.light.levels import convolve, resolved
from svu_mi.reflection.lobes import zonal_profile

CELLS = 256  # directions that visibility is traced in
WIDTHS = (0.06, 0.18, 0.4)  # alpha of the lobes that highlights are compared with
ROWS = 91  # of the maps these are looked up in
COARSE = 64  # rows of blocks that irradiance is summed from


@dataclass(frozen=True)
class Sky:
    """Distant light.

    Attributes:
        flux: (M, 3) radiance times solid angle of blocks of the map.
        toward: (M, 3) unit directions of their light, in the frame of the map.
        maps: (L, ROWS, 2 ROWS, 3) the map under a lobe of each of ``WIDTHS``.
        to_local: (3, 3), from the frame of the mesh to that of the map, as the capture says.
    """

    flux: np.ndarray
    toward: np.ndarray
    maps: np.ndarray
    to_local: np.ndarray

    @staticmethod
    def of(environment: Environment, mesh_turn: np.ndarray) -> Sky:
        """Filter an environment.

        Args:
            environment: the light.
            mesh_turn: (3, 3), by which corrections turn the mesh before it is lit.
        """
        grid = resolved(environment)
        rows, columns = grid.shape[:2]
        solid = (env.quadrature(rows) * (2 * np.pi / columns))[:, None, None]
        local = env.directions(columns, rows)
        weight = grid.sum(axis=2, keepdims=True) * solid
        edges = [np.arange(n) * size // n for n, size in ((COARSE, rows), (2 * COARSE, columns))]
        flux = block_sums(grid * solid, edges)
        pull = block_sums(local * (weight + 1e-9 * weight.max() * solid), edges).reshape(-1, 3)
        profile = partial(zonal_profile, "ggx")
        filtered = (convolve(grid, width, partial(profile, width)) for width in WIDTHS)
        return Sky(
            flux=flux.reshape(-1, 3),
            toward=pull / np.maximum(np.linalg.norm(pull, axis=1, keepdims=True), 1e-300),
            maps=np.stack([_resampled(one) for one in filtered]),
            to_local=environment.to_local @ mesh_turn,
        )

    def arriving(self, directions: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Return (K, 3), the flux around directions (K, 3) of the mesh's frame.

        Args:
            directions: evenly spread.
            matrix: (3, 3), by which a hypothesis turns the map.
        """
        cell = cKDTree(directions @ (matrix.T @ self.to_local).T).query(self.toward)[1]
        count = len(directions)
        return np.stack([np.bincount(cell, self.flux[:, c], count) for c in range(3)], axis=-1)

    def reflected(self, directions: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Return (L, S, 3), the light under lobes around directions (S, 3) of the mesh's frame."""
        local = directions @ (matrix.T @ self.to_local).T
        row, column = env.nearest_node(local, ROWS, 2 * ROWS)
        return self.maps[:, row, column]


def _resampled(grid: np.ndarray) -> np.ndarray:
    """Look a map up at the nodes of one with ``ROWS`` rows, which is fine enough for any lobe."""
    rows, columns = grid.shape[:2]
    row = np.rint(np.linspace(0, rows - 1, ROWS)).astype(int)
    column = ((np.arange(2 * ROWS) + 0.5) / (2 * ROWS) * columns).astype(int)
    return grid[row][:, column]


def open_cosines(scene: Any, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Trace which light can reach points.

    Args:
        scene: what hides.
        points: N points.

    Returns:
        (K, 3) directions, and (N, K) float32 cosines at which light arrives, 0 where hidden.
    """
    directions = fibonacci(CELLS)
    cosine = points.normal @ directions.T
    index, cell = np.nonzero((cosine > 0) & (points.facing @ directions.T > 0))
    origin = points.position[index] + points.offset * points.facing[index]
    ray = mi.Ray3f(
        owned(mi.Point3f, origin.T.astype(np.float32)),
        owned(mi.Vector3f, directions[cell].T.astype(np.float32)),
        dr.opaque(mi.Float, dr.largest(mi.Float)), 0.0, [],
    )  # fmt: skip
    hidden = np.broadcast_to(np.array(scene.ray_test(ray), bool), len(index))
    result = np.zeros(cosine.shape, np.float32)
    result[index, cell] = np.where(hidden, 0, cosine[index, cell])
    return directions, result
