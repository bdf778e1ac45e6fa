"""Predictors of unknown texels by pieces, symmetry and repetition.

Manufactured objects are often turned or moulded, assembled from pieces of one material each, or
painted with bands and repeated patterns. Each ``SymmetryPredictor`` averages known texels that
match an unknown one under one such assumption. ``cross_validation`` measures its errors.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from svu_mi.recovery.inpaint.texel_hierarchy import PIECE_DISTANCE, Pieces

Kind = Literal[
    "all", "piece", "near", "level", "turned", "turned piece", "mirrored", "repeated"
]  # fmt: skip
Axis = tuple[float, float, float]
X, Y, Z = AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
CHUNK = 2**15  # texels per chunk of predictions
FEWEST = 12  # least number of known texels for predictions within a piece
BEND = 0.3  # scale of normals relative to positions (in extents), kind "near"
TURN = 0.1  # scale of normals relative to height and radius, kind "turned"


@dataclass(frozen=True)
class KnnSettings:
    """k-nearest-neighbour settings of a predictor.

    Attributes:
        nearest: Number of neighbours.
        bandwidth: Bandwidth of Gaussian weights, relative to the farthest neighbour's distance.
        farthest: Maximum distance of the first neighbour, in extents of the object.
        inside: True to restrict neighbours to the same piece.
    """

    nearest: int
    bandwidth: float
    farthest: float = np.inf
    inside: bool = False


KNN_SETTINGS: dict[Kind, KnnSettings] = {
    "near": KnnSettings(12, 0.25, inside=True),
    "level": KnnSettings(60, 0.5),
    "turned": KnnSettings(32, 0.5),
    "turned piece": KnnSettings(32, 0.5, inside=True),
    "mirrored": KnnSettings(12, 0.25, farthest=0.04),
    "repeated": KnnSettings(4, 0.25, farthest=0.015),
}


TITLE_FORMATS: dict[Kind, str] = {
    "all": "mean of all", "piece": "mean of its piece", "near": "near", "level": "level along {}",
    "turned": "turned about {}", "turned piece": "turned as a piece about {}",
    "mirrored": "mirrored about {}", "repeated": "repeated {1} times about {0}",
}  # fmt: skip


@dataclass(frozen=True)
class KnownTexels:
    """Known texels, the training data of predictors.

    Attributes:
        texels: (k,) texel indices.
        values: (N, k) values of the parameters.
        weights: (N, k) precisions.
    """

    texels: np.ndarray
    values: np.ndarray
    weights: np.ndarray

    @cached_property
    def mean(self) -> np.ndarray:
        """Weighted mean of all known texels, (N, 1)."""
        return np.average(self.values, axis=1, weights=self.weights)[:, None]


@dataclass(frozen=True)
class SymmetryPredictor:
    """Predictor by one kind of symmetry.

    Attributes:
        kind: Texels to average. ``all``: all known texels. ``piece``: same connected piece of the
            surface. ``near``: similar position and normal. ``level``: similar height along the
            axis. ``turned``: similar height, radius and normal relative to the axis. ``turned
            piece``: similar height and radius relative to the axis of the piece. ``mirrored``:
            similar position after reflection. ``repeated``: similar position after rotation.
        axis: Axis through the centre of the object or piece; normal of the mirror plane.
        count: Number of repetitions per turn.
    """

    kind: Kind
    axis: Axis = Y
    count: int = 1

    @property
    def title(self) -> str:
        """Title, such as ``turned about y`` or ``repeated 6 times about y``."""
        return TITLE_FORMATS[self.kind].format("xyz"[int(np.argmax(self.axis))], self.count)

    def predict(
        self, pieces: Pieces, examples: KnownTexels, wanted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return predictions (N, w) of w texels, and a mask (w,) of texels with a match."""
        if self.kind == "piece":
            return _piece_means(pieces.piece, examples, wanted)
        features, has_match = self._features(pieces), np.ones(len(wanted), bool)
        # Also the mean of all texels if all features are equal.
        if self.kind == "all" or not np.ptp(features[examples.texels], axis=0).any():
            return np.repeat(examples.mean, len(wanted), axis=1), has_match
        values, settings = np.empty((len(examples.values), len(wanted))), KNN_SETTINGS[self.kind]
        tree = scipy.spatial.cKDTree(features[examples.texels])
        for first in range(0, len(wanted), CHUNK):
            span = slice(first, first + CHUNK)
            queries = self._queries(pieces, features, wanted[span])
            values[:, span], has_match[span] = _knn_means(settings, tree, examples, queries)
        if settings.inside:
            has_match &= _piece_sizes(pieces.piece, examples.texels)[pieces.piece[wanted]] >= FEWEST
        return values, has_match

    def _features(self, pieces: Pieces) -> np.ndarray:
        """Return the features (T, d) of the nearest-neighbour search."""
        axis, points = np.asarray(self.axis), pieces.point
        if self.kind == "near":
            return pieces.separated(np.concatenate([points, BEND * pieces.normal], axis=1))
        if self.kind == "level":
            return (points @ axis)[:, None]
        if self.kind == "turned":
            return _radial(points, axis, TURN * pieces.normal)
        if self.kind == "turned piece":
            return pieces.separated(_radial(points - pieces.middle, axis))
        return points

    def _queries(
        self, pieces: Pieces, features: np.ndarray, wanted: np.ndarray
    ) -> Iterator[np.ndarray]:
        """Yield query features of ``wanted`` texels, once per repetition."""
        axis, points = np.asarray(self.axis), pieces.point[wanted]
        if self.kind == "mirrored":
            yield points - 2 * (points @ axis)[:, None] * axis
        elif self.kind == "repeated":
            for step in range(1, self.count):
                angle = 2 * np.pi * step / self.count
                turn = scipy.spatial.transform.Rotation.from_rotvec(angle * axis)
                yield turn.apply(points)
        else:
            yield features[wanted]


def _knn_means(
    rule: KnnSettings, tree: scipy.spatial.cKDTree, known: KnownTexels, places: Iterable[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted means of nearest neighbours, and a mask of queries with a match."""
    count, parts = min(rule.nearest, len(known.texels)), []
    for points in places:
        found = np.ones(len(points), bool)
        if rule.farthest < np.inf:  # few have a match; a bounded search is fast
            nearest, _ = tree.query(points, distance_upper_bound=rule.farthest, workers=-1)
            found = np.isfinite(nearest)
        both = tree.query(points[found], count, workers=-1)
        distance, index = (x.reshape(-1, count) for x in both)
        usable = distance < (PIECE_DISTANCE / 2 if rule.inside else np.inf)
        reach = np.where(usable, distance, 0).max(axis=1, keepdims=True)
        scale = np.maximum(rule.bandwidth * reach, 1e-9)
        near = (np.exp(-0.5 * (distance / scale) ** 2) + 1e-6) * usable
        weighted = known.weights[:, index] * near
        sums = np.zeros((2, len(known.values), len(points)))
        sums[:, :, found] = (weighted * known.values[:, index]).sum(axis=2), weighted.sum(axis=2)
        parts.append(sums)
    total, weight = np.sum(parts, axis=0)
    return total / np.maximum(weight, 1e-30), weight[0] > 0


def _radial(points: np.ndarray, axis: np.ndarray, normal: np.ndarray | None = None) -> np.ndarray:
    """Return height and radius of points, and axial and radial components of normals."""
    along = points @ axis
    across = points - along[:, None] * axis
    radius = np.linalg.norm(across, axis=1)
    columns = [along, radius]
    if normal is not None:
        columns += [normal @ axis, (normal * across).sum(axis=1) / np.maximum(radius, 1e-9)]
    return np.stack(columns, axis=1)


def _piece_sizes(piece: np.ndarray, texels: np.ndarray) -> np.ndarray:
    """Return the number of ``texels`` in each piece."""
    return np.bincount(piece[texels], minlength=int(piece.max()) + 1)


def _piece_means(
    piece: np.ndarray, examples: KnownTexels, wanted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    size, owner = _piece_sizes(piece, examples.texels), piece[examples.texels]
    means = []
    for values, weights in zip(examples.values, examples.weights, strict=True):
        total = np.bincount(owner, weights * values, len(size))
        means.append(total / np.maximum(np.bincount(owner, weights, len(size)), 1e-30))
    return np.array(means)[:, piece[wanted]], size[piece[wanted]] >= FEWEST


NEAR_PREDICTOR = SymmetryPredictor("near")
REPETITIONS = (2, 3, 4, 6)  # the most frequent ones; each costs a search
PREDICTORS = (
    SymmetryPredictor("all"), SymmetryPredictor("piece"), NEAR_PREDICTOR,
    *(SymmetryPredictor(kind, axis) for kind in ("level", "turned", "turned piece", "mirrored")
      for axis in AXES),
    *(SymmetryPredictor("repeated", axis, count) for axis in AXES for count in REPETITIONS),
)  # fmt: skip
