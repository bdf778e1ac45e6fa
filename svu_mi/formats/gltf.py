"""Checks of glTF headers for features that trimesh misreads.

trimesh takes normalised integers for coordinates, ignores sparse changes and texture transforms,
and reads compressed data as zeros, all silently. Names are those of
https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from svu_mi.errors import MeshError
from svu_mi.formats.source_files import inside

SUFFIXES = (".glb", ".gltf")
COMPRESSION = (
    "KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression",
)  # fmt: skip
TRANSFORM = "KHR_texture_transform"
HARMLESS = {"offset": [0, 0], "scale": [1, 1], "rotation": 0}  # of such a transform
FLOAT = 5126
FREE = 2**20  # numbers that any file may ask for; more must be in it, not repeated
ATTRIBUTES = ("POSITION", "NORMAL", "TEXCOORD_0")
# Parts of a material, and of those of PBR, that no parameter here stands for.
IGNORED = {
    "normalTexture": "a normal map", "occlusionTexture": "an occlusion map",
    "emissiveTexture": "emission", "alphaMode": "transparency",
}  # fmt: skip
MODEL = "KHR_materials_"  # how extensions of the reflection model begin


def check_gltf(path: Path, *, geometry_only: bool) -> int:
    """Return the bytes of a file and its buffers; refuse what trimesh would misread.

    Raises:
        MeshError: it is compressed or quantised, moves its textures (unless ``geometry_only``), or
            declares more numbers than its files hold, which would be allocated.
    """
    record = _header(path)
    for name in COMPRESSION:
        if name in record.get("extensionsRequired", ()):
            raise MeshError(f"{path}: is compressed ({name}); export it without compression.")
    held = _held(path, record)
    _refuse_bombs(path, record, held)
    attributes = ATTRIBUTES[:2] if geometry_only else ATTRIBUTES
    accessors = record.get("accessors", ())
    for primitive in _primitives(record):
        for name in attributes:
            index = primitive["attributes"].get(name)
            given = {} if index is None else accessors[index]
            if given.get("componentType", FLOAT) != FLOAT or "sparse" in given:
                raise MeshError(
                    f"{path}: its {name} is quantised or sparse; export it with plain floats, or "
                    "convert it with gltf-transform dequantize."
                )
    if not geometry_only and any(map(_moves, _within(record.get("materials", ())))):
        raise MeshError(
            f"{path}: its textures are moved or scaled by {TRANSFORM}; apply that to the UVs, or "
            "import only the geometry with --geometry-only."
        )
    return held


def ignored(path: Path) -> list[str]:
    """Return ignored parts of the materials of a checked file, such as ``a normal map``."""
    record = _header(path)
    materials = record.get("materials", [])
    primitives = _primitives(record)
    used = [materials[p["material"]] for p in primitives if "material" in p]
    names = []
    for material in used:
        names += [n for key, n in IGNORED.items() if material.get(key, "OPAQUE") != "OPAQUE"]
        names += ["emission"] if any(material.get("emissiveFactor", ())) else []
        extensions = [key for key in material.get("extensions", ()) if key.startswith(MODEL)]
        names += [key.removeprefix(MODEL) for key in extensions]
    names += ["vertex colours" for p in primitives if "COLOR_0" in p["attributes"]]
    return list(dict.fromkeys(names))


def _primitives(record: Mapping[str, Any]) -> list[Any]:
    return [p for mesh in record.get("meshes", ()) for p in mesh["primitives"]]


def _header(path: Path) -> dict[str, Any]:
    """Return the JSON part of a file."""
    if path.suffix.lower() == ".gltf":
        return dict(json.loads(path.read_bytes()))
    with path.open("rb") as stream:
        (length,) = struct.unpack_from("<I", stream.read(20), 12)
        return dict(json.loads(stream.read(length)))


def _held(path: Path, record: Mapping[str, Any]) -> int:
    """Return the bytes of the file and its buffers."""
    names = [buffer.get("uri", "data:") for buffer in record.get("buffers", ())]
    files = [inside(path.parent, unquote(n), str(path)) for n in names if not n.startswith("data:")]
    return sum(file.stat().st_size for file in {path, *files} if file.is_file())


def _refuse_bombs(path: Path, record: Mapping[str, Any], held: int) -> None:
    counts = [int(accessor.get("count", 0)) for accessor in record.get("accessors", ())]
    used = [counts[index] for p in _primitives(record) for index in p["attributes"].values()]
    if min(counts, default=0) < 0 or max(sum(counts), sum(used)) > max(FREE, held):
        raise MeshError(f"{path}: an accessor reads past the end of the file; export it again.")


def _within(value: Any) -> Iterator[Mapping[str, Any]]:
    """Return all objects inside a JSON value."""
    if isinstance(value, Mapping):
        yield value
    for item in value.values() if isinstance(value, Mapping) else value:
        if isinstance(item, Mapping | list):
            yield from _within(item)


def _moves(record: Mapping[str, Any]) -> bool:
    given = record.get(TRANSFORM)
    return given is not None and any(given.get(key, same) != same for key, same in HARMLESS.items())
