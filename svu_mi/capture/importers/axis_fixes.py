"""Named corrections of common mistakes with coordinate axes.

``svu check`` finds the correction that explains the photographs better; ``svu import --fix NAME``
applies it. Each correction is relative to the axes that the capture was read with.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy

from svu_mi.capture.mesh import MeshArrays, flipped_v
from svu_mi.capture.sensors import affine
from svu_mi.core.validation import require_known

Kind = Literal["camera", "mesh", "light", "texture", "winding"]


@dataclass(frozen=True)
class AxisFix:
    """Correction of a mistake with axes.

    Attributes:
        name: name for ``--fix``.
        kind: corrected part: ``camera`` (all sensors), ``mesh`` (relative to the cameras),
            ``light``, ``texture`` or ``winding`` (front side of the surface).
        cause: probable mistake, as a clause for messages.
        matrix: (3, 3). ``camera``: multiplied from the right to each ``to_world``; ``mesh``: from
            the left to each position; ``light``: in the frame of Mitsuba's envmap, from the right
            to the emitter's rotation (det < 0: the map is mirrored left to right). None for
            ``camera-inverse``, ``texture-flip-v`` and ``mesh-inside-out``, which are not matrices.
    """

    name: str
    kind: Kind
    cause: str
    matrix: np.ndarray | None = None


def rotation(axis: Literal["x", "y", "z"], degrees: float) -> np.ndarray:
    """Return the (3, 3) rotation about an axis; exact at multiples of 90 degrees."""
    matrix = scipy.spatial.transform.Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return matrix.round() if degrees % 90 == 0 else matrix


FIXES = {fix.name: fix for fix in (
    AxisFix("camera-x180", "camera",
        "OpenCV camera axes were read as OpenGL's, or vice versa", rotation("x", 180)),
    AxisFix("camera-y180", "camera",
        "OpenGL camera axes were read as Mitsuba's, or vice versa", rotation("y", 180)),
    AxisFix("camera-z180", "camera",
        "OpenCV camera axes were read as Mitsuba's, or the photographs are upside down",
        rotation("z", 180)),
    AxisFix("camera-inverse", "camera", "the poses are world-to-camera, not camera-to-world"),
    AxisFix("mesh-x90", "mesh", "the mesh has +Y up, the poses have +Z up", rotation("x", 90)),
    AxisFix("mesh-x270", "mesh", "the mesh has +Z up, the poses have +Y up", rotation("x", 270)),
    AxisFix("mesh-x180", "mesh",
        "the mesh is upside down relative to the poses", rotation("x", 180)),
    AxisFix("mesh-mirror", "mesh",
        "the mesh comes from a left-handed program", np.diag([-1.0, 1.0, 1.0])),
    AxisFix("light-turn-90", "light",
        "the environment map has another direction in its centre", rotation("y", 90)),
    AxisFix("light-turn-180", "light",
        "the centre and the seam of the environment map are exchanged", rotation("y", 180)),
    AxisFix("light-turn-270", "light",
        "the environment map has another direction in its centre", rotation("y", 270)),
    AxisFix("light-mirror", "light",
        "the environment map was saved as seen from outside: left and right are exchanged",
        np.diag([-1.0, 1.0, 1.0])),
    AxisFix("light-flip", "light", "the environment map is upside down", rotation("z", 180)),
    AxisFix("light-x90", "light",
        "the environment map has another up axis than the world", rotation("x", 90)),
    AxisFix("light-x270", "light",
        "the environment map has another up axis than the world", rotation("x", 270)),
    AxisFix("texture-flip-v", "texture", "V of the texture coordinates is flipped"),
    AxisFix("mesh-inside-out", "winding", "the faces of the mesh are wound the wrong way"),
)}  # fmt: skip


PLACES = {
    "camera": "as the first element in to_world of each sensor (in capture.json: from the right)",
    "light": "as the first element in to_world of the emitter",
    "mesh": "as the last element in to_world of the shape",
}


def find_fixes(names: Sequence[str]) -> tuple[AxisFix, ...]:
    """Return the corrections of the given names."""
    require_known(names, FIXES, "fix")
    return tuple(FIXES[name] for name in names)


def fix_rotation(fixes: Sequence[AxisFix], kind: Literal["mesh", "light"]) -> np.ndarray:
    """Return the product (3, 3) of the matrices of all corrections of one ``kind``."""
    turn = np.eye(3)
    for fix in fixes:
        if fix.kind == kind and fix.matrix is not None:
            turn = fix.matrix @ turn if kind == "mesh" else turn @ fix.matrix
    return turn


def correct_poses(poses: np.ndarray, fix: AxisFix, camera_axes: np.ndarray) -> np.ndarray:
    """Correct camera-to-world matrices (V, 4, 4); ``camera_axes`` as in ``Source``."""
    if fix.matrix is None:
        return np.linalg.inv(poses @ np.linalg.inv(camera_axes)) @ camera_axes
    return poses @ affine(fix.matrix)


def correct_mesh(mesh: MeshArrays, fix: AxisFix) -> MeshArrays:
    """Return the corrected mesh: rotated, mirrored, turned inside out, or with flipped V."""
    if fix.kind == "winding":
        normals = None if mesh.normals is None else -mesh.normals
        return replace(mesh, normals=normals, faces=mesh.faces[:, ::-1])
    if fix.matrix is None:
        return replace(mesh, uvs=None if mesh.uvs is None else flipped_v(mesh.uvs))
    mirrored = np.linalg.det(fix.matrix) < 0
    return replace(
        mesh,
        positions=mesh.positions @ fix.matrix.T,
        normals=None if mesh.normals is None else mesh.normals @ fix.matrix.T,
        faces=mesh.faces[:, ::-1] if mirrored else mesh.faces,
    )


def scene_edit(fix: AxisFix) -> str:
    """Return the edit of a Mitsuba scene that makes a correction, or its cause."""
    if fix.matrix is None:
        return f"{fix.name} ({fix.cause})"
    if np.linalg.det(fix.matrix) < 0:
        element = '<scale x="-1"/>'
    else:
        turn = scipy.spatial.transform.Rotation.from_matrix(fix.matrix).as_rotvec(degrees=True)
        axis = int(np.abs(turn).argmax())
        element = f'<rotate {"xyz"[axis]}="1" angle="{turn[axis]:.0f}"/>'
    return f"{element} {PLACES[fix.kind]}"
