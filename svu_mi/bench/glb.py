"""A GLB file as the folder that the scene ``object`` reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from svu_mi.capture.mesh import write_ply
from svu_mi.errors import MeshError
from svu_mi.files import prepare_folder
from svu_mi.formats.geometry import read_geometry
from svu_mi.formats.textures import write_pictures
from svu_mi.parameters import NAMES


def convert_glb(path: Path, folder: Path) -> Path:
    """Write mesh.ply, base_color.png, roughness.png and metallic.png of a GLB file.

    The mesh is centred and scaled to a bounding radius of 1.

    Args:
        path: the GLB file, with one material.
        folder: made if missing; returned.

    Raises:
        MeshError: unreadable, no mesh, no UVs, or several materials.
        OutputError: the folder cannot be written.
    """
    geometry = read_geometry(path)
    if geometry.mesh.uvs is None:
        raise MeshError(f"{path}: the mesh has no UVs for its textures; unwrap it.")
    if set(geometry.textures) != set(NAMES):
        raise MeshError(
            f"{path}: needs exactly one material with base colour, roughness and metallic; bake "
            "its materials into one."
        )
    prepare_folder(folder)
    points = geometry.mesh.positions
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    points /= np.linalg.norm(points, axis=1).max()
    mesh = replace(geometry.mesh, positions=points)
    write_ply(folder / "mesh.ply", path.stem, mesh)
    write_pictures(geometry.textures, folder)
    return folder
