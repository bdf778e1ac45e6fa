"""Places that a texel may be like: near it, around an axis, on the other side of a mirror.

Objects are turned, cast in two halves, and painted in bands. Each ``Likeness`` maps points of the
surface so that those that are alike lie near each other; whether an object has such a likeness is
found out by hiding parts of it that were seen (``choose``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

NEAREST = 12  # texels that a guess is made of
CLOSE = 0.25  # part of the way to the farthest of them by which nearer ones count more
FARTHEST = 0.04  # distance, in parts of the object's extent, from which on nothing is alike
AXES = np.eye(3)


@dataclass(frozen=True)
class Likeness:
    """One way to say which points are alike.

    Attributes:
        kind: ``near``, ``turned`` or ``mirrored``.
        axis: (3,) of the turn, or normal of the mirror, through the middle of the object.
    """

    kind: str
    axis: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def title(self) -> str:
        """For people."""
        return self.kind if self.kind == "near" else f"{self.kind} about {_letter(self.axis)}"

    def places(self, points: np.ndarray) -> np.ndarray:
        """Return where points (n, 3) of a centred object are looked for, (n, 2 or 3)."""
        axis = np.asarray(self.axis)
        along = points @ axis
        if self.kind == "mirrored":
            return np.asarray(points - 2 * along[:, None] * axis)
        if self.kind == "turned":
            across = np.linalg.norm(points - along[:, None] * axis, axis=1)
            return np.stack([along, across], axis=1)
        return points

    def sources(self, points: np.ndarray) -> np.ndarray:
        """Return where points whose values are known lie among them."""
        return points if self.kind == "mirrored" else self.places(points)

    def guess(
        self, points: np.ndarray, known: np.ndarray, values: np.ndarray, weights: np.ndarray,
        wanted: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Guess values of texels from those that are like them.

        Args:
            points: (T, 3) in units of the object's extent, about its middle.
            known: (k,) numbers of texels whose values are known.
            values: (N, T), of which those of known texels count.
            weights: (N, T), how much.
            wanted: (w,) numbers of texels.

        Returns:
            (N, w) values; and (w,) bool, whether anything is alike: nearer than ``FARTHEST``.
        """
        count = min(NEAREST, len(known))
        if not count or not len(wanted):
            return np.zeros((len(values), len(wanted))), np.zeros(len(wanted), bool)
        tree = cKDTree(self.sources(points[known]))
        distance, found = tree.query(self.places(points[wanted]), count)
        distance, found = distance.reshape(-1, count), found.reshape(-1, count)
        scale = np.maximum(CLOSE * distance[:, -1:], 1e-9)
        nearness = np.exp(-0.5 * (distance / scale) ** 2) + 1e-6
        chosen = known[found]
        how = weights[:, chosen] * nearness
        guessed = (how * values[:, chosen]).sum(axis=2) / np.maximum(how.sum(axis=2), 1e-30)
        alike = distance[:, 0] < FARTHEST if self.kind != "near" else np.ones(len(wanted), bool)
        return guessed, alike


LIKENESSES = (
    Likeness("near"),
    *(Likeness("turned", tuple(axis)) for axis in AXES),
    *(Likeness("mirrored", tuple(axis)) for axis in AXES),
)


def centred(points: np.ndarray) -> np.ndarray:
    """Return points (T, 3) about the middle of their bounding box, in units of its diagonal."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(np.linalg.norm(high - low)) or 1.0
    return np.asarray((points - (low + high) / 2) / extent)


def _letter(axis: tuple[float, float, float]) -> str:
    return "xyz"[int(np.argmax(np.abs(axis)))]
