"""Predictors of unknown texels by pieces, symmetry and repetition.

Manufactured objects are often turned or moulded, assembled from pieces of one material each, or
painted with bands and repeated patterns. Each ``SymmetryPredictor`` averages known texels that
match an unknown one under one such assumption. ``cross_validation`` measures its errors.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from svu_mi.recovery.inpaint.texel_hierarchy import PIECE_DISTANCE, Pieces

Kind = Literal["all", "piece", "near", "level", "turned", "turned piece", "mirrored", "repeated"]
Axis = tuple[float, float, float]
Prediction = tuple[np.ndarray, np.ndarray]
"""Values (N, w) of w texels, and a mask (w,) of texels with a match."""
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

    @cached_property
    def table(self) -> np.ndarray:
        """Weighted values and weights, (k, 2 N)."""
        return np.concatenate([self.weights * self.values, self.weights]).T.copy()


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
        counts: Numbers of repetitions per turn, one for each prediction.
    """

    kind: Kind
    axis: Axis = Y
    counts: tuple[int, ...] = (1,)

    @property
    def titles(self) -> list[str]:
        """Titles of the predictions, such as ``turned about y``, ``repeated 6 times about y``."""
        axis = "xyz"[int(np.argmax(self.axis))]
        return [TITLE_FORMATS[self.kind].format(axis, count) for count in self.counts]

    def predict(
        self, pieces: Pieces, examples: KnownTexels, wanted: np.ndarray
    ) -> list[Prediction]:
        """Return the predictions of w ``wanted`` texels."""
        if self.kind == "piece":
            return [_piece_means(pieces.piece, examples, wanted)]
        features, has_match = self._features(pieces), np.ones((len(self.counts), len(wanted)), bool)
        # Also the mean of all texels if all features are equal.
        if self.kind == "all" or not np.ptp(features[examples.texels], axis=0).any():
            return [(np.repeat(examples.mean, len(wanted), axis=1), mask) for mask in has_match]
        settings = KNN_SETTINGS[self.kind]
        values = np.empty((len(self.counts), len(examples.values), len(wanted)))
        tree = scipy.spatial.cKDTree(features[examples.texels])
        for first in range(0, len(wanted), CHUNK):
            span = slice(first, first + CHUNK)
            sums = {turn: _knn_sums(settings, tree, examples, points)
                    for turn, points in self._queries(pieces, features, wanted[span])}  # fmt: skip
            for number, count in enumerate(self.counts):
                total, weight = np.sum([sums[turn] for turn in _turns(count)], axis=0)
                values[number, :, span] = total / np.maximum(weight, 1e-30)
                has_match[number, span] = weight[0] > 0
        if settings.inside:
            has_match &= _piece_sizes(pieces.piece, examples.texels)[pieces.piece[wanted]] >= FEWEST
        return list(zip(values, has_match, strict=True))

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
    ) -> Iterator[tuple[Fraction, np.ndarray]]:
        """Yield query features of ``wanted`` texels after each rotation, a fraction of a turn."""
        axis, points = np.asarray(self.axis), pieces.point[wanted]
        if self.kind == "mirrored":
            yield Fraction(0), points - 2 * (points @ axis)[:, None] * axis
        elif self.kind == "repeated":
            for turn in {turn for count in self.counts for turn in _turns(count)}:
                rotation = scipy.spatial.transform.Rotation.from_rotvec(2 * np.pi * turn * axis)
                yield turn, rotation.apply(points)
        else:
            yield Fraction(0), features[wanted]


def _turns(count: int) -> list[Fraction]:
    """Return the rotations of ``count`` repetitions, without the identity if there are others."""
    return [Fraction(step, count) for step in range(1, count)] or [Fraction(0)]


def _knn_sums(
    rule: KnnSettings, tree: scipy.spatial.cKDTree, known: KnownTexels, points: np.ndarray
) -> np.ndarray:
    """Return sums of weighted values and of weights of nearest neighbours, (2, N, w)."""
    count, found = min(rule.nearest, len(known.texels)), np.ones(len(points), bool)
    if rule.farthest < np.inf:  # few have a match; a bounded search is fast
        nearest, _ = tree.query(points, distance_upper_bound=rule.farthest, workers=-1)
        found = np.isfinite(nearest)
    distance, index = (x.reshape(-1, count) for x in tree.query(points[found], count, workers=-1))
    usable = distance < (PIECE_DISTANCE / 2 if rule.inside else np.inf)
    reach = np.where(usable, distance, 0).max(axis=1, keepdims=True)
    scale = np.maximum(rule.bandwidth * reach, 1e-9)
    near = (np.exp(-0.5 * (distance / scale) ** 2) + 1e-6) * usable
    starts = np.arange(0, near.size + 1, count)
    matrix = scipy.sparse.csr_array(
        (near.ravel(), index.ravel(), starts), shape=(len(near), len(known.texels))
    )
    sums = np.zeros((len(points), known.table.shape[1]))
    sums[found] = matrix @ known.table
    return sums.T.reshape(2, -1, len(points))


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


def _piece_means(piece: np.ndarray, examples: KnownTexels, wanted: np.ndarray) -> Prediction:
    size, owner = _piece_sizes(piece, examples.texels), piece[examples.texels]
    sums = np.stack([np.bincount(owner, column, len(size)) for column in examples.table.T])
    total, weight = sums[:, piece[wanted]].reshape(2, -1, len(wanted))
    return total / np.maximum(weight, 1e-30), size[piece[wanted]] >= FEWEST


NEAR_PREDICTOR = SymmetryPredictor("near")
REPETITIONS = (2, 3, 4, 6)  # the most frequent ones; each costs a search
PREDICTORS = (
    SymmetryPredictor("all"), SymmetryPredictor("piece"), NEAR_PREDICTOR,
    *(SymmetryPredictor(kind, axis) for kind in ("level", "turned", "turned piece", "mirrored")
      for axis in AXES),
    *(SymmetryPredictor("repeated", axis, REPETITIONS) for axis in AXES),
)  # fmt: skip
