"""Extensions of glTF that change what a file means, and the UV set of its textures.

The registry is https://github.com/KhronosGroup/glTF/tree/main/extensions
"""

import copy
from collections.abc import Mapping
from typing import Any

from svu_mi.errors import MeshError, excerpt

# Remedy by extension; TOOL is https://gltf-transform.dev
TOOL = "gltf-transform {} in.glb out.glb"
UNPACKED = "decode it with " + TOOL.format("copy")
DECODED = {
    "KHR_draco_mesh_compression": UNPACKED, "EXT_meshopt_compression": UNPACKED,
    "KHR_meshopt_compression": UNPACKED, "KHR_mesh_quantization": TOOL.format("dequantize"),
    "EXT_mesh_gpu_instancing": "bake the instances in a modelling tool",
}  # fmt: skip
PICTURES = {
    name: f"convert its textures with {TOOL.format(command)}, or import only the geometry with "
    "--geometry-only"
    for name, command in (("KHR_texture_basisu", "ktxdecompress"), ("EXT_texture_avif", "png"))
}
# Followed, or reported as a part of the material.
UNDERSTOOD = ("KHR_texture_transform", "EXT_texture_webp", "KHR_mesh_quantization")
TRIANGLES, FAN = 4, 6  # modes of primitives; lines and points are below 4
TEXTURES = ("baseColorTexture", "metallicRoughnessTexture")
HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "KHR_animation_", "EXT_lights_")


def refuse_extensions(path: str, record: Mapping[str, Any], *, geometry_only: bool) -> None:
    """Raise MeshError for extensions that a file requires and this reader does not follow."""
    required = [str(name) for name in record.get("extensionsRequired", ())]
    instanced = [key for node in record.get("nodes", ()) for key in node.get("extensions", ())]
    for name in (*required, *(key for key in instanced if key in DECODED)):
        if name in UNDERSTOOD or name.startswith(HARMLESS):
            continue
        if name in PICTURES and geometry_only:
            continue
        remedy = DECODED.get(name) or PICTURES.get(name) or "export it without this extension"
        raise MeshError(f"{path}: requires {excerpt(name)}, which is not supported; {remedy}.")


def readable(path: str, record: dict[str, Any], *, geometry_only: bool) -> tuple[Any, list[str]]:
    """Return a glTF header in which trimesh reads the right UV set and no lines, and notes.

    Raises:
        MeshError: textures use different UV sets, or the mesh is deformed.
    """
    record = copy.deepcopy(record)
    materials, left_out = record.get("materials", ()), 0
    for mesh in record.get("meshes", ()):
        every = mesh["primitives"]
        if any(primitive.get("mode", TRIANGLES) == FAN for primitive in every):
            raise MeshError(f"{path}: has triangle fans; export it with plain triangles.")
        if any(mesh.get("weights", ())):
            raise MeshError(f"{path}: is deformed by morph targets; apply them before the export.")
        mesh["primitives"] = [p for p in every if p.get("mode", TRIANGLES) >= TRIANGLES]
        left_out += len(every) - len(mesh["primitives"])
        for primitive in () if geometry_only else mesh["primitives"]:
            if "material" in primitive:
                _select_uv_set(path, primitive["attributes"], materials[primitive["material"]])
    for node in record.get("nodes", ()):
        if "skin" in node or any(node.get("weights", ())):
            raise MeshError(f"{path}: is deformed by a skeleton; apply its pose before the export.")
        if "mesh" in node and not record["meshes"][node["mesh"]]["primitives"]:
            del node["mesh"]
    about = f"{path}: {left_out} parts are lines or points, which are ignored."
    notes = [about] if left_out else []
    if record.get("animations"):
        notes.append(f"{path}: its animations are ignored.")
    return record, notes


def _select_uv_set(path: str, attributes: dict[str, Any], material: Mapping[str, Any]) -> None:
    """Store the UV set of the material's textures as the first one."""
    sets = {_uv_set(texture) for texture in used_textures(material).values()}
    if len(sets) > 1:
        raise MeshError(
            f"{path}: its textures use several UV sets ({', '.join(map(str, sorted(sets)))}); bake "
            "them into one, or import only the geometry with --geometry-only."
        )
    for name in (f"TEXCOORD_{number}" for number in sets):
        if name not in attributes:
            raise MeshError(f"{path}: its texture uses {name}, which the mesh lacks; export again.")
        attributes["TEXCOORD_0"] = attributes[name]


def used_textures(material: Mapping[str, Any]) -> dict[str, Any]:
    """Return the references to textures that are read, by name."""
    known = material.get("pbrMetallicRoughness", {})
    return {name: known[name] for name in TEXTURES if name in known}


def _uv_set(texture: Mapping[str, Any]) -> int:
    moved = texture.get("extensions", {}).get("KHR_texture_transform", {})
    return int(moved.get("texCoord", texture.get("texCoord", 0)))
