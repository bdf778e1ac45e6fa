"""The light as a few directions that visibility can be traced in.

The sphere is split into N equal cells around a spherical Fibonacci lattice [Swinbank and
Purser 2006]. A cell is traced in the direction that its light comes from, the centroid of its
radiance: a sun is in the shadow of whatever hides the sun, not of what hides the middle of
its cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from svu_mi.interop import owned
from svu_mi.radiance import environment as env
from svu_mi.radiance.environment import Environment


@dataclass(frozen=True)
class LightCells:
    """N cells that cover the sphere.

    Attributes:
        directions: (3 N,) Float, unit world directions, from the surface to the light.
        flux: (3 N,) Float RGB, radiance integrated over the cell's solid angle.
        centers: (3 N,) Float, unit world directions of the cells' middles.
        count: N, an opaque UInt32.
    """

    directions: Any
    flux: Any
    centers: Any
    count: Any


def light_cells(environment: Environment, count: int) -> LightCells:
    """Gather an environment into cells.

    Args:
        environment: the light.
        count: number of cells N.
    """
    centers = fibonacci(count)
    rows, columns = environment.radiance.shape[:2]
    local = env.directions(columns, rows).reshape(-1, 3)
    solid = np.repeat(env.quadrature(rows) * (2 * np.pi / columns), columns)
    nodes = np.concatenate([local, environment.disk_directions])
    solid = np.concatenate([solid, environment.disk_weights])
    radiance = np.concatenate([environment.radiance.reshape(-1, 3), environment.disk_radiance])
    nearest = cKDTree(centers).query(nodes, workers=-1)[1]
    flux = _sum(nearest, radiance * solid[:, None], count)
    pull = _sum(nearest, nodes * (radiance.sum(axis=1) * solid)[:, None], count)
    length = np.linalg.norm(pull, axis=1, keepdims=True)
    # A black cell has no centroid, and needs none for its light; its centre serves the shape.
    toward = np.where(length > 1e-12 * length.max(), pull / np.maximum(length, 1e-300), centers)
    return LightCells(
        directions=owned(mi.Float, (toward @ environment.to_local).ravel()),
        flux=owned(mi.Float, flux.ravel()),
        centers=owned(mi.Float, (centers @ environment.to_local).ravel()),
        count=dr.opaque(mi.UInt32, count),
    )


def fibonacci(count: int) -> np.ndarray:
    """Return (count, 3) unit directions, evenly spread over the sphere."""
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    azimuth = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(azimuth), z, r * np.sin(azimuth)], axis=-1)


def _sum(cell: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    return np.stack(
        [np.bincount(cell, weights=values[:, k], minlength=count) for k in range(3)], axis=-1
    )
