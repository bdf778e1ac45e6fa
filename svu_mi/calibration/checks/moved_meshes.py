"""Comparison of a mesh with itself, turned and moved: does its place matter to the photographs?

Without masks, poses and mesh are judged by image gradients along the outline and by the agreement
of views. Both are only evidence if they are better than those of the same mesh in other places.
"""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from svu_mi.calibration.checks.axis_hypotheses import AxisHypothesis
from svu_mi.calibration.checks.pose_scores import SMALL, VIEWS, silhouette_fit
from svu_mi.calibration.checks.surface_samples import Points, agreement, sample_points
from svu_mi.calibration.checks.thumbnails import (
    Thumbnails,
    limit_views,
    reduce_photographs,
    silhouettes,
)
from svu_mi.capture.capture import Capture
from svu_mi.capture.importers.axis_fixes import rotation
from svu_mi.capture.sensors import affine

AXES: tuple[Literal["x", "y", "z"], ...] = ("x", "y", "z")
COUNT = 600  # compared points
TURN = 20.0  # degrees
STEP = 0.1  # in diagonals of the mesh
# Smallest advantages over the mean of moved meshes. Sound captures of our own scenes have at least
# 0.13 and 0.26, those of another mesh at most 0.03 and 0.03.
LEAST_CONTRAST, LEAST_AGREEMENT = 0.06, 0.1


class Advantage(NamedTuple):
    """Outline contrast and agreement of views, minus the means of moved meshes."""

    contrast: float
    agreement: float

    @property
    def is_clear(self) -> bool:
        """True if one of both shows that the mesh is in its place."""
        return self.contrast >= LEAST_CONTRAST or self.agreement >= LEAST_AGREEMENT

    @staticmethod
    def of(capture: Capture, points: Points, hypothesis: AxisHypothesis) -> "Advantage":
        """Compare the mesh of a reduced capture with moved ones, under corrections."""
        frames = Thumbnails.of(limit_views(reduce_photographs(capture, SMALL), VIEWS))
        few, (_, judge) = points.subset(COUNT), silhouette_fit(frames)
        cues = []
        for move in (np.eye(4), *_moves(points)):
            posed = frames.posed(hypothesis.relative_poses(np.linalg.inv(move) @ frames.poses))
            views = agreement(sample_points(few, posed), frames.spread)
            cues.append((float(judge(silhouettes(posed)).mean()), views))
        contrast, agree = (here - float(np.mean(moved)) for here, *moved in zip(*cues, strict=True))
        return Advantage(contrast, agree)


def _moves(points: Points) -> Iterator[np.ndarray]:
    """Yield rigid motions (4, 4) of a mesh: steps and turns about its centre, both ways."""
    low, high = points.position.min(axis=0), points.position.max(axis=0)
    center, size = (low + high) / 2, float(np.linalg.norm(high - low))
    for number, axis in enumerate(AXES):
        for sign in (1, -1):
            yield affine(np.eye(3), sign * STEP * size * np.eye(3)[number])
            turn = rotation(axis, sign * TURN)
            yield affine(turn, center - turn @ center)
