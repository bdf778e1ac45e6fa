"""Neighbours of texels, also across UV seams, and groups of texels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import ShapeError
from svu_mi.geometry.texels import Texels

REACH = 2.0  # largest distance of neighbours, in texel sizes
OPPOSITE = -0.5  # cosine between normals; below it, texels are on opposite sides of a thin sheet
HOPS = 3  # texels connected by at most this many links within a chart are not seam neighbours
CANDIDATES = 8  # nearest texels that are tested for each texel at a seam
MOST = 8  # largest number of neighbours; a coarse chart may be adjacent to a finer one


@dataclass(frozen=True, kw_only=True)
class Neighbors:
    """Neighbourhood graph of T texels on the surface, with P undirected edges.

    Attributes:
        pairs: Two (P,) UInt32 with the texel indices of each edge, the lower one first.
        around: K arrays (T,) UInt32, the k-th neighbour of each texel; the texel's own index if it
            has fewer neighbours. If a is a neighbour of b, b is a neighbour of a.
        seams: Number of edges across a seam.
    """

    pairs: tuple[Any, Any]
    around: tuple[Any, ...]
    seams: int

    def __post_init__(self) -> None:
        """Raise if padding precedes a neighbour, which ``over_neighbors`` would skip."""
        own, hidden = dr.arange(mi.UInt32, self.count), mi.Bool(False)
        for column, after in zip(self.around, self.around[1:], strict=False):
            hidden |= (column == own) & (after != own)
        if dr.any(hidden):
            texel = int(np.flatnonzero(np.array(hidden))[0])
            raise ShapeError(
                f"Neighbors: texel {texel} has a neighbour after its own index; own indices, "
                "which are padding, must come last."
            )

    @staticmethod
    def of(pairs: np.ndarray, count: int, seams: int = 0) -> "Neighbors":
        """Make the graph from unique pairs (P, 2) of ``count`` texels."""
        pairs = np.sort(pairs, axis=1)
        pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        owner, other = np.r_[pairs[:, 0], pairs[:, 1]], np.r_[pairs[:, 1], pairs[:, 0]]
        place = _place(owner, other)
        table = np.tile(np.arange(count), (int(place.max(initial=0)) + 1, 1))
        table[place, owner] = other
        first, second = (to_drjit(mi.UInt32, column.astype(np.uint32)) for column in pairs.T)
        around = tuple(to_drjit(mi.UInt32, column.astype(np.uint32)) for column in table)
        return Neighbors(pairs=(first, second), around=around, seams=seams)

    @property
    def count(self) -> int:
        """Number of texels T."""
        return int(dr.width(self.around[0]))

    def table(self) -> np.ndarray:
        """Return ``around`` as a (K, T) int64 array."""
        return np.stack([np.array(column, np.int64) for column in self.around])


def neighbors(texels: Texels, mesh: Any | None = None) -> Neighbors:
    """Find the neighbours of each texel on the surface, also across seams.

    Texels adjacent in the UV map are neighbours, unless they are over two texels apart in space or
    have opposite normals. At a chart edge, the position of the next texel is extrapolated, and the
    texel of another chart nearest to this position is the neighbour.
    """
    right, down = _grid_pairs(texels)
    if mesh is None:
        return Neighbors.of(np.concatenate([right, down]), texels.count)
    surface = _TexelFrames.of(texels)
    right = right[surface.near(right, surface.steps[0])]
    down = down[surface.near(down, surface.steps[1])]
    inside = np.concatenate([right, down])
    across = _seam_pairs(surface, right, down)
    return Neighbors.of(np.concatenate([inside, across]), texels.count, len(across))


def lanes_of(around: Sequence[Any], size: int) -> tuple[Any, ...]:
    """Expand ``around`` of T texels to arrays (T * size,), with ``size`` lanes per texel."""
    if size == 1:
        return tuple(around)
    columns = []
    for column in around:
        lane = dr.arange(mi.UInt32, dr.width(column) * size)
        texel = lane // size
        columns.append(dr.gather(mi.UInt32, column, texel) * size + (lane - texel * size))
    dr.eval(columns)
    return tuple(columns)


def over_neighbors(around: Sequence[Any], add: Callable[[Any, Any], Any], state: Any) -> Any:
    """Fold ``add(neighbour, state)`` over the neighbours of each lane."""
    if not around:
        return state
    other, own = around[0], dr.arange(mi.UInt32, dr.width(around[0]))

    def more(state: Any, other: Any) -> tuple[Any]:
        return (over_neighbors(around[1:], add, add(other, state)),)

    (total,) = dr.if_stmt(
        args=(state, other), cond=other != own, true_fn=more, false_fn=lambda state, _: (state,)
    )
    return total


@dataclass(frozen=True)
class _TexelFrames:
    """Positions, normals and tangents of texels, in float64.

    Attributes:
        steps: Two (T, 3), offsets to the next texel along u and v on the face.
    """

    position: np.ndarray
    normal: np.ndarray
    steps: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, texels: Texels) -> "_TexelFrames":
        vectors = texels.position, texels.geometric_normal, *texels.sides
        position, normal, *steps = (np.array(x, np.float64).T for x in vectors)
        return cls(position, normal, (steps[0], steps[1]))

    def near(self, pairs: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return (P,) bool: True for pairs within REACH steps and without opposite normals."""
        first, second = pairs.T
        apart = _length(self.position[first] - self.position[second])
        longest = np.maximum(_length(step)[first], _length(step)[second])
        return (apart <= REACH * longest) & self.same_side(first, second)

    def same_side(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return whether normals are not opposite, as on two sides of a thin sheet."""
        return (self.normal[first] * self.normal[second]).sum(axis=-1) > OPPOSITE


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def _grid_pairs(texels: Texels) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (P, 2) of horizontally and of vertically adjacent texels."""
    width, height = texels.resolution
    index = texels.index.numpy().astype(np.int64)
    number = np.full(width * height + width, -1)
    number[index] = np.arange(len(index))
    result = []
    for offset, last in ((1, index % width == width - 1), (width, index // width == height - 1)):
        other = np.where(last, -1, number[index + offset])
        present = np.flatnonzero(other >= 0)
        result.append(np.stack([present, other[present]], axis=-1))
    return result[0], result[1]


def _seam_pairs(surface: _TexelFrames, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Return pairs (P, 2) of texels that meet at a seam."""
    count = len(surface.position)
    start, way = _chart_borders(surface, right, down)
    border = np.unique(start)
    if len(border) < 2:
        return np.empty((0, 2), np.int64)
    target = surface.position[start] + way
    tree = scipy.spatial.cKDTree(surface.position[border])
    distance, candidate = tree.query(target, min(CANDIDATES, len(border)))
    other = border[candidate]
    here = np.broadcast_to(start[:, None], other.shape)
    gap = surface.position[other] - surface.position[here]
    # Texels across the seam may be larger.
    longest = np.maximum(*map(_length, surface.steps))
    scale = np.maximum(_length(way)[:, None], longest[other])
    usable = surface.same_side(here, other) & ((gap * way[:, None]).sum(axis=-1) > 0)
    usable &= (_length(gap) <= REACH * scale) & (distance <= scale)
    usable &= ~_within_steps(count, np.concatenate([right, down]), border, here, other)
    distance = np.where(usable, distance, np.inf)
    best = distance.argmin(axis=1)[:, None]
    nearest = np.take_along_axis(distance, best, axis=1)[:, 0]
    pairs = np.stack([start, np.take_along_axis(other, best, axis=1)[:, 0]], axis=-1)
    kept = np.isfinite(nearest)
    inside = np.bincount(np.concatenate([right, down]).ravel(), minlength=count)
    return _limit_neighbors(np.sort(pairs[kept], axis=1), nearest[kept], MOST - inside)


def _chart_borders(
    surface: _TexelFrames, right: np.ndarray, down: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return texels (E,) at chart edges, and outward offsets (E, 3)."""
    starts, ways = [], []
    for pairs, step in zip((right, down), surface.steps, strict=True):
        for side, sign in ((0, 1), (1, -1)):
            served = np.zeros(len(surface.position), bool)
            served[pairs[:, side]] = True
            loose = np.flatnonzero(~served)
            starts.append(loose)
            ways.append(sign * step[loose])
    return np.concatenate(starts), np.concatenate(ways)


def _within_steps(
    count: int, pairs: np.ndarray, border: np.ndarray, start: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """Return whether at most HOPS of the ``pairs`` connect ``start`` and ``other``."""
    first, second = pairs.T
    links = scipy.sparse.csr_array(
        (np.ones(2 * len(pairs), np.float32), (np.r_[first, second], np.r_[second, first])),
        shape=(count, count),
    )
    own = scipy.sparse.csr_array(scipy.sparse.eye(count, dtype=np.float32, format="csr"))
    links = scipy.sparse.csr_array(links + own)
    near = links[border]
    for _ in range(HOPS - 1):
        near = scipy.sparse.csr_array(near @ links)
    rows = np.searchsorted(border, start.ravel())
    return np.asarray(near[rows, other.ravel()]).reshape(other.shape) > 0


def _limit_neighbors(pairs: np.ndarray, distance: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Return unique pairs, nearest first; at most ``room[t]`` of them contain texel t."""
    pairs = pairs[np.argsort(distance, kind="stable")]
    pairs = pairs[np.sort(np.unique(pairs, axis=0, return_index=True)[1])]
    place = _place(pairs.T.ravel(), np.tile(np.arange(len(pairs)), 2)).reshape(2, -1)
    return pairs[(place[0] < room[pairs[:, 0]]) & (place[1] < room[pairs[:, 1]])]


def _place(owner: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return the rank by ``order`` of each entry among entries of the same owner."""
    by_owner = np.lexsort((order, owner))
    ranked = owner[by_owner]
    first = np.searchsorted(ranked, ranked)
    place = np.empty(len(owner), np.int64)
    place[by_owner] = np.arange(len(owner)) - first
    return place


def connected_components(around: Sequence[Any]) -> np.ndarray:
    """Return the index of each texel's connected component, (T,) int64."""
    columns = [np.array(column, np.int64) for column in around]
    count = len(columns[0])
    rows = np.tile(np.arange(count), len(columns))
    places = rows, np.concatenate(columns)
    links = scipy.sparse.csr_array((np.ones(len(rows), bool), places), (count, count))
    return np.asarray(scipy.sparse.csgraph.connected_components(links, directed=False)[1], np.int64)


def texel_squares(texels: Texels) -> np.ndarray:
    """Return row and column of T texels in the texture, (T, 2) int64."""
    index, width = texels.index.numpy().astype(np.int64), texels.resolution[0]
    return np.stack(np.divmod(index, width), axis=1)


def occupied_squares(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the G distinct squares (G, 2), and the index of each texel's square (T,)."""
    width = int(squares[:, 1].max(initial=0)) + 1
    numbers, owner = np.unique(squares[:, 0] * width + squares[:, 1], return_inverse=True)
    return np.stack(np.divmod(numbers, width), axis=1), owner


def group_neighbors(around: Sequence[np.ndarray], owner: np.ndarray) -> tuple[Any, ...]:
    """Return ``Neighbors.around`` for groups; ``owner`` is each texel's group index."""
    count = int(owner.max()) + 1
    numbers = []
    for column in around:
        other = owner[column]
        apart = other > owner  # one direction of each pair
        numbers.append(owner[apart] * count + other[apart])
    pairs = np.divmod(np.unique(np.concatenate(numbers)), count)
    return Neighbors.of(np.stack(pairs, axis=1), count).around


def group_means(
    values: np.ndarray, weights: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted means (N, G) of values (N, T) in G groups, and sums of weights (N, G)."""
    total = group_sums(weights, owner)
    return group_sums(weights * values, owner) / total, total


def group_sums(values: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Return sums (N, G) of values (N, T) in groups; ``owner`` is each texel's group (T,)."""
    return np.stack([np.bincount(owner, row) for row in values])
