"""Corrections of common mistakes with axes, by name.

``svu check`` finds which of them explains the photographs better, ``svu import --fix NAME``
applies it; the names are the same. Each is relative to how the capture was read.
"""

from __future__ import annotations

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
class Fix:
    """One correction.

    Attributes:
        name: as ``--fix`` takes it.
        kind: what it changes: ``camera`` (all sensors), ``mesh`` (against the cameras), ``light``,
            ``texture`` or ``winding`` (which side of the surface is its front).
        cause: what probably went wrong, as half a sentence.
        matrix: (3, 3). ``camera``: multiplied from the right to each ``to_world``; ``mesh``: from
            the left to each position; ``light``: in the frame of Mitsuba's envmap, from the right
            to the emitter's rotation (det < 0: the map is mirrored left to right). None for
            ``camera-inverse``, ``texture-flip-v`` and ``mesh-inside-out``, which are not matrices.
    """

    name: str
    kind: Kind
    cause: str
    matrix: np.ndarray | None = None


def turned(axis: Literal["x", "y", "z"], degrees: float) -> np.ndarray:
    """Return the (3, 3) rotation about an axis; exact at multiples of 90 degrees."""
    matrix = scipy.spatial.transform.Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return matrix.round() if degrees % 90 == 0 else matrix


FIXES = {fix.name: fix for fix in (
    Fix("camera-x180", "camera",
        "OpenCV camera axes were read as OpenGL's, or the other way round", turned("x", 180)),
    Fix("camera-y180", "camera",
        "OpenGL camera axes were read as Mitsuba's, or the other way round", turned("y", 180)),
    Fix("camera-z180", "camera",
        "OpenCV camera axes were read as Mitsuba's, or the photographs are upside down",
        turned("z", 180)),
    Fix("camera-inverse", "camera", "the poses are world-to-camera, not camera-to-world"),
    Fix("mesh-x90", "mesh", "the mesh has +Y up, the poses have +Z up", turned("x", 90)),
    Fix("mesh-x270", "mesh", "the mesh has +Z up, the poses have +Y up", turned("x", 270)),
    Fix("mesh-x180", "mesh", "the mesh is upside down relative to the poses", turned("x", 180)),
    Fix("mesh-mirror", "mesh",
        "the mesh comes from a left-handed program", np.diag([-1.0, 1.0, 1.0])),
    Fix("light-turn-90", "light",
        "the centre of the environment map is elsewhere", turned("y", 90)),
    Fix("light-turn-180", "light",
        "the centre and the seam of the environment map are exchanged", turned("y", 180)),
    Fix("light-turn-270", "light",
        "the centre of the environment map is elsewhere", turned("y", 270)),
    Fix("light-mirror", "light",
        "the environment map was saved as seen from outside: left and right are exchanged",
        np.diag([-1.0, 1.0, 1.0])),
    Fix("light-flip", "light", "the environment map is upside down", turned("z", 180)),
    Fix("light-x90", "light",
        "the environment map has another axis up than the world", turned("x", 90)),
    Fix("light-x270", "light",
        "the environment map has another axis up than the world", turned("x", 270)),
    Fix("texture-flip-v", "texture", "V of the texture coordinates is flipped"),
    Fix("mesh-inside-out", "winding", "the faces of the mesh are wound the wrong way"),
)}  # fmt: skip


def fixes_named(names: Sequence[str]) -> tuple[Fix, ...]:
    """Return corrections by name."""
    require_known(names, FIXES, "fix")
    return tuple(FIXES[name] for name in names)


def turn_of(fixes: Sequence[Fix], kind: Literal["mesh", "light"]) -> np.ndarray:
    """Return the (3, 3) product of the corrections of mesh or light, see ``Fix.matrix``."""
    turn = np.eye(3)
    for fix in fixes:
        if fix.kind == kind and fix.matrix is not None:
            turn = fix.matrix @ turn if kind == "mesh" else turn @ fix.matrix
    return turn


def corrected_poses(poses: np.ndarray, fix: Fix, camera_axes: np.ndarray) -> np.ndarray:
    """Correct camera-to-world matrices (V, 4, 4); see ``apply_fixes`` for ``camera_axes``."""
    if fix.matrix is None:
        return np.linalg.inv(poses @ np.linalg.inv(camera_axes)) @ camera_axes
    return poses @ affine(fix.matrix)


def corrected_mesh(mesh: MeshArrays, fix: Fix) -> MeshArrays:
    """Return a mesh turned, mirrored, inside out, or with V flipped."""
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
