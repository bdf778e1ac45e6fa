"""Corrections of axes on a live capture; nothing of the original is modified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.mesh import arrays, make
from svu_mi.capture.poses import affine, describe, make_sensor
from svu_mi.capture.repaint import is_same, scene_of
from svu_mi.capture.scene import find_environment, to_world
from svu_mi.formats.fixes import Fix, corrected_mesh, corrected_poses
from svu_mi.light.environment import read_environment
from svu_mi.light.levels import resolved

CONVENTION = np.eye(4)  # of the cameras' axes in the file, see ``formats.source``


def apply_fixes(
    capture: Capture, fixes: Sequence[Fix], camera_axes: np.ndarray = CONVENTION
) -> Capture:
    """Return the capture with corrections applied, one after the other.

    Args:
        capture: the photographs, and what they are said to show.
        fixes: see ``formats.fixes``.
        camera_axes: (4, 4), what the importer multiplied camera-to-world matrices by from the
            right; ``camera-inverse`` alone depends on it.
    """
    for fix in fixes:
        capture = _applied(capture, fix, camera_axes)
    return capture


def _applied(capture: Capture, fix: Fix, camera_axes: np.ndarray) -> Capture:
    if fix.kind == "camera":
        poses = corrected_poses(_poses(capture), fix, camera_axes)
        moved = zip(capture.sensors, poses, strict=True)
        return replace(capture, sensors=tuple(_moved(sensor, pose) for sensor, pose in moved))
    if fix.kind == "light":
        return _lit(capture, fix)
    return _shaped(capture, fix)


def _poses(capture: Capture) -> np.ndarray:
    return np.array([to_world(sensor) for sensor in capture.sensors]).reshape(-1, 4, 4)


def _moved(sensor: Any, pose: np.ndarray) -> Any:
    return make_sensor({**describe(sensor), "to_world": pose.tolist()}, sensor.id())


def _shaped(capture: Capture, fix: Fix) -> Capture:
    """Replace the object by one that is turned, mirrored, or textured the other way round."""
    shape = make(capture.shape.id(), corrected_mesh(arrays(capture.shape), fix))
    shape.set_bsdf(capture.shape.bsdf())
    mesh = shape
    if capture.mesh is not capture.shape:
        mesh = make(capture.mesh.id(), corrected_mesh(arrays(capture.mesh), fix))
    others = [s for s in capture.scene.shapes() if not is_same(s, capture.shape)]
    return replace(
        capture, shape=shape, mesh=mesh, scene=scene_of([shape, *capture.scene.emitters(), *others])
    )


def _lit(capture: Capture, fix: Fix) -> Capture:
    """Turn the light; a constant one looks the same from everywhere, a sky becomes a map."""
    emitter = find_environment(capture.scene, str(capture.source or "scene"))
    if emitter.class_name() == "ConstantBackgroundEmitter":
        return capture
    turned = to_world(emitter) @ affine(fix.matrix)
    if emitter.class_name() == "EnvironmentMapEmitter":
        params = mi.traverse(emitter)
        bitmap = params["data"].numpy()[:, 1:-1]  # Mitsuba 3.9 keeps a halo column on each side
        scale = float(np.array(params["scale"]).ravel()[0])
    else:
        bitmap, scale = resolved(read_environment(emitter)), 1.0
    light = mi.load_dict({
        "type": "envmap",
        "id": emitter.id(),
        "bitmap": mi.Bitmap(np.ascontiguousarray(bitmap, np.float32)),
        "scale": scale,
        "to_world": mi.ScalarTransform4f(turned),
    })  # fmt: skip
    scene = scene_of([*capture.scene.shapes(), light])
    return replace(capture, scene=scene, doubt=None, found_light=None)
