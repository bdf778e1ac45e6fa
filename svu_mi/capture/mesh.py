"""Access to ``mi.Mesh`` buffers.

Mitsuba 3.10 renames them, so no other module of svu_mi accesses a mesh buffer.
Positions and normals are in world space (Mitsuba applies ``to_world`` when it loads a shape).
UVs follow Mitsuba: v = 0 is the first row of a bitmap.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.io.files import mark_text, refusing, replacing
from svu_mi.core.io.schema import Axis, Field, checked
from svu_mi.errors import MeshError, SvuError, excerpt

# Errors of Mitsuba for a damaged mesh; the second if its message contains bytes of the file.
READING = (RuntimeError, UnicodeDecodeError)
MARGIN = 1.05  # factor of the area of charts, for texels on their edges


@dataclass(frozen=True)
class MeshArrays:
    """NumPy copies of a mesh's buffers.

    Attributes:
        positions: (N, 3) float64, world space.
        faces: (F, 3) int64, indices into the vertices.
        normals: (N, 3) float64 unit vertex normals; None for a mesh without normals.
        uvs: (N, 2) float64; None for a mesh without UVs.
    """

    positions: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None

    @property
    def crosses(self) -> np.ndarray:
        """Cross product of two edges of each face, (F, 3); its length is twice the area."""
        return crosses_of(self.positions, self.faces)


def joined(meshes: Sequence[MeshArrays]) -> MeshArrays:
    """Concatenate meshes; the result has normals and UVs if all of them have."""
    first = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, first, strict=False)]
    both = [[getattr(mesh, name) for mesh in meshes] for name in ("normals", "uvs")]
    normals, uvs = (None if any(p is None for p in part) else np.concatenate(part) for part in both)
    positions = np.concatenate([mesh.positions for mesh in meshes])
    return MeshArrays(positions, np.concatenate(faces), normals, uvs)


def crosses_of(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return ``MeshArrays.crosses`` of faces (F, 3) with vertex positions (N, 3)."""
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def chart_areas(uvs: np.ndarray, faces: np.ndarray, *, signed: bool = False) -> np.ndarray:
    """Return the areas (F,) of triangles in texture space; if ``signed``, mirrored ones are > 0."""
    a, b, c = (uvs[faces[:, corner]] for corner in range(3))
    (u, v), (s, t) = (b - a).T, (c - a).T
    area = (u * t - v * s) / 2
    return area if signed else np.abs(area)


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Normalise vectors (..., 3); zero vectors remain zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1))


def faces_at(crosses: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Map numbers (N,) in [0, 1] to face indices (N,), in proportion to face areas."""
    area = np.cumsum(np.linalg.norm(crosses, axis=1))
    return np.minimum(np.searchsorted(area, places * area[-1], side="right"), len(area) - 1)


def has_uvs(mesh: Any) -> bool:
    """Return whether a mesh has texture coordinates."""
    return bool(mesh.has_vertex_texcoords())


def arrays(mesh: Any) -> MeshArrays:
    """Copy a mesh's buffers to NumPy."""
    faces = np.array(mesh.faces_buffer().numpy(), np.int64).reshape(-1, 3)
    normals = _rows(mesh.vertex_normals_buffer(), 3) if mesh.has_vertex_normals() else None
    if mesh.has_flipped_normals():
        # Mitsuba 3.9 flips normals at ray intersections, not in the buffers.
        faces = faces[:, ::-1].copy()
        normals = None if normals is None else -normals
    uvs = _rows(mesh.vertex_texcoords_buffer(), 2) if has_uvs(mesh) else None
    return MeshArrays(positions(mesh), faces, normals, uvs)


def positions(mesh: Any) -> np.ndarray:
    """Copy a mesh's vertices to NumPy, (N, 3) float64 in world space."""
    return _rows(mesh.vertex_positions_buffer(), 3)


def _rows(buffer: Any, width: int) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # callers check for NaN
        return np.array(buffer.numpy(), np.float64).reshape(-1, width)


def flipped_v(uvs: np.ndarray) -> np.ndarray:
    """Flip V of UVs (N, 2): OBJ and trimesh have v = 0 in the last row."""
    return np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=-1)


def face_normals(mesh: Any, face: Any, active: Any) -> Any:
    """Return unit normals (Normal3f) of triangles, by their winding."""
    corners = dr.gather(mi.Vector3u, mesh.faces_buffer(), face, active)
    a, b, c = (
        dr.gather(mi.Point3f, mesh.vertex_positions_buffer(), corner, active) for corner in corners
    )
    return dr.normalize(mi.Normal3f(dr.cross(b - a, c - a)))


def missing_corner(mesh: Any) -> str | None:
    """Describe a vertex index that is out of range; return None if all are valid.

    Mitsuba does not check indices of PLY and serialized files. An index out of range aborts the
    process when vertex normals are computed or a ray intersects the triangle.
    """
    faces, count = mesh.faces_buffer().numpy(), mesh.vertex_count()
    if faces.size == 0 or faces.max() < count:
        return None
    return f"a face refers to vertex {faces.max()}, which does not exist ({count} vertices)"


def check_buffers(mesh: MeshArrays, label: str, error: type[SvuError], largest: float) -> None:
    """Raise ``error`` for faces with missing vertices, and for NaN and large numbers."""
    rows, last = Axis("vertices"), len(mesh.positions) - 1
    points = Field("f", (rows, 3), -largest, largest)
    uvs = Field("f", (rows, 2), -largest, largest, default=None)
    with refusing(label, "export the mesh again", error):
        checked(vars(mesh), {
            "positions": points, "normals": points._replace(default=None), "uvs": uvs,
            "faces": Field("iu", (Axis("triangles"), 3), 0, last),
        })  # fmt: skip


def read_ply(path: Path, *, smooth: bool = False) -> MeshArrays:
    """Read a PLY file without its vertex normals, or with them if ``smooth``."""
    # With missing corners, the computation of normals would abort the process.
    for flat in (True, False) if smooth else (True,):
        try:
            loaded: Any = mi.load_dict({"type": "ply", "filename": str(path), "face_normals": flat})
        except READING as error:
            raise MeshError(f"{path}: cannot be read: {mesh_error(error)}") from error
        if problem := missing_corner(loaded):
            raise MeshError(f"{path}: {problem}")
    return arrays(loaded)


def chart_coverage(mesh: Any) -> float:
    """Return an upper bound, at most 1, of the fraction of a texture inside UV charts."""
    loaded = arrays(mesh)
    if loaded.uvs is None:
        return 1.0
    area = chart_areas(loaded.uvs, loaded.faces).sum()
    return float(min(MARGIN * area, 1)) if np.isfinite(area) else 1.0


def mesh_error(error: Exception) -> str:
    """Return Mitsuba's reason for rejecting a mesh file, without the file's name."""
    text = " ".join(str(error).split()).rsplit('": ', 1)[-1]
    return excerpt(re.sub(r"\[\w+(\.\w+:\d+)?\] ", "", text)).rstrip(".!")


def write_ply(path: Path, name: str, mesh: MeshArrays, comment: str = "") -> None:
    """Write a mesh as PLY, atomically."""
    stream = mi.MemoryStream()  # on a full disk, Mitsuba would truncate the file without an error
    make_mesh(name, mesh).write_ply(stream)
    data = stream.raw_buffer()[: stream.size()]
    lines = "".join(f"comment {line}\n" for line in (comment, mark_text()) if line)
    head, mark, rest = data.partition(b"element ")
    data = head + lines.encode("ascii") + mark + rest
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def make_mesh(name: str, mesh: MeshArrays, props: Any = None) -> Any:
    """Build a ``mi.Mesh`` from arrays; ``props`` may contain its BSDF and emitter."""
    uvs, normals = mesh.uvs, mesh.normals
    given = {} if props is None else {"props": props}
    has = {"has_vertex_normals": normals is not None, "has_vertex_texcoords": uvs is not None}
    made = mi.Mesh(name, len(mesh.positions), len(mesh.faces), **has, **given)
    params = mi.traverse(made)
    params["faces"] = mi.UInt32(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
    for key, rows in (("positions", mesh.positions), ("normals", normals), ("texcoords", uvs)):
        if rows is not None:
            params[f"vertex_{key}"] = mi.Float(np.ascontiguousarray(rows, np.float32).ravel())
    params.update()
    return made
