"""Repair of winding and vertex normals of meshes."""

from dataclasses import replace

import numpy as np
import scipy
import trimesh

from svu_mi.capture.mesh import MeshArrays, crosses_of

CREASE = 40  # degrees between two triangles, from which their edge is a crease
# In scans with errors of a fifth of the point distance, 13 to 17 % of the edges are creases.
# Designed parts have more creases, but at least a third of their edges is flat.
NOISY, FLAT, DENSE = 0.1, 0.25, 4000  # shares of edges; smallest number of triangles
PLANE = 5  # degrees between two triangles, below which their edge is flat
AGREE = 0.6  # mean cosine of vertex and face normals; correct files have .9, swapped axes .3


def repair_normals(mesh: MeshArrays, label: str) -> tuple[MeshArrays, list[str]]:
    """Orient a closed surface outwards; compute normals that are missing or wrong.

    Computed normals are smooth except at creases, where vertices get one normal per side. A scan
    with many creases counts as noisy and becomes smooth everywhere.

    Returns:
        Mesh with unit normals, and sentences about the changes; ``label`` is the file's name.
    """
    _, unique, inverse = np.unique(mesh.positions, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    # Merge the vertices that UV seams have split.
    welded = trimesh.Trimesh(mesh.positions[unique], inverse[mesh.faces], process=False)
    notes = []
    with np.errstate(all="ignore"):  # trimesh divides by the volume, which may be 0
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
            f"{label}: normals are computed; the surface is too noisy to detect edges, so none are "
            "kept sharp."
        )
    elif len(shaded.positions) > len(np.unique(mesh.faces)):
        notes.append(
            f"{label}: normals are computed; edges of more than {CREASE} degrees are kept sharp."
        )
    return shaded, notes


def _with_computed_normals(mesh: MeshArrays, welded: trimesh.Trimesh) -> tuple[MeshArrays, bool]:
    """Compute angle-weighted normals; also return whether the surface is noisy.

    Corners at a vertex form a fan, with one normal, if edges without a crease connect them. A
    vertex with several fans is duplicated.
    """
    cross = crosses_of(welded.vertices, welded.faces)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    normal = cross / np.maximum(length, 1e-300)
    count = mesh.faces.size
    pairs, are_two = _corners_at_edges(welded.faces)
    first, second = pairs[:, :, 0] // 3
    cosine = np.einsum("ei,ei->e", normal[first], normal[second])
    flat = (length[first] * length[second])[:, 0] == 0  # triangles without area have no creases
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
    """Return whether creases are noise, from the cosine (E,) of the angle at each edge."""
    if triangles < DENSE or not len(cosine):
        return False
    crease, flat = np.cos(np.radians([CREASE, PLANE]))
    return bool((cosine < crease).mean() > NOISY and (cosine > flat).mean() < FLAT)


def _fill_empty_fans(fan: np.ndarray, is_real: np.ndarray, vertex: np.ndarray) -> np.ndarray:
    """Assign corners (N,) of triangles without area to another fan of their vertex."""
    real = np.full(vertex.max() + 1, -1)
    real[vertex[is_real]] = fan[is_real]
    return np.where(is_real | (real[vertex] < 0), fan, real[vertex])


def _corners_at_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (2, E, 2) at both ends of edges, in both adjacent triangles.

    Also return (E,) True for edges of exactly two triangles. Triangle f has corners 3 f to 3 f + 2.
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
    """Return unit normals; replace zero vectors by ``instead``, or by +Z."""
    for other in (instead, np.array([0.0, 0.0, 1.0])):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), other)
    return normals
