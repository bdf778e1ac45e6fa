"""The asset's mesh in trimesh's terms, and in those of everybody but Mitsuba."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from svu_mi.capture.mesh import MeshArrays, flipped_v


def as_trimesh(
    mesh: MeshArrays, visual: Any, attributes: Mapping[str, np.ndarray] | None = None
) -> Any:
    """Make a ``trimesh.Trimesh`` with the same vertices in the same order.

    Args:
        mesh: its normals are kept; a mesh without has none afterwards.
        visual: its looks (``trimesh.visual``).
        attributes: values of the vertices, by name.
    """
    import trimesh

    return trimesh.Trimesh(
        mesh.positions, front_faces(mesh), vertex_normals=mesh.normals, visual=visual,
        vertex_attributes=dict(attributes or {}), process=False,
    )  # fmt: skip


def front_faces(mesh: MeshArrays) -> np.ndarray:
    """Return (F, 3) faces wound counter-clockwise as seen from where their normals point.

    Mitsuba goes by normals; everybody else shows or hides a face by its winding.
    """
    if mesh.normals is None:
        return mesh.faces
    normal = mesh.normals[mesh.faces].sum(axis=1)
    away = np.einsum("fi,fi->f", mesh.crosses, normal) < 0
    return np.where(away[:, None], mesh.faces[:, ::-1], mesh.faces)


def upward_uvs(mesh: MeshArrays) -> np.ndarray:
    """Return (N, 2) UVs with v = 0 at the bottom of an image, as trimesh and OBJ have them."""
    assert mesh.uvs is not None
    return flipped_v(mesh.uvs)
