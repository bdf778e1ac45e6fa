"""Tree of light cells, for visibility and wide lobes.

The ``leaves`` are cells of equal area around a spherical Fibonacci lattice [Swinbank and Purser
2006]. The cluster with the largest spread sum L |w - mean|^2 is split repeatedly [Wu 1991]. The
first splits define the ``coarse`` cells, and all splits the ``fine`` cells.
The direction of a cell is the centroid of its radiance.
"""

import heapq
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.core.arrays import fibonacci, to_drjit
from svu_mi.errors import OptionError
from svu_mi.light import latlong
from svu_mi.light.environment import Environment

LEAF_COUNTS = (4096, 8192)  # leaves for small and large maps; spacing 0.06 and 0.04 rad
FLOOR = 0.05  # weight of a black cell, relative to the mean weight
GROUP = 4  # mean number of coarse cells per group
LARGEST = 32  # largest number of coarse cells per group, and of fine cells per coarse cell
RING = 6  # cells around the central cell of a sun's disk
SPLIT = 8  # local cells per world cell in ``cell_radiance``
DIM = 0.25  # flux threshold of "bright" fine cells, relative to the mean
SIZES = 0.5, 4.0  # least and most factor of the squared sizes of dim and bright cells


@dataclass(frozen=True)
class LightCells:
    """The N cells of one depth of the tree, in tree order.

    Attributes:
        toward: (4 N,) Float: unit world direction to the light, and radius [rad] of a uniform disk
            with the same variance.
        flux: (4 N,) Float: radiance integrated over solid angle: R, G, B and their mean.
        size: (N,) Float: squared radius times a factor, larger for brighter cells, which are
            subdivided earlier; None for cells that are not subdivided.
    """

    toward: Any
    flux: Any
    number: int
    count: Any
    size: Any = None

    def at(self, cell: Any) -> tuple[Any, Any]:
        """Return direction (Vector3f) and radius (Float) of a cell."""
        x, y, z, radius = dr.gather(mi.Vector4f, self.toward, cell)
        return mi.Vector3f(x, y, z), radius

    def light(self, cell: Any, channels: int) -> list[Any]:
        """Return the flux of a cell: R, G and B, or their mean if ``channels`` is 1."""
        *rgb, grey = dr.gather(mi.Vector4f, self.flux, cell)
        return [grey] if channels == 1 else rgb


@dataclass(frozen=True)
class LightTree:
    """Light cells of three depths; children of a cell are contiguous.

    Attributes:
        first: (N_c + 1,) UInt32, index of the first fine cell of each coarse cell.
        first_leaf: (N_f + 1,) UInt32, index of the first leaf of each fine cell.
        groups: (N_g + 1,) UInt32, index of the first coarse cell of each group of neighbours.
        bright: (N_f,) UInt32, 1 for bright fine cells, which may be traced separately.
    """

    coarse: LightCells
    fine: LightCells
    leaves: LightCells
    first: Any
    first_leaf: Any
    groups: Any
    group_count: Any
    bright: Any

    @cached_property
    def every(self) -> LightCells:
        """Cells of all depths: coarse ones, then fine ones, then leaves."""
        depths = self.coarse, self.fine, self.leaves
        toward, flux = (
            to_drjit(mi.Float, np.concatenate([getattr(cells, name).numpy() for cells in depths]))
            for name in ("toward", "flux")
        )
        number = sum(cells.number for cells in depths)
        return LightCells(toward, flux, number, dr.opaque(mi.UInt32, number))


@dataclass(frozen=True)
class _Cluster:
    """M weighted points: offsets from the mean, and scatter matrix."""

    number: int
    members: np.ndarray
    offset: np.ndarray
    covariance: np.ndarray
    variance: float

    @staticmethod
    def of(number: int, points: np.ndarray, weight: np.ndarray, members: np.ndarray) -> "_Cluster":
        """Make a cluster of the points with indices ``members``."""
        w = weight[members]
        own = points[members]
        offset = own - w @ own / w.sum()
        covariance = (offset.T * w) @ offset
        x, y, z = covariance.diagonal().tolist()
        return _Cluster(number, members, offset, covariance, x + y + z if len(own) > 1 else 0.0)

    def __lt__(self, other: "_Cluster") -> bool:
        return self.variance > other.variance

    def far_half(self) -> np.ndarray:
        """Return flags of members beyond the mean along the principal axis."""
        far = self.offset @ np.linalg.eigh(self.covariance)[1][:, -1] > 0
        # Identical points would all be on one side.
        return far if 0 < np.count_nonzero(far) < len(far) else np.arange(len(far)) > 0


def build_light_tree(environment: Environment, coarse: int, fine: int) -> LightTree:
    """Cluster an environment into a tree of coarse and fine cells."""
    if not 1 <= coarse <= fine <= LEAF_COUNTS[0]:
        raise OptionError(
            f"A light tree needs 1 <= coarse <= fine <= {LEAF_COUNTS[0]}, got {coarse} and {fine}."
        )
    nodes = environment.radiance.shape[0] * environment.radiance.shape[1]
    flux, pull = _cell_sums(environment, int(np.clip(nodes // 4, *LEAF_COUNTS)))
    light = flux.sum(axis=1)
    weight = light + FLOOR * light.mean() + 1e-300  # equal weights for a black environment
    points = pull / np.maximum(np.linalg.norm(pull, axis=1, keepdims=True), 1e-300)
    label, parent = _split(points, weight, fine)
    numbers = np.arange(fine)
    while np.bincount(of_coarse := _ancestors(parent, coarse)).max() > LARGEST:
        coarse = min(2 * coarse, fine)
    of_group = _ancestors(parent, max(coarse // GROUP, 1))
    # Tree order: cells with a common ancestor are contiguous.
    order = np.lexsort((numbers, of_coarse, of_group))
    place = np.empty(fine, np.int64)
    place[order] = numbers
    label = place[label]
    leaf = np.argsort(label, kind="stable")
    label, flux, pull = label[leaf], flux[leaf], pull[leaf]
    typical = light.sum() / fine
    below = _cells(_sum(label, flux, fine), _sum(label, pull, fine), environment, typical)
    upper = np.cumsum(np.diff(of_coarse[order], prepend=-1) != 0) - 1  # coarse cell by fine cell
    starts = np.searchsorted(upper, np.arange(coarse + 1))
    leaves = np.searchsorted(label, np.arange(fine + 1))
    label = upper[label]
    above = _cells(_sum(label, flux, coarse), _sum(label, pull, coarse), environment, typical)
    edges = _edges(of_group[order][starts[:-1]])
    grey = below.flux.numpy().reshape(-1, 4)[:, 3]
    return LightTree(
        coarse=above,
        fine=below,
        leaves=_cells(flux, pull, environment),
        first=to_drjit(mi.UInt32, starts.astype(np.uint32)),
        first_leaf=to_drjit(mi.UInt32, leaves.astype(np.uint32)),
        groups=to_drjit(mi.UInt32, edges.astype(np.uint32)),
        group_count=dr.opaque(mi.UInt32, len(edges) - 1),
        bright=to_drjit(mi.UInt32, (grey > DIM * grey.mean()).astype(np.uint32)),
    )


def disk_cells(environment: Environment) -> LightCells | None:
    """Cluster a sun's disk into a few cells; return None without a sun."""
    if not len(environment.disk_weights):
        return None
    flux = environment.disk_radiance * environment.disk_weights[:, None]
    light = flux.sum(axis=1, keepdims=True)
    middle = environment.disk_directions.T @ environment.disk_weights
    offset = environment.disk_directions - middle / np.linalg.norm(middle)
    side = np.linalg.svd(offset, full_matrices=False)[2]
    away, angle = np.linalg.norm(offset, axis=1), np.arctan2(offset @ side[1], offset @ side[0])
    # A central cell and a ring of cells, all of equal area.
    ring = ((angle / (2 * np.pi) + 0.5) * RING).astype(int) % RING
    label = np.where(away <= away.max() / np.sqrt(RING + 1), RING, ring)
    pull = _sum(label, environment.disk_directions * light, RING + 1)
    return _cells(_sum(label, flux, RING + 1), pull, environment)


def _edges(owner: np.ndarray) -> np.ndarray:
    """Return the bounds of runs of equal numbers; runs longer than LARGEST are split."""
    begins = np.flatnonzero(np.diff(owner, prepend=-1) != 0)
    ends = np.append(begins[1:], len(owner))
    cut = [np.arange(a, b, LARGEST) for a, b in zip(begins, ends, strict=True)]
    return np.append(np.concatenate(cut), len(owner))


def _cell_sums(environment: Environment, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return flux and weighted sum of directions of Fibonacci cells."""
    centers = fibonacci(count)
    rows, columns = environment.radiance.shape[:2]
    nearest = _nearest(columns, rows, count)
    solid = latlong.quadrature(rows)[:, None] * (2 * np.pi / columns)
    local, light = latlong.directions(columns, rows), environment.radiance.sum(axis=2) * solid
    sun, disk = environment.disk_directions, environment.disk_radiance
    disk, on_disk = disk * environment.disk_weights[:, None], nearest_cells(sun, count)
    flux = _sum(nearest, environment.radiance, count, solid) + _sum(on_disk, disk, count)
    pull = _sum(nearest, local, count, light) + _sum(on_disk, sun, count, disk.sum(axis=1))
    length = np.linalg.norm(pull, axis=1, keepdims=True)
    # A black cell has no centroid; use its centre.
    least = 1e-12 * (length.max() or 1.0)
    return flux, np.where(length > least, pull, least * centers)


def cell_radiance(environment: Environment, count: int) -> np.ndarray:
    """Return the mean radiance of Fibonacci cells in world space, (N, 3) float64."""
    flux, pull = _cell_sums(environment, SPLIT * count)
    world = pull / np.maximum(np.linalg.norm(pull, axis=1, keepdims=True), 1e-300)
    owner = nearest_cells(world @ environment.to_local, count)
    return _sum(owner, flux, count) * count / (4 * np.pi)


@lru_cache(maxsize=4)
def _nearest(columns: int, rows: int, count: int) -> np.ndarray:
    """Return the index of the cell nearest each map node, (columns * rows,); cached."""
    return nearest_cells(latlong.directions(columns, rows).reshape(-1, 3), count)


def _cells(
    flux: np.ndarray, pull: np.ndarray, environment: Environment, typical: float | None = None
) -> LightCells:
    """Return cells; those to subdivide need ``typical``, the mean summed flux of fine cells."""
    length = np.linalg.norm(pull, axis=1, keepdims=True)
    # For unit directions, E|w - mean|^2 = 1 - |mean|^2; a disk has half the squared radius.
    mean = np.minimum(length / np.maximum(flux.sum(axis=1, keepdims=True), 1e-300), 1)
    radius = np.sqrt(2 * (1 - mean * mean))
    bright = np.sqrt(flux.sum(axis=1) / typical) if typical else np.ones(len(flux))
    size = np.square(radius[:, 0]) * np.clip(bright, *SIZES)
    world = pull / np.maximum(length, 1e-300) @ environment.to_local
    return LightCells(
        toward=to_drjit(mi.Float, np.hstack([world, radius]).ravel()),
        flux=to_drjit(mi.Float, np.hstack([flux, flux.mean(axis=1, keepdims=True)]).ravel()),
        number=len(flux),
        count=dr.opaque(mi.UInt32, len(flux)),
        size=None if typical is None else to_drjit(mi.Float, size),
    )


def _split(points: np.ndarray, weight: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Split clusters; return the cluster of each point, and the parent of each cluster."""
    label, parent = np.zeros(len(points), np.int64), np.zeros(count, np.int64)
    heap = [_Cluster.of(0, points, weight, np.arange(len(points)))]
    for new in range(1, count):
        old = heapq.heappop(heap)
        far = old.far_half()
        label[old.members[far]], parent[new] = new, old.number
        for number, half in ((old.number, ~far), (new, far)):
            heapq.heappush(heap, _Cluster.of(number, points, weight, old.members[half]))
    return label, parent


def _ancestors(parent: np.ndarray, count: int) -> np.ndarray:
    """Return each cluster's ancestor among the first ``count`` clusters."""
    result = np.arange(len(parent))
    for number in range(count, len(parent)):  # parents precede their children
        result[number] = result[parent[number]]
    return result


def nearest_cells(directions: np.ndarray, count: int) -> np.ndarray:
    """Return the index of the point of ``fibonacci(count)`` nearest each direction, (N,)."""
    return np.asarray(scipy.spatial.cKDTree(fibonacci(count)).query(directions, workers=-1)[1])


def _sum(cell: np.ndarray, values: np.ndarray, count: int, weight: Any = 1) -> np.ndarray:
    """Sum weighted values (..., K) by cell, (count, K); ``cell`` is flat."""
    # One column at a time: a large map would need hundreds of megabytes.
    columns = (values[..., k] * weight for k in range(values.shape[-1]))
    return np.stack([np.bincount(cell, x.ravel(), count) for x in columns], axis=-1)
