"""Texture coordinates for meshes that have none, by xatlas."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.mesh import MeshArrays, arrays, make
from svu_mi.errors import MeshError
from svu_mi.files import replacing

log = logging.getLogger(__name__)

UNWRAPPED = "unwrapped.ply"
MAX_CHART = 4096  # texels of an atlas of about 1024; packing a longer sliver takes for ever


def unwrap(mesh: Any, label: str = "") -> Any:
    """Return a copy of a mesh with new, non-overlapping UVs.

    The atlas differs between xatlas versions, so whoever needs the same texels twice
    saves the result (``unwrapped``).

    Args:
        mesh: an ``mi.Mesh``; its own UVs, if any, are dropped.
        label: what it is called in messages, such as its file; by default ``Shape 'ID'``.

    Raises:
        MeshError: the mesh has no faces, or xatlas finds no parameterisation.
    """
    import xatlas  # noqa: PLC0415 - needed only for meshes without UVs

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
    return make(
        mesh.id(),
        MeshArrays(source.positions[vmap], faces.astype(np.int64), normals, uvs.astype(np.float64)),
    )


def unwrapped(mesh: Any, folder: Path | None) -> Any:
    """Unwrap a mesh, or take the result that an earlier run left in the capture's folder.

    Args:
        mesh: an ``mi.Mesh``.
        folder: where ``unwrapped.ply`` is looked for and written; None keeps it in memory.
    """
    path = None if folder is None else folder / UNWRAPPED
    if path is not None and path.exists():
        saved = mi.load_dict({"type": "ply", "filename": str(path)})
        if _same_surface(arrays(saved), arrays(mesh)):
            return saved
        log.warning("%s belongs to another mesh; it is made again.", path)
    made = unwrap(mesh)
    if path is not None and os.access(path.parent, os.W_OK):
        with replacing(path) as temporary:
            made.write_ply(str(temporary))
    return made


def _same_surface(a: MeshArrays, b: MeshArrays) -> bool:
    """Compare face by face: unwrapping duplicates vertices and keeps the order of faces."""
    if len(a.faces) != len(b.faces):
        return False
    difference = np.abs(a.positions[a.faces] - b.positions[b.faces]).max()
    return bool(difference <= 1e-5 * np.ptp(b.positions, axis=0).max())
