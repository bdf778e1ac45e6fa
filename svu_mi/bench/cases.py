"""Cases of benchmarks: objects under lights, from svu_mi's scenes or from a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from svu_mi import scenes
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.mesh_materials import write_pictures
from svu_mi.capture.mesh import write_ply
from svu_mi.core.io.files import prepare_folder
from svu_mi.core.validation import require_known
from svu_mi.errors import MeshError, OptionError
from svu_mi.parameters import NAMES

MESH_FILES = ("mesh.ply", "base_color.png", "roughness.png", "metallic.png")
IMAGES = (".exr", ".hdr")


@dataclass(frozen=True)
class Case:
    """One object under one light.

    Attributes:
        object: Name of the object.
        light: Name of the light.
        scene: Mitsuba XML file.
        defines: Values of the parameters of the file.
    """

    object: str
    light: str
    scene: Path
    defines: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the folder of the case's files."""
        return f"{self.object}__{self.light}"

    @property
    def title(self) -> str:
        """Object and light."""
        return f"{self.object} / {self.light}"


DIRECT = {"max_depth": "2"}  # direct light, as in the reference

OWN_OBJECTS = ("vase", "knot", "spheres")
QUICK_OBJECTS, QUICK_LIGHTS = ("vase", "knot"), ("window", "overcast")


def chosen_cases(
    data: Path | None,
    workspace: Path,
    objects: Sequence[str] = (),
    lights: Sequence[str] = (),
    *,
    quick: bool = False,
) -> tuple[Case, ...]:
    """Return ``data_cases`` of a folder, or ``own_cases`` without a folder."""
    if data is None:
        return own_cases(objects, lights, quick=quick)
    return data_cases(data, workspace, objects, lights)


def own_cases(
    objects: Sequence[str] = (), lights: Sequence[str] = (), *, quick: bool = False
) -> tuple[Case, ...]:
    """Return cases of the scenes of svu_mi.

    Args:
        objects: Names in ``svu_mi.scenes.names()``; vase, knot and spheres by default.
        lights: Names in ``svu_mi.scenes.LIGHTS``; all by default.
        quick: Use only vase and knot under window and overcast by default.

    Raises:
        OptionError: Unknown name.
    """
    shapes = _chosen(objects, scenes.names(), QUICK_OBJECTS if quick else OWN_OBJECTS, "object")
    skies = _chosen(lights, scenes.LIGHTS, QUICK_LIGHTS if quick else scenes.LIGHTS, "light")
    return tuple(
        Case(shape, sky, scenes.path(shape), {"light": sky, **DIRECT})
        for shape in shapes
        for sky in skies
    )


def data_cases(
    data: Path, workspace: Path, objects: Sequence[str] = (), lights: Sequence[str] = ()
) -> tuple[Case, ...]:
    """Return cases of a folder of objects and environment maps.

    Args:
        data: Folder with objects/NAME (mesh.ply, base_color.png, roughness.png and
            metallic.png) or objects/NAME.glb, and with envmaps/NAME.exr or NAME.hdr.
        workspace: Folder whose ``objects`` receives converted GLB files.
        objects: Names; all by default.
        lights: Names; all by default.

    Raises:
        OptionError: A folder is missing or empty, or a name is unknown.
        MeshError: A GLB file cannot be converted.
    """
    known, skies = _objects(data / "objects"), _environments(data / "envmaps")
    chosen = _chosen(objects, known, tuple(known), f"object in {data / 'objects'}")
    under = _chosen(lights, skies, tuple(skies), f"light in {data / 'envmaps'}")
    folders = {name: _folder(known[name], workspace / "objects" / name) for name in chosen}
    return tuple(
        Case(
            name, sky, scenes.path("object"),
            {"object": str(folders[name]), "environment": str(skies[sky]), **DIRECT},
        )
        for name in chosen
        for sky in under
    )  # fmt: skip


def _objects(folder: Path) -> dict[str, Path]:
    """Return folders and GLB files by name; folders take precedence."""
    _require_folder(folder, "with objects: folders with mesh.ply and textures, or .glb files")
    paths = {path.stem: path.resolve() for path in sorted(folder.glob("*.glb"))}
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.name.startswith("."):
            missing = [name for name in MESH_FILES if not (path / name).is_file()]
            if missing:
                raise OptionError(
                    f"{path}: an object's folder needs {', '.join(MESH_FILES)}; add {missing[0]}."
                )
            paths[path.name] = path.resolve()
    paths = dict(sorted(paths.items()))
    if not paths:
        raise OptionError(
            f"{folder}: no object found; add folders with {', '.join(MESH_FILES)}, or .glb files."
        )
    return paths


def _environments(folder: Path) -> dict[str, Path]:
    """Return lat-long images by name; OpenEXR takes precedence over Radiance."""
    _require_folder(folder, "with lat-long images, .exr or .hdr")
    images = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in IMAGES]
    images.sort(key=lambda path: path.suffix.lower(), reverse=True)
    paths = {path.stem: path.resolve() for path in images}
    if not paths:
        raise OptionError(f"{folder}: no lat-long image found; add an .exr or .hdr file.")
    return dict(sorted(paths.items()))


def _require_folder(folder: Path, content: str) -> None:
    if not folder.is_dir():
        raise OptionError(f"{folder}: no such folder; --data needs a folder {content}.")


def _folder(path: Path, converted: Path) -> Path:
    return path if path.is_dir() else convert_glb(path, converted.resolve())


def _chosen(
    given: Sequence[str], known: Sequence[str] | dict[str, Path], default: Sequence[str], kind: str
) -> tuple[str, ...]:
    require_known(given, known, kind)
    return tuple(dict.fromkeys(given)) or tuple(default)


def convert_glb(path: Path, folder: Path) -> Path:
    """Write mesh.ply, base_color.png, roughness.png and metallic.png of a GLB file.

    The mesh is centred and scaled to a bounding radius of 1.

    Args:
        path: GLB file with one material.
        folder: Folder of the results, created if missing; returned.

    Raises:
        MeshError: Unreadable file, no mesh, no UVs, or several materials.
        OutputError: The folder cannot be written.
    """
    geometry = read_textured_mesh(path)
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
