"""Simplification of dense scans before they are unwrapped."""

import fast_simplification
import numpy as np

from svu_mi.capture.importers.repair_normals import repair_normals
from svu_mi.capture.mesh import MeshArrays
from svu_mi.errors import OptionError


def simplify(mesh: MeshArrays, count: int, label: str) -> tuple[MeshArrays, list[str]]:
    """Return a mesh of about ``count`` faces by quadric edge collapses, and a note."""
    if mesh.uvs is not None:
        raise OptionError(
            f"{label}: --faces would tear its UVs; add --geometry-only to compute new ones, or "
            "omit --faces."
        )
    if len(mesh.faces) <= count:
        return mesh, []
    points, vertex = np.unique(mesh.positions, axis=0, return_inverse=True)
    low = points.min(axis=0)
    size = max(float(np.ptp(points, axis=0).max()), 1e-300)
    unit = ((points - low) / size).astype(np.float32)
    faces = vertex.ravel()[mesh.faces].astype(np.int32)
    fewer, faces = fast_simplification.simplify(unit, faces, target_count=count)
    small = MeshArrays(fewer.astype(np.float64) * size + low, faces.astype(np.int64), None, None)
    small, _ = repair_normals(small, label)
    return small, [
        f"{label}: simplified from {len(mesh.faces)} to {len(faces)} faces; at a fifth of the "
        "faces, roughness loses 1.3 to 1.6 dB."
    ]
