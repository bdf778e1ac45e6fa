"""Texture coordinates for meshes that have none, by xatlas."""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import xatlas

from svu_mi.capture.mesh import MeshArrays, arrays, make_mesh, read_ply, write_ply
from svu_mi.core.io.files import clear_temporaries
from svu_mi.errors import MeshError

log = logging.getLogger(__name__)

UNWRAPPED = "unwrapped.ply"
KEY = "svu_mi unwrapped "  # a comment in the header of the file, before its digest
HEADER = 4096  # bytes that hold the header of a PLY file
MAX_CHART = 4096  # texels of an atlas of about 1024; packing a longer sliver takes for ever


def unwrap(mesh: Any, label: str = "") -> Any:
    """Return a copy of a mesh with new, non-overlapping UVs.

    The atlas differs between xatlas versions, so whoever needs the same texels twice
    saves the result (``unwrap_cached``).
    """
    source, label = arrays(mesh), label or f"Shape '{mesh.id()}'"
    if len(source.faces) == 0:
        raise MeshError(f"{label} has no faces, so there is nothing to unwrap.")
    # Of unit size: xatlas works in single precision and takes small triangles for degenerate ones.
    low, high = source.positions.min(axis=0), source.positions.max(axis=0)
    unit = (source.positions - low) / max(float((high - low).max()), 1e-300)
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.max_chart_size = MAX_CHART
    atlas.add_mesh(unit.astype(np.float32), source.faces.astype(np.uint32))
    atlas.generate(pack_options=packing)
    vmap, faces, uvs = atlas.get_mesh(0)
    if len(faces) != len(source.faces) or not np.isfinite(uvs).all():
        raise MeshError(
            f"{label} cannot be unwrapped automatically; give it UVs in a modelling tool and load "
            "it again."
        )
    normals = None if source.normals is None else source.normals[vmap]
    return make_mesh(
        mesh.id(),
        MeshArrays(source.positions[vmap], faces.astype(np.int64), normals, uvs.astype(np.float64)),
    )


def unwrap_cached(mesh: Any, folder: Path | None) -> Any:
    """Unwrap a mesh, or take the UVs that an earlier run left in the capture's folder.

    A file that belongs to another mesh, that was changed, or that is damaged is made again, with
    a warning in the log.
    """
    path, source = None if folder is None else folder / UNWRAPPED, arrays(mesh)
    if path is not None and path.exists():
        try:
            return make_mesh(mesh.id(), _saved(path, source))
        except MeshError as error:
            log.warning("%s; the mesh is unwrapped again.", error)
    made = unwrap(mesh)
    if path is not None and os.access(path.parent, os.W_OK):
        clear_temporaries(path.parent)
        flat = arrays(made)
        version = importlib.metadata.version("xatlas")
        write_ply(path, mesh.id(), flat, f"{KEY}{_key(source, flat)} xatlas {version}")
    return made


def _saved(path: Path, source: MeshArrays) -> MeshArrays:
    """Lay the UVs of a file on a mesh, whose positions and normals are taken."""
    if not path.is_file():  # opening a pipe would wait
        raise MeshError(f"{path}: is not a file")
    try:
        with path.open("rb") as stream:
            header = stream.read(HEADER).partition(b"end_header")[0].decode("ascii", "replace")
    except OSError as error:
        raise MeshError(f"{path}: cannot be opened ({error.strerror})") from error
    key, saved = re.search(rf"^comment {KEY}([0-9a-f]+)", header, re.MULTILINE), read_ply(path)
    if saved.uvs is None or not np.isfinite(saved.uvs).all():
        raise MeshError(f"{path}: has no finite UVs")
    is_own = key is not None and key[1] == _key(source, saved)
    if not is_own or saved.faces.shape != source.faces.shape:
        raise MeshError(f"{path}: belongs to another mesh, or was changed")
    # Unwrapping only repeats vertices and keeps the order of faces, so corners tell which.
    vertex = np.zeros(len(saved.positions), np.int64)
    vertex[saved.faces] = source.faces
    if not np.array_equal(vertex[saved.faces], source.faces):
        raise MeshError(f"{path}: merges vertices of the mesh")
    normals = None if source.normals is None else source.normals[vertex]
    return MeshArrays(source.positions[vertex], saved.faces, normals, saved.uvs)


def _key(source: MeshArrays, flat: MeshArrays) -> str:
    """Return a digest of a mesh and its UVs, in the precision of files.

    The version of xatlas is not part of it: what was laid out by another one is still valid, and
    keeps texels where they were.
    """
    key = hashlib.blake2b(digest_size=16)
    for rows in (source.positions, source.normals, flat.uvs):
        key.update(b"-" if rows is None else np.ascontiguousarray(rows, "<f4").tobytes())
    for faces in (source.faces, flat.faces):
        key.update(np.ascontiguousarray(faces, "<i8").tobytes())
    return key.hexdigest()
