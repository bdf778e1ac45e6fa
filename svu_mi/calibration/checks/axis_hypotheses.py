"""Combinations of axis mistakes, and their corrections applied to a loaded capture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import product

import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.importers.axis_fixes import (
    FIXES,
    AxisFix,
    Kind,
    correct_mesh,
    correct_poses,
    fix_rotation,
)
from svu_mi.capture.importers.source import OPENCV, OPENGL
from svu_mi.capture.mesh import MeshArrays, arrays, make_mesh
from svu_mi.capture.replace_material import make_scene, other_shapes
from svu_mi.capture.scene import environment_of, to_world
from svu_mi.capture.sensors import affine, changed_sensor
from svu_mi.light.environment import read_environment
from svu_mi.light.prefiltered import rasterized

CONVENTION = np.eye(4)  # camera axes of the file, see ``importers.source``
CAMERA_AXES = (CONVENTION, OPENGL, OPENCV)  # possible axes before the import
FEWER = 0.02  # cost of a correction, subtracted from scores


@dataclass(frozen=True)
class AxisHypothesis:
    """Corrections of cameras and mesh, or of the light, in the order of application.

    ``camera_axes``: (4, 4) matrix, see ``apply_fixes``.
    """

    fixes: tuple[AxisFix, ...] = ()
    camera_axes: np.ndarray = field(default_factory=lambda: np.eye(4))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the corrections."""
        return tuple(fix.name for fix in self.fixes)

    def relative_poses(self, poses: np.ndarray) -> np.ndarray:
        """Return corrected poses (V, 4, 4) for use with the uncorrected mesh of the scene."""
        for fix in self.fixes:
            if fix.kind == "camera":
                poses = correct_poses(poses, fix, self.camera_axes)
            elif fix.matrix is not None:
                poses = affine(fix.matrix.T) @ poses
        return poses


def _fixes_of(kind: Kind) -> list[AxisFix]:
    return [fix for fix in FIXES.values() if fix.kind == kind]


@cache
def pose_hypotheses() -> tuple[AxisHypothesis, ...]:
    """Return all combinations of camera axes, inverted poses and mesh corrections.

    They are sorted by the number of corrections, from 0.
    """
    inverse = FIXES["camera-inverse"]
    turns = [(), *((fix,) for fix in _fixes_of("camera") if fix is not inverse)]
    cameras = [(turn, np.eye(4)) for turn in turns]
    cameras += [((inverse, *turn), axes) for turn, axes in product(turns, CAMERA_AXES)]
    meshes = [(), *((fix,) for fix in _fixes_of("mesh"))]
    combined = [
        AxisHypothesis(camera + mesh, axes) for (camera, axes), mesh in product(cameras, meshes)
    ]
    return tuple(sorted(combined, key=lambda one: len(one.fixes)))


@cache
def light_hypotheses() -> tuple[AxisHypothesis, ...]:
    """Return the 48 orientations of a map, each as the shortest list of corrections.

    They are sorted by the number of corrections, from 0.
    """
    queue = [AxisHypothesis()]
    by_rotation = {}
    for hypothesis in queue:  # grows during the loop: breadth-first search
        turn = fix_rotation(hypothesis.fixes, "light")
        key = turn.astype(int).tobytes()  # entries are -1, 0 or 1
        if key not in by_rotation:
            by_rotation[key] = hypothesis
            queue += [AxisHypothesis((*hypothesis.fixes, fix)) for fix in _fixes_of("light")]
    return tuple(by_rotation.values())


def apply_fixes(
    capture: Capture, fixes: Sequence[AxisFix], camera_axes: np.ndarray = CONVENTION
) -> Capture:
    """Return a copy of a capture with corrections applied in order.

    ``camera_axes``: (4, 4) matrix A of the importer, which replaced camera-to-world matrices C by
    C A; only used by ``camera-inverse``.
    """
    for fix in fixes:
        if fix.kind == "camera":
            poses = np.array([to_world(sensor) for sensor in capture.sensors]).reshape(-1, 4, 4)
            poses = correct_poses(poses, fix, camera_axes)
            capture = replace(capture, sensors=tuple(
                changed_sensor(sensor, to_world=pose.tolist())
                for sensor, pose in zip(capture.sensors, poses, strict=True)
            ))  # fmt: skip
        elif fix.kind == "light":
            capture = _with_turned_light(capture, fix)
        else:
            capture = with_changed_mesh(capture, partial(correct_mesh, fix=fix))
    return capture


def with_changed_mesh(capture: Capture, change: Callable[[MeshArrays], MeshArrays]) -> Capture:
    """Return the capture with another mesh of the object, of the same material."""
    shape = make_mesh(capture.shape.id(), change(arrays(capture.shape)))
    shape.set_bsdf(capture.shape.bsdf())
    mesh = shape
    if capture.mesh is not capture.shape:
        mesh = make_mesh(capture.mesh.id(), change(arrays(capture.mesh)))
    others = other_shapes(capture.scene, capture.shape)
    scene = make_scene([shape, *capture.scene.emitters(), *others])
    return replace(capture, shape=shape, mesh=mesh, scene=scene)


def _with_turned_light(capture: Capture, fix: AxisFix) -> Capture:
    """Return the capture with its light rotated; constant light stays, a sky becomes a map."""
    emitter = environment_of(capture)
    if emitter.class_name() == "ConstantBackgroundEmitter":
        return capture
    turned = to_world(emitter) @ affine(fix.matrix)
    if emitter.class_name() == "EnvironmentMapEmitter":
        params = mi.traverse(emitter)
        bitmap = params["data"].numpy()[:, 1:-1]  # Mitsuba 3.9 keeps a halo column on each side
        scale = float(np.array(params["scale"]).ravel()[0])
    else:
        bitmap, scale = rasterized(read_environment(emitter)), 1.0
    light = mi.load_dict({
        "type": "envmap",
        "id": emitter.id(),
        "bitmap": mi.Bitmap(np.ascontiguousarray(bitmap, np.float32)),
        "scale": scale,
        "to_world": mi.ScalarTransform4f(turned),
    })  # fmt: skip
    scene = make_scene([*capture.scene.shapes(), light])
    return replace(capture, scene=scene, light_uncertainty=None, found_light=None)
