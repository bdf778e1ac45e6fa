"""Every combination of known mistakes that a check has to tell apart."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from itertools import product

import numpy as np

from svu_mi.capture.poses import affine
from svu_mi.formats.fixes import FIXES, Fix, Kind, corrected_poses, turn_of
from svu_mi.formats.source import OPENCV, OPENGL

CAMERA_AXES = (np.eye(4), OPENGL, OPENCV)  # that a file may have had before it was imported


@dataclass(frozen=True)
class Hypothesis:
    """Corrections that may have to be made, either of cameras and mesh or of the light.

    Attributes:
        fixes: in the order they are applied; none says that all is right.
        camera_axes: (4, 4), for ``camera-inverse``, see ``apply_fixes``.
    """

    fixes: tuple[Fix, ...] = ()
    camera_axes: np.ndarray = field(default_factory=lambda: np.eye(4))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the corrections."""
        return tuple(fix.name for fix in self.fixes)

    def relative_poses(self, poses: np.ndarray) -> np.ndarray:
        """Return where the cameras stand against the mesh as it is.

        A mesh that is turned is the same as cameras that are turned back, so that one scene
        serves all hypotheses.

        Args:
            poses: (V, 4, 4) camera-to-world matrices as they are.
        """
        for fix in self.fixes:
            if fix.kind == "camera":
                poses = corrected_poses(poses, fix, self.camera_axes)
            elif fix.matrix is not None:
                poses = affine(fix.matrix.T) @ poses
        return poses


def _known(kind: Kind) -> list[Fix]:
    return [fix for fix in FIXES.values() if fix.kind == kind]


@cache
def pose_hypotheses() -> tuple[Hypothesis, ...]:
    """Return all combinations of wrong camera axes, inverse poses, and a wrong mesh.

    The first corrects nothing, then come single corrections.
    """
    inverse = FIXES["camera-inverse"]
    turns = [(), *((fix,) for fix in _known("camera") if fix is not inverse)]
    cameras = [(turn, np.eye(4)) for turn in turns]
    cameras += [((inverse, *turn), axes) for turn, axes in product(turns, CAMERA_AXES)]
    meshes = [(), *((fix,) for fix in _known("mesh"))]
    combined = [
        Hypothesis(camera + mesh, axes) for (camera, axes), mesh in product(cameras, meshes)
    ]
    return tuple(sorted(combined, key=lambda one: len(one.fixes)))


@cache
def light_hypotheses() -> tuple[Hypothesis, ...]:
    """Return the 48 ways to put a map's axes on those of the world, each in the fewest words.

    The first corrects nothing, then come single corrections.
    """
    queue = [Hypothesis()]
    found = {}
    for known in queue:  # grows while it is walked through: shortest first
        key = turn_of(known.fixes, "light").astype(int).tobytes()  # axes go to axes
        if key not in found:
            found[key] = known
            queue += [Hypothesis((*known.fixes, fix)) for fix in _known("light")]
    return tuple(found.values())
