"""What a glTF file says about itself: whether its numbers are ones that trimesh reads as meant.

trimesh takes normalised integers for coordinates, leaves sparse changes and texture transforms
out, and makes zeros of what is compressed, all without a word. Names are those of
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
    """Refuse a file that would be read as something else, or that is not to be trusted.

    Args:
        path: the GLB or glTF.
        geometry_only: its UVs and textures do not matter.

    Returns:
        The bytes that the file and its buffers have.

    Raises:
        MeshError: it is compressed or quantised, moves its textures, or asks for more numbers
            than its files hold, which would all be made.
    """
    record = _header(path)
    for name in COMPRESSION:
        if name in record.get("extensionsRequired", ()):
            raise MeshError(f"{path}: is compressed ({name}); export it without compression.")
    held = _held(path, record)
    _refuse_bombs(path, record, held)
    attributes = ATTRIBUTES[:2] if geometry_only else ATTRIBUTES
    accessors = record.get("accessors", ())
    for primitive in (p for mesh in record.get("meshes", ()) for p in mesh["primitives"]):
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
    """Return what a file's materials have that is left out, such as ``a normal map``.

    Args:
        path: a GLB or glTF that ``check_gltf`` has passed.
    """
    record = _header(path)
    materials = record.get("materials", [])
    primitives = [p for mesh in record.get("meshes", ()) for p in mesh["primitives"]]
    used = [materials[p["material"]] for p in primitives if "material" in p]
    names = [
        name for material in used for key, name in IGNORED.items()
        if material.get(key, "OPAQUE") != "OPAQUE"
    ]  # fmt: skip
    names += ["emission" for m in used if any(m.get("emissiveFactor", ()))]
    extensions = [key for material in used for key in material.get("extensions", ())]
    names += [key.removeprefix(MODEL) for key in extensions if key.startswith(MODEL)]
    names += ["vertex colours" for p in primitives if "COLOR_0" in p["attributes"]]
    return list(dict.fromkeys(names))


def _header(path: Path) -> dict[str, Any]:
    """Return the JSON part of a file."""
    if path.suffix.lower() == ".gltf":
        return dict(json.loads(path.read_bytes()))
    with path.open("rb") as stream:
        (length,) = struct.unpack_from("<I", stream.read(20), 12)
        return dict(json.loads(stream.read(length)))


def _held(path: Path, record: Mapping[str, Any]) -> int:
    """Return how many bytes the file and its buffers have."""
    names = [buffer.get("uri", "data:") for buffer in record.get("buffers", ())]
    files = [inside(path.parent, unquote(n), str(path)) for n in names if not n.startswith("data:")]
    return sum(file.stat().st_size for file in {path, *files} if file.is_file())


def _refuse_bombs(path: Path, record: Mapping[str, Any], held: int) -> None:
    counts = [int(accessor.get("count", 0)) for accessor in record.get("accessors", ())]
    used = [
        counts[index]
        for mesh in record.get("meshes", ())
        for primitive in mesh["primitives"]
        for index in primitive["attributes"].values()
    ]
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
