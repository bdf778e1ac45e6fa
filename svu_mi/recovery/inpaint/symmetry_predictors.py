"""Texels that others are like: of the same piece, as high, around an axis, in a mirror.

Objects are turned, cast in two halves, put together from pieces of one material each, and painted
in bands and patterns that repeat around them. Each ``Likeness`` says which of the texels that are
known tell what another one is; how well they do is found out by hiding parts that were seen
(``cross_validation``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from svu_mi.recovery.inpaint.texel_hierarchy import APART, Pieces

Kind = Literal[
    "all", "piece", "near", "level", "turned", "turned piece", "mirrored", "repeated"
]  # fmt: skip
Axis = tuple[float, float, float]
X, Y, Z = AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
CHUNK = 2**15  # texels that are guessed at a time
FEWEST = 12  # texels of a piece by which others of it are guessed
BEND = 0.3  # distance that normals at right angles count as, along the surface
TURN = 0.1  # the same, around an axis


@dataclass(frozen=True)
class Rule:
    """How texels are found that another one is like.

    Attributes:
        nearest: how many are averaged.
        close: part of the way to the farthest of them by which nearer ones count more.
        farthest: distance, in parts of the object's extent, from which on nothing is alike.
        inside: whether they are of the same piece.
    """

    nearest: int
    close: float
    farthest: float = np.inf
    inside: bool = False


RULES: dict[Kind, Rule] = {
    "near": Rule(12, 0.25, inside=True),
    "level": Rule(60, 0.5),
    "turned": Rule(32, 0.5),
    "turned piece": Rule(32, 0.5, inside=True),
    "mirrored": Rule(12, 0.25, farthest=0.04),
    "repeated": Rule(4, 0.25, farthest=0.015),
}


WORDS: dict[Kind, str] = {
    "all": "mean of all", "piece": "mean of its piece", "near": "near", "level": "level along {}",
    "turned": "turned about {}", "turned piece": "turned as a piece about {}",
    "mirrored": "mirrored about {}", "repeated": "repeated {1} times about {0}",
}  # fmt: skip


@dataclass(frozen=True)
class Examples:
    """Texels that others are guessed by.

    Attributes:
        texels: (k,) their numbers.
        values: (N, k).
        weights: (N, k), how much they count.
    """

    texels: np.ndarray
    values: np.ndarray
    weights: np.ndarray

    @cached_property
    def mean(self) -> np.ndarray:
        """(N, 1), of all."""
        return np.average(self.values, axis=1, weights=self.weights)[:, None]


@dataclass(frozen=True)
class Likeness:
    """One way to say which texels are alike.

    Attributes:
        kind: ``all``, and ``piece``: of the same connected piece of the surface, means;
            ``near``: close by, and facing the same way;
            ``level``: as high along the axis;
            ``turned``: at the same height and radius, facing the same way as seen from the axis;
            ``turned piece``: at the same height and radius of its piece;
            ``mirrored``; ``repeated``: turned by a whole number of steps.
        axis: (3,) through the middle of the object, or of the piece; normal of the mirror.
        count: steps of a whole turn.
    """

    kind: Kind
    axis: Axis = Y
    count: int = 1

    @property
    def title(self) -> str:
        """For people: ``turned about y``, ``repeated 6 times about y``."""
        return WORDS[self.kind].format("xyz"[int(np.argmax(self.axis))], self.count)

    def guess(
        self, pieces: Pieces, known: Examples, wanted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return values of texels by those that are like them, (N, w), and where there are any."""
        if self.kind == "piece":
            return _means_of_pieces(pieces.piece, known, wanted)
        places, alike = self._places(pieces), np.ones(len(wanted), bool)
        # All as high: no tree tells them apart.
        if self.kind == "all" or not np.ptp(places[known.texels], axis=0).any():
            return np.repeat(known.mean, len(wanted), axis=1), alike
        found, rule = np.empty((len(known.values), len(wanted))), RULES[self.kind]
        tree = scipy.spatial.cKDTree(places[known.texels])
        for first in range(0, len(wanted), CHUNK):
            span = slice(first, first + CHUNK)
            copies = self._copies(pieces, places, wanted[span])
            found[:, span], alike[span] = _weighted(rule, tree, known, copies)
        if rule.inside:
            alike &= _sizes(pieces.piece, known.texels)[pieces.piece[wanted]] >= FEWEST
        return found, alike

    def _places(self, pieces: Pieces) -> np.ndarray:
        """Return where every texel is, (T, d), as this likeness looks at it."""
        axis, points = np.asarray(self.axis), pieces.point
        if self.kind == "near":
            return pieces.apart(np.concatenate([points, BEND * pieces.normal], axis=1))
        if self.kind == "level":
            return (points @ axis)[:, None]
        if self.kind == "turned":
            return _around(points, axis, TURN * pieces.normal)
        if self.kind == "turned piece":
            return pieces.apart(_around(points - pieces.middle, axis))
        return points

    def _copies(
        self, pieces: Pieces, places: np.ndarray, wanted: np.ndarray
    ) -> Iterator[np.ndarray]:
        """Yield where the likes of texels are looked for."""
        axis, points = np.asarray(self.axis), pieces.point[wanted]
        if self.kind == "mirrored":
            yield points - 2 * (points @ axis)[:, None] * axis
        elif self.kind == "repeated":
            for step in range(1, self.count):
                angle = 2 * np.pi * step / self.count
                turn = scipy.spatial.transform.Rotation.from_rotvec(angle * axis)
                yield turn.apply(points)
        else:
            yield places[wanted]


def _weighted(
    rule: Rule, tree: scipy.spatial.cKDTree, known: Examples, copies: Iterable[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted means of what is nearest to copies of points, and where any is."""
    count, parts = min(rule.nearest, len(known.texels)), []
    for points in copies:
        distance, found = (x.reshape(-1, count) for x in tree.query(points, count, workers=-1))
        there = distance[:, 0] < rule.farthest
        mine = distance < (APART / 2 if rule.inside else np.inf)
        reach = np.where(mine, distance, 0).max(axis=1, keepdims=True)
        scale = np.maximum(rule.close * reach, 1e-9)
        near = (np.exp(-0.5 * (distance / scale) ** 2) + 1e-6) * there[:, None] * mine
        how = known.weights[:, found] * near
        parts.append(((how * known.values[:, found]).sum(axis=2), how.sum(axis=2), there))
    total, weight, alike = (sum(part) for part in zip(*parts, strict=True))
    return total / np.maximum(weight, 1e-30), alike > 0


def _around(points: np.ndarray, axis: np.ndarray, normal: np.ndarray | None = None) -> np.ndarray:
    """Return height and radius of points, and the same two of normals, in columns."""
    along = points @ axis
    across = points - along[:, None] * axis
    radius = np.linalg.norm(across, axis=1)
    columns = [along, radius]
    if normal is not None:
        columns += [normal @ axis, (normal * across).sum(axis=1) / np.maximum(radius, 1e-9)]
    return np.stack(columns, axis=1)


def _sizes(piece: np.ndarray, texels: np.ndarray) -> np.ndarray:
    """Return how many of some texels are of each piece."""
    return np.bincount(piece[texels], minlength=int(piece.max()) + 1)


def _means_of_pieces(
    piece: np.ndarray, known: Examples, wanted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    size, owner = _sizes(piece, known.texels), piece[known.texels]
    means = []
    for values, weights in zip(known.values, known.weights, strict=True):
        total = np.bincount(owner, weights * values, len(size))
        means.append(total / np.maximum(np.bincount(owner, weights, len(size)), 1e-30))
    return np.array(means)[:, piece[wanted]], size[piece[wanted]] >= FEWEST


NEAR = Likeness("near")
STEPS = (2, 3, 4, 6)  # of patterns: others are hardly ever painted, and cost as much to look for
LIKENESSES = (
    Likeness("all"), Likeness("piece"), NEAR,
    *(Likeness(kind, axis) for kind in ("level", "turned", "turned piece", "mirrored")
      for axis in AXES),
    *(Likeness("repeated", axis, count) for axis in AXES for count in STEPS),
)  # fmt: skip
