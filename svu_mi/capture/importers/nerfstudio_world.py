"""Worlds of nerfstudio: that of the photogrammetry, of transforms.json, and the normalised one.

``transforms.json`` has poses after ``applied_transform`` and ``applied_scale``. Training rotates,
centres and scales them again; ``ns-export`` writes meshes in that normalised world, and
``dataparser_transforms.json`` next to the trained model has the whole transform:
https://docs.nerf.studio/quickstart/data_conventions.html
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.importers.axis_fixes import AxisFix, correct_mesh
from svu_mi.capture.mesh import MeshArrays
from svu_mi.capture.mesh_scale import VERTICES, framing
from svu_mi.capture.sensors import affine
from svu_mi.core.arrays import evenly_spaced
from svu_mi.core.io.schema import NUMBER, Axis, Field, read_record
from svu_mi.errors import CaptureError

FILE = "dataparser_transforms.json"
LARGEST = 1e30  # limit of its numbers
NORMALISATION = {
    "transform": Field(NUMBER, (Axis("rows", 3, 4), 4), -LARGEST, LARGEST),
    "scale": Field(NUMBER, (), 1 / LARGEST, LARGEST),
}
REMEDY = "copy it again, or remove it if the mesh is in the world of the poses"
RIGID = 1e-3  # tolerance of the rotation
BETTER = 0.2  # share of vertices that are visible only in the world of the file


@dataclass(frozen=True)
class AppliedWorld:
    """Change of the world of the photogrammetry before the poses were written.

    ``transform`` (4, 4) maps it to the world of the poses without scale; ``scale`` is
    ``applied_scale``.
    """

    transform: np.ndarray
    scale: float = 1.0


def find_normalisation(folders: Sequence[Path]) -> Path | None:
    """Return the first ``dataparser_transforms.json`` in some folders, or None."""
    files = (folder / FILE for folder in folders)
    return next((file for file in files if file.is_file()), None)


def read_normalisation(path: Path, applied: AppliedWorld) -> np.ndarray:
    """Return the similarity (4, 4) from the normalised world to that of the poses."""
    record = read_record(path, NORMALISATION, REMEDY)
    transform = np.array(record["transform"], np.float64)
    rotation, offset = transform[:3, :3], transform[:3, 3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=RIGID):
        raise CaptureError(f"{path}: transform must be rigid; {REMEDY}.")
    unscaled = affine(np.eye(3) * applied.scale / record["scale"])
    return applied.transform @ np.linalg.inv(affine(rotation, offset)) @ unscaled


def in_world_of_poses(
    mesh: MeshArrays, path: Path, applied: AppliedWorld, sensors: Sequence[Any]
) -> tuple[MeshArrays, list[str]]:
    """Return a mesh of the normalised world in that of the poses, and a note.

    A mesh that the cameras frame only as it is stays as it is.
    """
    matrix = read_normalisation(path, applied)
    scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    turned = correct_mesh(mesh, AxisFix("", "mesh", "", matrix[:3, :3] / scale))
    moved = replace(turned, positions=turned.positions * scale + matrix[:3, 3])
    some = evenly_spaced(len(mesh.positions), VERTICES)
    before, after = (framing(each.positions[some], sensors)[0] for each in (mesh, moved))
    if before > after + BETTER:
        return mesh, [f"{path}: not used, as the mesh is in the world of the poses without it."]
    return moved, [
        f"{path}: the mesh is moved from nerfstudio's normalised world to that of the poses (scale "
        f"{scale:.3g}). If it was there already, remove this file."
    ]
