"""Reader of textured meshes: GLB, glTF, OBJ, PLY and STL."""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from PIL import Image, UnidentifiedImageError

from svu_mi.capture.image_formats.recognition import SUFFIXES as IMAGE_SUFFIXES
from svu_mi.capture.importers import mesh_materials as materials
from svu_mi.capture.importers.gltf_extensions import readable
from svu_mi.capture.importers.obj_materials import rewritten
from svu_mi.capture.importers.repair_normals import repair_normals
from svu_mi.capture.importers.source_files import LARGEST_TEXT, SHOWN, find_file, substitutions
from svu_mi.capture.mesh import MeshArrays, check_buffers, flipped_v, joined
from svu_mi.errors import CaptureError, MeshError, OutputError, excerpt

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tga", ".bmp", ".tif", ".tiff")
CONVERTED = set(IMAGE_SUFFIXES) - set(PICTURES)
# As in Mitsuba's plugin, unless a comment names a texture, as in files of MeshLab and scanners.
# trimesh returns V upwards for other formats.
V_DOWN = (".ply",)
MTL = ".mtl"
HEADER = 2**16  # bytes that contain the header of a PLY, or the first vertex of an OBJ
COLORED = re.compile(rb"^v(\s+[-+.\deE]+){6,7}\s*$", re.MULTILINE)  # x y z r g b [w]
# Lines of an OBJ: faces with a vertex 0, or with one that counts backwards, and names of objects.
ZERO = re.compile(rb"^f\s(?:[^\n]*[\s/])?0(?:[\s/]|$)", re.MULTILINE)
RELATIVE = re.compile(rb"^f\s[^\n]*-\d", re.MULTILINE)
OBJECT = re.compile(rb"^o[ \t]+([^\r\n]+)", re.MULTILINE)
MAX_BYTES = 2**31
MAX_NUMBER = 1e9  # units or UV tiles
LEFT_OUT = (
    "ignored: the material has only base colour, roughness and metallic, and normals come from the "
    "mesh."
)


@dataclass(frozen=True, kw_only=True)
class TexturedMesh:
    """A mesh and its material.

    Attributes:
        mesh: vertex and face buffers; V = 0 is the first row of the textures.
        textures: pictures by parameter of ``principled``; empty without textures.
        normals: normal map (H, W, 3) of bytes; None without a usable one.
        notes: sentences about decisions of the reader.
    """

    mesh: MeshArrays
    textures: materials.Textures = field(default_factory=dict)
    normals: np.ndarray | None = None
    notes: Sequence[str] = ()


def read_textured_mesh(path: str | Path, *, geometry_only: bool = False) -> TexturedMesh:
    """Read a mesh with its textures.

    Args:
        path: path of a GLB, glTF, OBJ, PLY or STL file. Parts are transformed as in the file and
            merged. PLY does not specify the direction of V: it points up with a texture, else down.
        geometry_only: True to ignore UVs, textures and the number of materials.
    """
    path = Path(path)
    files = _FolderResolver(path.parent, geometry_only)
    parts, of_parts = _read_parts(path, files, geometry_only)
    painted = {part.material: part for part in parts if part.material is not None}
    several = len(painted) > 1
    if several and not geometry_only and any(materials.is_textured(part.visual) for part in parts):
        raise MeshError(
            f"{path}: has {len(painted)} materials; bake them into one, or import only the "
            "geometry with --geometry-only."
        )
    mesh = _merge_parts(parts, path)
    if geometry_only or (mesh.uvs is not None and not np.ptp(mesh.uvs, axis=0).all()):
        mesh = replace(mesh, uvs=None)  # some exporters write the same UVs for all vertices
    textures: materials.Textures = {}
    normals = None
    if mesh.uvs is not None:
        textures = {} if several else materials.textures_of(parts[0].visual, path)
        uvs = mesh.uvs
        if textures or path.suffix.lower() not in V_DOWN:
            uvs = flipped_v(uvs)
        tile = np.floor((uvs.min(axis=0) + uvs.max(axis=0)) / 2)
        mesh = replace(mesh, uvs=uvs - tile)
    mesh, notes = repair_normals(mesh, str(path))
    notes += [*of_parts, *substitutions(str(path), path.parent, list(files.found.items()))]
    if files.missing:
        notes.append(f"{path}: refers to {excerpt(files.missing[0])}, which does not exist.")
    if not geometry_only:
        names = [name for part in parts for name in materials.ignored_in_obj(part.visual)]
        names += ["vertex colours" for part in parts if part.is_colored]
        with path.open("rb") as stream:
            is_colored = path.suffix.lower() == ".obj" and COLORED.search(stream.read(HEADER))
        names += ["vertex colours"] if is_colored else []
        if path.suffix.lower() in materials.GLTF:
            with _parser_errors(path):
                names = materials.ignored_in_gltf(path)
                normals = materials.normal_picture(path, parts[0].visual) if textures else None
                names = [n for n in names if n != materials.NORMALS or normals is None]
                visuals = [part.visual for part in parts]
                unread = [] if files.missing else materials.unread_textures(path, visuals)
            notes += [f"{path}: its {name} could not be read; it is white." for name in unread]
        listed = ", ".join(excerpt(name) for name in dict.fromkeys(names))
        notes += [f"{path}: has {listed}, {LEFT_OUT}"] if listed else []
    if mesh.uvs is None and any(materials.is_textured(part.visual) for part in parts):
        notes.append(f"{path}: its textures are ignored, and new UVs are computed.")
    return TexturedMesh(mesh=mesh, textures=textures, normals=normals, notes=notes)


def _merge_parts(parts: Sequence[_Part], path: Path) -> MeshArrays:
    """Concatenate parts; keep UVs and normals only if all parts have them."""
    mesh = joined([part.mesh for part in parts])
    # Normals may be invalid: they are repaired.
    check_buffers(replace(mesh, normals=None), str(path), MeshError, MAX_NUMBER)
    # Remove unused vertices: scans have some far away.
    used, faces = np.unique(mesh.faces, return_inverse=True)
    if len(used) == len(mesh.positions):
        return mesh
    normals, uvs = (None if a is None else a[used] for a in (mesh.normals, mesh.uvs))
    return MeshArrays(mesh.positions[used], faces.reshape(mesh.faces.shape), normals, uvs)


@dataclass(frozen=True)
class _Part:
    """Mesh of a file in world space, with trimesh's ``visual``.

    ``material`` is equal for parts of the same material; None without UVs.
    """

    name: str
    mesh: MeshArrays
    visual: Any
    material: int | None
    is_colored: bool

    @staticmethod
    def of(scene: trimesh.Scene, node: str) -> _Part:
        matrix, name = scene.graph[node]
        part = scene.geometry[name]
        faces = np.array(getattr(part, "faces", np.empty((0, 3))), np.int64)
        own = _own_normals(part) if len(faces) > 0 else None
        normals = None if own is None else own @ np.linalg.inv(matrix[:3, :3])
        mirrored = np.linalg.det(matrix[:3, :3]) < 0
        uvs = getattr(part.visual, "uv", None)
        materials.load_pictures(part.visual)
        return _Part(
            node,
            MeshArrays(
                positions=np.array(part.vertices) @ matrix[:3, :3].T + matrix[:3, 3],
                faces=faces[:, ::-1] if mirrored else faces,
                normals=normals,
                uvs=None if uvs is None else np.array(uvs, np.float64)[:, :2],
            ),
            part.visual,
            hash(part.visual.material) if part.visual.kind == "texture" else None,
            part.visual.kind in ("vertex", "face") or "red" in _ply_properties(part),
        )


def _own_normals(part: Any) -> np.ndarray | None:
    """Return the normals in the file, one per vertex; None if the file has none.

    trimesh keeps normals of a PLY in the metadata.
    """
    bare = trimesh.Trimesh(part.vertices, part.faces, face_normals=part.face_normals, process=False)
    if not np.array_equal(part.vertex_normals, bare.vertex_normals, equal_nan=True):
        return np.asarray(part.vertex_normals)
    if not {"nx", "ny", "nz"} <= set(_ply_properties(part)):
        return None
    raw = part.metadata["_ply_raw"]["vertex"]
    own = np.stack([np.asarray(raw["data"][name], float).ravel() for name in ("nx", "ny", "nz")])
    return own.T if own.shape[1] == len(part.vertices) else None


def _ply_properties(part: Any) -> Any:
    """Return the names of the properties of vertices in a PLY; empty for other formats."""
    return part.metadata.get("_ply_raw", {}).get("vertex", {}).get("properties", ())


def require_mesh_file(path: Path) -> None:
    """Raise ``MeshError`` unless ``path`` is a file in a supported format."""
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(f"{path}: not a supported mesh format ({', '.join(SUFFIXES)}).")
    if not path.is_file():
        raise MeshError(f"{path}: no such mesh file.")


def _read_parts(
    path: Path, files: _FolderResolver, geometry_only: bool
) -> tuple[list[_Part], list[str]]:
    """Return the triangle meshes of a file, and notes."""
    require_mesh_file(path)
    held = path.stat().st_size
    if held > MAX_BYTES:
        raise MeshError(f"{path}: larger than {MAX_BYTES // 2**20} MiB; simplify the mesh.")
    objects = _obj_objects(path) if path.suffix.lower() == ".obj" else []
    if path.suffix.lower() == ".ply":
        _refuse_several_textures(path)
    given: dict[str, Any] = {"file_obj": path}
    notes: list[str] = []
    with _parser_errors(path):
        if path.suffix.lower() in materials.GLTF:
            held = materials.check_gltf(path, geometry_only=geometry_only)
            header = materials.header_of(path)
            record, notes = readable(str(path), header, geometry_only=geometry_only)
            if record != header:
                given["file_obj"] = materials.with_header(path, record)
                given["file_type"] = path.suffix.lower()[1:]
        scene = trimesh.load_scene(**given, resolver=files, process=False)
        placed = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
        if sum(len(part.vertices) for part in placed) > max(materials.FREE, held):
            raise MeshError(f"{path}: has too many instances of parts; bake them into one mesh.")
        parts = [_Part.of(scene, node) for node in scene.graph.nodes_geometry]
        parts = [part for part in parts if len(part.mesh.faces) > 0]
    if files.refused:
        raise MeshError(f"{path}: {excerpt(files.refused[0])}")
    if not parts:
        raise MeshError(f"{path}: contains no triangle mesh; export one.")
    names = objects if len(objects) > 1 else [part.name for part in parts]
    if len(names) > 1:
        notes.append(
            f"{path}: {len(names)} parts ({excerpt(', '.join(names), SHOWN)}) are read as one "
            "object; remove a table or other objects from the file."
        )
    return parts, notes


def _obj_objects(path: Path) -> list[str]:
    """Return the names of the objects of an OBJ; refuse indices that trimesh misreads."""
    data = path.read_bytes()
    if ZERO.search(data):
        raise MeshError(f"{path}: counts vertices from 0, but OBJ counts from 1; add 1 to indices.")
    relative = RELATIVE.search(data)
    if relative and data.find(b"\nv ", relative.start()) >= 0:
        raise MeshError(
            f"{path}: has relative indices between its vertices; export it with positive indices."
        )
    return [name.decode(errors="replace") for name in dict.fromkeys(OBJECT.findall(data))]


def _refuse_several_textures(path: Path) -> None:
    """Raise MeshError for a PLY of whose textures trimesh would read only one."""
    with path.open("rb") as stream:
        header = stream.read(HEADER).partition(b"end_header")[0].lower()
    if header.count(b"comment texturefile") > 1:
        raise MeshError(
            f"{path}: has several textures; bake them into one, or export it without textures."
        )


@contextlib.contextmanager
def _parser_errors(path: Path) -> Iterator[None]:
    """Turn parser errors into a MeshError that names the file; disable trimesh's log."""
    spoken, trimesh.util.log.disabled = trimesh.util.log.disabled, True
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # invalid values are refused later
            yield
    except MeshError:
        raise
    except Exception as error:  # trimesh's parsers raise any type
        reason = excerpt(str(error) or type(error).__name__)
        raise MeshError(f"{path}: not a readable mesh ({reason}); export it again.") from error
    finally:
        trimesh.util.log.disabled = spoken


class _FolderResolver(trimesh.resolvers.Resolver):
    """Access of trimesh to files in the folder of a mesh.

    trimesh continues without unreadable materials, so errors are collected in ``refused``, names
    of missing files in ``missing``, and files by their names in ``found``.
    """

    def __init__(self, root: Path, geometry_only: bool) -> None:
        self.root, self.geometry_only = root, geometry_only
        self.found: dict[str, Path] = {}
        self.refused: list[str] = []
        self.missing: list[str] = []

    def get(self, name: str) -> bytes:
        """Return the content of a file; glTF encodes a space in its name as %20."""
        name = str(name).strip().strip('"')
        if self.geometry_only and Path(name).suffix.lower() in {*PICTURES, *CONVERTED, MTL}:
            raise FileNotFoundError(f"{name} is not needed")
        try:
            path = find_file(self.root, name, str(self.root), moved=True)
            if not path.is_file():
                path = find_file(self.root, unquote(name), str(self.root), moved=True)
            if not path.is_file():  # missing, or a folder, pipe or device
                self.missing.append(path.name)
                raise FileNotFoundError(f"no file {path.name}")
            self.found[name] = path
            largest = LARGEST_TEXT if path.suffix.lower() == MTL else MAX_BYTES
            if path.stat().st_size > largest:  # trimesh would ignore it without memory
                raise ValueError(
                    f"{path.name} is larger than {largest >> 20} MiB; export a smaller one"
                )
            if path.suffix.lower() == MTL:
                text = path.read_text(encoding="utf-8", errors="surrogateescape")
                return "\n".join(rewritten(text)).encode(errors="surrogateescape")
            if path.suffix.lower() in PICTURES:
                with Image.open(path):
                    pass  # checks the header; the pixels are decoded later
            if path.suffix.lower() in CONVERTED:
                return materials.png_of(path)  # trimesh would ignore it
            return path.read_bytes()
        except (
            CaptureError, UnidentifiedImageError, Image.DecompressionBombError, ValueError
        ) as error:  # fmt: skip
            self.refused.append(str(error))
            raise OSError(str(error)) from error

    def keys(self) -> list[str]:
        """Return the names of the files in the folder."""
        return [file.name for file in self.root.iterdir()]

    def namespaced(self, namespace: str) -> _FolderResolver:
        """Raise OSError: no supported format refers to folders."""
        raise OSError(f"{self.root}: {namespace} is not searched.")

    def write(self, name: str, data: object) -> None:
        """Raise OutputError: reading a mesh writes no files."""
        raise OutputError(f"{self.root}: {name} ({type(data)}) must not be written while reading.")
