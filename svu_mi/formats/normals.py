"""Which way a surface faces: winding and vertex normals that agree with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from svu_mi.capture.mesh import MeshArrays

AGREE = 0.6  # mean cosine between vertex normals and faces; sound files have .9, swapped axes .3


def repaired(mesh: MeshArrays, label: str) -> tuple[MeshArrays, list[str]]:
    """Turn a closed surface that is inside out, and replace normals that contradict it.

    Args:
        mesh: its buffers; normals may be missing.
        label: its file, for the notes.

    Returns:
        The mesh, with unit normals, and sentences about what was changed.
    """
    _, unique, inverse = np.unique(mesh.positions, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    # Without the cuts that UV seams are.
    welded = trimesh.Trimesh(mesh.positions[unique], inverse[mesh.faces], process=False)
    notes = []
    with np.errstate(all="ignore"):  # trimesh divides by the volume, which may be none
        is_inside_out = welded.is_watertight and welded.volume < 0
    if is_inside_out:
        notes.append(f"{label}: the surface was inside out; its triangles are flipped.")
        mesh = replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, ::-1]))
        welded.invert()
    smooth = np.array(welded.vertex_normals)[inverse]
    if mesh.normals is not None and not _agreement(mesh) >= AGREE:  # NaN fails, too
        notes.append(f"{label}: its normals contradict its triangles; they are computed again.")
        mesh = replace(mesh, normals=None)
    given = smooth if mesh.normals is None else mesh.normals
    return replace(mesh, normals=_unit(given, smooth)), notes


def _unit(normals: np.ndarray, instead: np.ndarray) -> np.ndarray:
    """Return unit normals; those of no length are taken from elsewhere, or point up."""
    for other in (instead, np.broadcast_to([0.0, 0.0, 1.0], normals.shape)):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), other)
    return normals


def _agreement(mesh: MeshArrays) -> float:
    """Return the mean cosine, by area, between faces and the normals of their corners."""
    assert mesh.normals is not None
    a, b, c = (mesh.positions[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)  # twice the area long
    mean = mesh.normals[mesh.faces].mean(axis=1)
    twice_area = np.linalg.norm(cross, axis=1).sum()
    return float(np.einsum("fi,fi->", cross, mean) / max(twice_area, 1e-300))
