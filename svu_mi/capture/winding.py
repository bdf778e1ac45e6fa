"""Which side of a surface the cameras see, its front or its back.

The front is where vertex normals point to, or else the winding of the triangles. Only a closed
surface has an inside that tells whether that is right; a plate, a scanned wall, a vase without a
bottom have not. Nothing is found about the back of a surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.mesh import MeshArrays, arrays, faces_at
from svu_mi.capture.scene import is_closed, to_world
from svu_mi.interop import evenly_spaced, owned

MOST = 0.6  # of what is seen, from which the front is wrong; a plate seen from both sides has .5
POINTS, EYES = 400, 32  # that are looked at, and from
OFFSET = 1e-4  # of the object's size, that rays start above the surface


def seen_from_behind(scene: Any, shape: Any, sensors: Sequence[Any]) -> list[str]:
    """Say that the cameras see mostly the back of an object, if they do.

    Args:
        scene: with the object and what hides it.
        shape: the object, a mesh.
        sensors: V of them.
    """
    mesh = arrays(shape)
    behind = part_from_behind(scene, mesh, [to_world(each)[:3, 3] for each in sensors])
    if behind < MOST:
        return []
    if has_front_outside(mesh):
        return [
            f"Shape '{shape.id()}': {behind:.0%} of what the photographs show of it is its back; "
            "it is closed, so the cameras are inside it: see that its units are those of the poses."
        ]
    return [
        f"Shape '{shape.id()}': {behind:.0%} of what the photographs show of it is its back, where "
        "nothing is found; its normals point the wrong way: set flip_normals on the shape."
    ]


def has_front_outside(mesh: MeshArrays) -> bool:
    """Return whether a surface is closed, and its front is where its volume is not."""
    if not is_closed(mesh):
        return False
    cross, first = mesh.crosses, mesh.positions[mesh.faces[:, 0]] - mesh.positions.mean(axis=0)
    volume = np.einsum("fi,fi->", first, cross)
    if mesh.normals is not None:
        volume *= np.sign(np.einsum("fi,fki->", cross, mesh.normals[mesh.faces]))
    return bool(volume > 0)


def part_from_behind(scene: Any, mesh: MeshArrays, eyes: Sequence[np.ndarray]) -> float:
    """Return how much of what is seen of a surface is its back, in [0, 1], by apparent area.

    Args:
        scene: what hides, with the surface itself.
        mesh: its buffers.
        eyes: V positions (3,) of cameras, which are taken to look at it.
    """
    cross = mesh.crosses
    if not cross.any() or not len(eyes):
        return 0.0
    face = faces_at(cross, (np.arange(POINTS) + 0.5) / POINTS)
    point = mesh.positions[mesh.faces[face]].mean(axis=1)
    normal = cross[face] / np.linalg.norm(cross[face], axis=1, keepdims=True)
    if mesh.normals is not None:
        pointing = mesh.normals[mesh.faces[face]].sum(axis=1)
        normal *= np.where(np.einsum("ni,ni->n", normal, pointing) < 0, -1, 1)[:, None]
    chosen = evenly_spaced(len(eyes), EYES)
    toward = np.array(eyes, np.float64)[chosen][:, None] - point
    distance = np.linalg.norm(toward, axis=2)
    direction = toward / np.maximum(distance, 1e-300)[..., None]
    cosine = np.einsum("vni,ni->vn", direction, normal)
    above = OFFSET * np.linalg.norm(np.ptp(mesh.positions, axis=0)) * np.sign(cosine)
    start = point + above[..., None] * normal
    free = _is_free(scene, start.reshape(-1, 3), direction.reshape(-1, 3), distance.ravel())
    seen = np.abs(cosine) * free.reshape(cosine.shape) / np.maximum(distance, 1e-300) ** 2
    return float(seen[cosine < 0].sum() / max(seen.sum(), 1e-300))


def _is_free(
    scene: Any, start: np.ndarray, direction: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """Return whether nothing is on the way: (N,) bool."""
    ray = mi.Ray3f(
        owned(mi.Point3f, start.T.astype(np.float32)),
        owned(mi.Vector3f, direction.T.astype(np.float32)),
    )
    ray.maxt = owned(mi.Float, distance.astype(np.float32))
    return np.array(~scene.ray_test(ray), bool)
