"""Places that a texel may be like: near it, around an axis, on the other side of a mirror.

Objects are turned, cast in two halves, and painted in bands and patterns that repeat around them.
Each ``Likeness`` says where in space a point's like is to be found; whether an object has such a
likeness is found out by hiding parts of it that were seen (``fill``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

NEAREST = 12  # texels that a guess is made of
FEW = 4  # and of each copy of a pattern, of which there are several
CLOSE = 0.25  # part of the way to the farthest of them by which nearer ones count more
FARTHEST = 0.04  # distance, in parts of the object's extent, from which on nothing is alike
FARTHEST_COPY = 0.015  # the same of a pattern, whose details count
MOST_COPIES = 12  # of a pattern around an axis

Axis = tuple[float, float, float]


@dataclass(frozen=True)
class Likeness:
    """One way to say which points are alike.

    Attributes:
        kind: ``near``; ``turned``: at the same height and radius; ``mirrored``; ``repeated``:
            turned by a whole number of steps.
        axis: (3,) of the turn, or normal of the mirror, through the middle of the object.
        count: steps of a whole turn.
    """

    kind: Literal["near", "turned", "mirrored", "repeated"]
    axis: Axis = (0.0, 0.0, 0.0)
    count: int = 1

    @property
    def title(self) -> str:
        """For people: ``turned about y``, ``repeated 8 times about y``."""
        if self.kind == "near":
            return self.kind
        times = f" {self.count} times" if self.kind == "repeated" else ""
        return f"{self.kind}{times} about {'xyz'[int(np.argmax(np.abs(self.axis)))]}"

    def sources(self, points: np.ndarray) -> np.ndarray:
        """Return where points (n, 3) of a centred object are among those that others are like."""
        if self.kind != "turned":
            return points
        axis = np.asarray(self.axis)
        along = points @ axis
        across = np.linalg.norm(points - along[:, None] * axis, axis=1)
        return np.stack([along, across], axis=1)

    def copies(self, points: np.ndarray) -> Iterator[np.ndarray]:
        """Yield where the likes of points are looked for, each as ``sources`` has it."""
        axis = np.asarray(self.axis)
        if self.kind == "mirrored":
            yield points - 2 * (points @ axis)[:, None] * axis
        elif self.kind == "repeated":
            for step in range(1, self.count):
                turn = Rotation.from_rotvec(2 * np.pi * step / self.count * axis)
                yield turn.apply(points)
        else:
            yield self.sources(points)

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
            (N, w) values; and (w,) bool, whether anything is alike.
        """
        total, weight = (np.zeros((len(values), len(wanted))) for _ in range(2))
        several = self.kind == "repeated"
        count = min(FEW if several else NEAREST, len(known))
        alike = np.full(len(wanted), self.kind == "near" and count > 0)
        if not count or not len(wanted):
            return total, alike
        farthest = FARTHEST_COPY if several else FARTHEST
        tree = cKDTree(self.sources(points[known]))
        for places in self.copies(points[wanted]):
            distance, found = (x.reshape(-1, count) for x in tree.query(places, count))
            there = alike if self.kind == "near" else distance[:, 0] < farthest
            scale = np.maximum(CLOSE * distance[:, -1:], 1e-9)
            nearness = (np.exp(-0.5 * (distance / scale) ** 2) + 1e-6) * there[:, None]
            how = weights[:, known[found]] * nearness
            total += (how * values[:, known[found]]).sum(axis=2)
            weight += how.sum(axis=2)
            alike = alike | there
        return total / np.maximum(weight, 1e-30), alike


# Not what is near: values spread from the border as it is.
LIKENESSES = (
    *(Likeness(kind, axis) for kind in ("turned", "mirrored")
      for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))),
    *(Likeness("repeated", axis, count)
      for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
      for count in range(2, MOST_COPIES + 1)),
)  # fmt: skip


def centred(points: np.ndarray) -> np.ndarray:
    """Return points (T, 3) about the middle of their bounding box, in units of its diagonal."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(np.linalg.norm(high - low)) or 1.0
    return np.asarray((points - (low + high) / 2) / extent)
