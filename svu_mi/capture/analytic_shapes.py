"""Meshes of Mitsuba's spheres, disks and cylinders, with Mitsuba's UVs and normals.

Rectangles and cubes are meshes already. Vertices lie on the surface: the largest distance of a
triangle from a sphere is 3e-4 of its radius.
"""

from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.mesh import MeshArrays, crosses_of, unit_vectors
from svu_mi.errors import SceneError, excerpt

AROUND, ALONG = 128, 64  # faces around the axis, and along the other parameter
ROUND = ("Sphere", "Cylinder")  # need equal scales in x and y
TOLERANCE = 1e-4  # relative difference of these scales
LARGEST_CONDITION = 1e6  # of the matrix of a shape; single precision resolves 1e-7


def analytic_mesh(shape: Any, label: str) -> MeshArrays:
    """Return the mesh of a sphere, disk or cylinder; raise for other shapes."""
    kind = shape.class_name()
    if kind not in ("Sphere", "Disk", "Cylinder"):
        raise SceneError(
            f"{label} ({excerpt(kind)}) is not a triangle mesh; convert it to a PLY or OBJ mesh "
            "with UVs."
        )
    matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
    _require_regular(matrix, kind, label)
    along, around = np.mgrid[: ALONG + 1, : AROUND + 1]
    angle = 2 * np.pi * (around % AROUND) / AROUND  # equal at both ends: the surface is closed
    t, a = along / ALONG, around / AROUND
    points, normals, uvs = _parametrised(kind, np.cos(angle), np.sin(angle), t, a)
    positions = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    turned = unit_vectors(normals.reshape(-1, 3) @ np.linalg.inv(matrix[:3, :3]))
    mirrored = kind == "Cylinder" and np.linalg.det(matrix[:3, :3]) < 0  # only these turn around
    turned = -turned if mirrored != shape.has_flipped_normals() else turned
    faces = _grid_faces(positions)
    against = np.einsum("fi,fi->", crosses_of(positions, faces), turned[faces[:, 0]]) < 0
    faces = faces[:, ::-1].copy() if against else faces
    return MeshArrays(positions, faces, turned, uvs.reshape(-1, 2))


def _parametrised(
    kind: str, cosine: np.ndarray, sine: np.ndarray, t: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return local points, local normals and UVs of the (along, around) grid.

    ``a`` is the angle / 2 pi, ``t`` in [0, 1] the radius, height or polar angle / pi.
    """
    zero = 0 * t
    if kind == "Disk":
        points = np.stack([t * cosine, t * sine, zero], axis=-1)
        return points, np.stack([zero, zero, zero + 1], axis=-1), np.stack([t, a], axis=-1)
    uvs = np.stack([a, t], axis=-1)
    if kind == "Cylinder":
        normals = np.stack([cosine, sine, zero], axis=-1)
        return np.stack([cosine, sine, t], axis=-1), normals, uvs
    ring = np.sin(np.pi * t) * (t % 1 > 0)  # exactly 0 at the poles
    points = np.stack([ring * cosine, ring * sine, np.cos(np.pi * t)], axis=-1)
    return points, points, uvs


def _grid_faces(positions: np.ndarray) -> np.ndarray:
    """Return the triangles of the grid, without those of no area at poles and centres."""
    corner = np.arange(len(positions)).reshape(ALONG + 1, AROUND + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = np.stack([np.stack([a, d, b], -1), np.stack([b, d, c], -1)], axis=2).reshape(-1, 3)
    area = np.linalg.norm(crosses_of(positions, faces), axis=1)
    return faces[area > 1e-9 * area.max()]


def _require_regular(matrix: np.ndarray, kind: str, label: str) -> None:
    """Raise for a ``to_world`` (4, 4) that is singular, or that Mitsuba does not follow."""
    if not np.isfinite(matrix).all():
        raise SceneError(f"{label} has a to_world that is NaN or infinite; correct it.")
    if np.linalg.cond(matrix[:3, :3]) > LARGEST_CONDITION:
        raise SceneError(f"{label} has a to_world that flattens it; correct its scale.")
    x, y, z = np.linalg.norm(matrix[:3, :3], axis=0)
    unequal = abs(x - y), abs(y - z) if kind == "Sphere" else 0
    if kind in ROUND and max(unequal) > TOLERANCE * max(x, y):
        raise SceneError(
            f"{label} ({kind}) has different scales along its axes, which Mitsuba ignores; "
            "convert it to a PLY or OBJ mesh with UVs."
        )
