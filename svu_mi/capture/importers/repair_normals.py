"""Repair of winding and vertex normals of meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
import trimesh

from svu_mi.capture.mesh import MeshArrays, crosses_of

CREASE = 40  # degrees between triangles from which the edge between them is one
# A scan whose points are off by a fifth of the way between them has creases at 13 to 17 % of its
# edges; triangles of parts that were designed have more, but at least a third lie in a plane.
NOISY, FLAT, DENSE = 0.1, 0.25, 4000  # parts of all edges, and triangles from which they count
PLANE = 5  # degrees between triangles that lie in a plane
AGREE = 0.6  # mean cosine between vertex normals and faces; sound files have .9, swapped axes .3


def repair_normals(mesh: MeshArrays, label: str) -> tuple[MeshArrays, list[str]]:
    """Turn a closed surface that is inside out; replace normals that are missing or contradict it.

    Computed normals are smooth, except at edges, where vertices get one on each side. A scan with
    many edges is noisy and smoothed everywhere.

    Returns:
        The mesh, with unit normals, and sentences about changes of the file ``label``.
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
    if mesh.normals is not None:
        cross = mesh.crosses
        cosines = np.einsum("fi,fi->", cross, mesh.normals[mesh.faces].mean(axis=1))
        twice_area = np.linalg.norm(cross, axis=1).sum()
        if cosines >= AGREE * max(twice_area, 1e-300):  # NaN fails, too
            smooth = np.array(welded.vertex_normals)[inverse]
            return replace(mesh, normals=_unit_normals(mesh.normals, smooth)), notes
        notes.append(f"{label}: its normals contradict its triangles; they are computed again.")
    shaded, is_noisy = _with_computed_normals(mesh, welded)
    if is_noisy:
        notes.append(
            f"{label}: normals are computed; the surface is too noisy to tell edges from noise, so "
            "none is kept sharp."
        )
    elif len(shaded.positions) > len(np.unique(mesh.faces)):
        notes.append(
            f"{label}: normals are computed; edges of more than {CREASE} degrees are kept sharp."
        )
    return shaded, notes


def _with_computed_normals(mesh: MeshArrays, welded: trimesh.Trimesh) -> tuple[MeshArrays, bool]:
    """Compute angle-weighted normals; also return whether the surface is noisy.

    Corners at a vertex share a normal if they are connected by edges without a crease. A
    vertex with several normals is duplicated.
    """
    cross = crosses_of(welded.vertices, welded.faces)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    normal = cross / np.maximum(length, 1e-300)
    count = mesh.faces.size
    pairs, are_two = _corners_at_edges(welded.faces)
    first, second = pairs[:, :, 0] // 3
    cosine = np.einsum("ei,ei->e", normal[first], normal[second])
    flat = (length[first] * length[second])[:, 0] == 0  # a triangle without area creases nothing
    is_noisy = _is_noisy(cosine[are_two & ~flat], len(welded.faces))
    is_smooth = flat | (cosine > np.cos(np.radians(CREASE))) | (is_noisy & are_two)
    smooth = pairs[:, is_smooth].reshape(2, -1)
    ones = np.ones(smooth.shape[1], np.int8)
    links = scipy.sparse.coo_array((ones, smooth), shape=(count, count))
    fan = scipy.sparse.csgraph.connected_components(links, directed=False)[1]
    weighted = np.nan_to_num(welded.face_angles)[..., None] * normal[:, None]
    total = np.stack([np.bincount(fan, weighted[..., k].ravel()) for k in range(3)], axis=-1)
    is_real = np.linalg.norm(total, axis=1) > 0
    fan = _fill_empty_fans(fan, is_real[fan], welded.faces.ravel())
    key = mesh.faces.ravel() * count + fan
    _, corner, faces = np.unique(key, return_index=True, return_inverse=True)
    vertex = mesh.faces.ravel()[corner]
    shaded = MeshArrays(
        positions=mesh.positions[vertex],
        faces=faces.reshape(mesh.faces.shape),
        normals=_unit_normals(total[fan[corner]], np.zeros(3)),
        uvs=None if mesh.uvs is None else mesh.uvs[vertex],
    )
    return shaded, is_noisy


def _is_noisy(cosine: np.ndarray, triangles: int) -> bool:
    """Return whether creases are noise, from the cosines (E,) between triangles at edges."""
    if triangles < DENSE or not len(cosine):
        return False
    crease, flat = np.cos(np.radians([CREASE, PLANE]))
    return bool((cosine < crease).mean() > NOISY and (cosine > flat).mean() < FLAT)


def _fill_empty_fans(fan: np.ndarray, is_real: np.ndarray, vertex: np.ndarray) -> np.ndarray:
    """Give corners (N,) of triangles without area a fan of their vertex that has a normal."""
    real = np.full(vertex.max() + 1, -1)
    real[vertex[is_real]] = fan[is_real]
    return np.where(is_real | (real[vertex] < 0), fan, real[vertex])


def _corners_at_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (2, E, 2) at both ends of each edge, of one triangle and another.

    Also return (E,) whether the edge has only these two. Triangle f has the corners 3 f to 3 f + 2.
    """
    sides = [[0, 1], [1, 2], [2, 0]]
    ends = faces[:, sides].reshape(-1, 2)
    corners = np.arange(faces.size).reshape(-1, 3)[:, sides].reshape(-1, 2)
    along = np.argsort(ends, axis=1)
    ends, corners = (np.take_along_axis(each, along, axis=1) for each in (ends, corners))
    order = np.lexsort(ends.T)
    ends, corners = ends[order], corners[order]
    same = (ends[1:] == ends[:-1]).all(axis=1)
    others = np.concatenate([[False], same[:-1]]) | np.concatenate([same[1:], [False]])
    return np.stack([corners[:-1][same], corners[1:][same]]), ~others[same]


def _unit_normals(normals: np.ndarray, instead: np.ndarray) -> np.ndarray:
    """Return unit normals; zero vectors are replaced by ``instead``, or point up."""
    for other in (instead, np.array([0.0, 0.0, 1.0])):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), other)
    return normals
