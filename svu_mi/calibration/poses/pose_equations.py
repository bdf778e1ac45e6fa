"""Least-squares equations of camera motions, and their prior.

The motion of a camera is a rotation vector [rad] and a translation in units of its distance from
the object, in the camera's frame (+X left, +Y up, +Z forward): six numbers x per photograph. Errors
e of N measurements with derivatives G and weights w give the equations A x = b,

    A = G^T w G,  b = G^T w e.

The given poses are the prior: motions are normally distributed around them. The widths of this
distribution, one for rotations and one for translations, are those of the motions themselves (the
EM algorithm), so that cameras stay where they are if nothing shows that they are off.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import affine, changed_sensor, focal_length

WIDEST = np.array([np.radians(0.3)] * 3 + [np.radians(0.3)] * 3)  # first standard deviations


@dataclass(frozen=True)
class PoseEquations:
    """Equations of V cameras: ``matrix`` A (V, 6, 6), ``right`` b (V, 6)."""

    matrix: np.ndarray
    right: np.ndarray

    @staticmethod
    def of(single: Sequence[tuple[np.ndarray, np.ndarray]]) -> "PoseEquations":
        """Stack A and b of V cameras."""
        return PoseEquations(np.stack([A for A, _ in single]), np.stack([b for _, b in single]))

    def __add__(self, other: "PoseEquations") -> "PoseEquations":
        return PoseEquations(self.matrix + other.matrix, self.right + other.right)

    def solve(
        self, moved: np.ndarray, widths: np.ndarray, steps: int = 4
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return motions from the given poses (V, 6), and the widths (6,) of their prior.

        Args:
            moved: (V, 6), motions at which the equations were made.
            widths: (6,), standard deviations of the prior.
            steps: steps of the EM algorithm.
        """
        target = self.right + np.einsum("vij,vj->vi", self.matrix, moved)
        for _ in range(steps):
            covariance = np.linalg.inv(self.matrix + np.diag(widths**-2.0))
            motion = np.einsum("vij,vj->vi", covariance, target)
            square = np.diagonal(covariance, axis1=1, axis2=2) + motion**2
            widths = np.sqrt(square.reshape(-1, 2, 3).mean(axis=(0, 2))).repeat(3)
        return motion, widths


NOTHING = np.zeros((6, 6)), np.zeros(6)
"""A and b without measurements."""


def moved_sensor(sensor: Any, motion: np.ndarray, distance: float) -> Any:
    """Return a sensor moved by a motion (6,)."""
    turn = affine(Rotation.from_rotvec(motion[:3]).as_matrix(), motion[3:] * distance)
    return changed_sensor(sensor, to_world=(to_world(sensor) @ turn).tolist())


def pixel_derivatives(sensor: Any, points: np.ndarray, distance: float) -> np.ndarray:
    """Return the derivatives of pixel x and y of world points (N, 3) by the motion, (N, 2, 6)."""
    pose = to_world(sensor)
    local = (points - pose[:3, 3]) @ pose[:3, :3]  # a motion changes it to local + local x r - t
    x, y, depth = local.T
    zero, scale = np.zeros_like(depth), focal_length(sensor) / depth
    by_point = np.stack([
        np.stack([-scale, zero, scale * x / depth], axis=-1),
        np.stack([zero, -scale, scale * y / depth], axis=-1),
    ], axis=1)  # fmt: skip
    turned = np.cross(by_point, local[:, None])
    return np.concatenate([turned, -distance * by_point], axis=2)
