"""The light as a few directions that visibility can be traced in.

The sphere is split into N equal cells around a spherical Fibonacci lattice [Swinbank and
Purser 2006]. A cell is traced in the direction that its light comes from, the centroid of its
radiance: a sun is in the shadow of whatever hides the sun, not of what hides the middle of
its cell.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from svu_mi.interop import owned
from svu_mi.radiance import environment as env
from svu_mi.radiance.environment import Environment

FINE = 4096  # even cells that adaptive ones are made of; 0.06 rad apart
FLOOR = 0.05  # weight of a cell without light, in that of the mean cell


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
    return _cells(*_gathered(environment, count), environment)


def adaptive_cells(environment: Environment, count: int) -> LightCells:
    """Gather an environment into cells that are small where the light is bright.

    Even cells are merged into clusters: of all clusters, that with the largest spread of its
    radiance, sum L |w - mean|^2, is split next [Wu 1991, for colours].

    Args:
        environment: the light.
        count: number of cells N; no more than ``FINE``.
    """
    flux, pull, centers = _gathered(environment, FINE)
    light = flux.sum(axis=1)
    weight = light + FLOOR * light.mean() + 1e-300  # without any light, even cells
    cluster = _split(pull / np.maximum(np.linalg.norm(pull, axis=1, keepdims=True), 1e-300),
                     weight, count)  # fmt: skip
    flux, pull, centers = (_sum(cluster, values, count) for values in (flux, pull, centers))
    centers /= np.maximum(np.linalg.norm(centers, axis=1, keepdims=True), 1e-300)
    return _cells(flux, pull, centers, environment)


def _gathered(
    environment: Environment, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flux, radiance-weighted sum of directions, and middle of even cells: (N, 3) each."""
    centers = fibonacci(count)
    rows, columns = environment.radiance.shape[:2]
    local = env.directions(columns, rows).reshape(-1, 3)
    on_disk = cKDTree(centers).query(environment.disk_directions)[1]
    nearest = np.concatenate([_nearest(columns, rows, count), on_disk])
    solid = np.repeat(env.quadrature(rows) * (2 * np.pi / columns), columns)
    nodes = np.concatenate([local, environment.disk_directions])
    solid = np.concatenate([solid, environment.disk_weights])
    radiance = np.concatenate([environment.radiance.reshape(-1, 3), environment.disk_radiance])
    flux = _sum(nearest, radiance * solid[:, None], count)
    pull = _sum(nearest, nodes * (radiance.sum(axis=1) * solid)[:, None], count)
    length = np.linalg.norm(pull, axis=1, keepdims=True)
    # A black cell has no centroid, and needs none for its light; its centre serves the shape.
    return flux, np.where(length > 1e-12 * length.max(), pull, 1e-12 * centers), centers


@lru_cache(maxsize=4)
def _nearest(columns: int, rows: int, count: int) -> np.ndarray:
    """(columns * rows,) the cell of every node of a map; kept, as all maps of a size share it."""
    nodes = env.directions(columns, rows).reshape(-1, 3)
    return cKDTree(fibonacci(count)).query(nodes, workers=-1)[1]


def _cells(
    flux: np.ndarray, pull: np.ndarray, centers: np.ndarray, environment: Environment
) -> LightCells:
    toward = pull / np.maximum(np.linalg.norm(pull, axis=1, keepdims=True), 1e-300)
    return LightCells(
        directions=owned(mi.Float, (toward @ environment.to_local).ravel()),
        flux=owned(mi.Float, flux.ravel()),
        centers=owned(mi.Float, (centers @ environment.to_local).ravel()),
        count=dr.opaque(mi.UInt32, len(flux)),
    )


def _split(points: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """Return the cluster of each of N weighted points, by splitting the widest again and again."""
    label = np.zeros(len(points), np.int64)
    heap = [(-np.inf, 0, np.arange(len(points)))]
    for new in range(1, count):
        _, old, members = heapq.heappop(heap)
        axis, spread = _main_axis(points[members], weight[members])
        far = spread > 0
        label[members[far]] = new
        for number, part in ((old, members[~far]), (new, members[far])):
            size = _variance(points[part], weight[part])
            heapq.heappush(heap, (-size, number, part))
    return label


def _main_axis(points: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction of largest variance, and where the points lie along it."""
    offset = points - np.average(points, axis=0, weights=weight)
    axis = np.linalg.eigh((offset * weight[:, None]).T @ offset)[1][:, -1]
    along = offset @ axis
    # Equal points would all fall on one side.
    return axis, along if (along > 0).any() and (along <= 0).any() else np.arange(len(points)) - 0.5


def _variance(points: np.ndarray, weight: np.ndarray) -> float:
    if len(points) < 2:
        return 0.0
    offset = points - np.average(points, axis=0, weights=weight)
    return float((offset**2).sum(axis=1) @ weight)


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
