"""Textures of mesh files as parameters of ``principled``; checks of glTF headers.

Without an error, trimesh reads normalised integers of glTF as coordinates, ignores sparse accessors
and texture transforms, and reads compressed data as zeros. Such files are refused. Names follow
https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

import io
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from PIL import Image
from trimesh.visual.material import empty_material

from svu_mi.capture.image_io import decoded, open_image, quantized, srgb
from svu_mi.capture.importers.gltf_extensions import refuse_extensions, used_textures
from svu_mi.capture.importers.source_files import find_file
from svu_mi.core.io.files import replacing
from svu_mi.core.io.schema import ITEMS, WHOLE, Field, checked
from svu_mi.errors import MeshError, excerpt

MAX_PIXELS = 2**26  # 8192 x 8192
CONSTANT = 4  # pixels per side of the texture of a constant factor

# Statements of OBJ materials that are ignored.
IGNORED = {
    "bump": "a bump map", "map_bump": "a bump map", "norm": "a normal map", "disp": "displacement",
}  # fmt: skip

# By parameter: base_color (H, W, 3) bytes, sRGB; roughness and metallic (H, W) bytes, linear.
Textures = Mapping[str, np.ndarray]

GLTF = (".glb", ".gltf")
TRANSFORM = "KHR_texture_transform"
IDENTITY = {"offset": [0, 0], "scale": [1, 1], "rotation": 0}  # without effect
FLOAT = 5126
FREE = 2**20  # numbers in any file; larger counts must fit the file size
ATTRIBUTES = ("POSITION", "NORMAL", "TEXCOORD_0")
NORMALS = "a normal map"
# Parts of glTF materials that are ignored; of normal maps, those that do not fit.
IGNORED_GLTF = {
    "normalTexture": NORMALS, "occlusionTexture": "an occlusion map",
    "emissiveTexture": "emission", "alphaMode": "transparency",
}  # fmt: skip
DEEPEST = 500  # nested nodes, as in scenes; trimesh's time grows with the square
SIZE = Field(WHOLE, (), 0, 2**40, default=0)
INDICES = Field(WHOLE, (ITEMS,), 0, 2**31, default=())
HEADER = {
    "accessors": Field({"byteOffset": SIZE, "count": SIZE}, (ITEMS,), default=()),
    "bufferViews": Field({"byteOffset": SIZE, "byteLength": SIZE}, (ITEMS,), default=()),
    "nodes": Field({"children": INDICES}, (ITEMS,), default=()), "scene": SIZE,
    "scenes": Field({"nodes": INDICES}, (ITEMS,), default=({"nodes": ()},)),
}  # fmt: skip
MODEL = "KHR_materials_"  # prefix of extensions of the reflection model


def textures_of(visual: Any, path: Path) -> Textures:
    """Return the textures of the ``visual`` of a ``trimesh.Trimesh``.

    Textures are multiplied by the material's factors (base colour in linear light); normal maps,
    occlusion and emission are ignored. Only the diffuse picture of OBJ materials is read.
    """
    material = getattr(visual, "material", None)
    try:
        if hasattr(material, "baseColorTexture"):
            return _gltf_textures(material)
        picture = getattr(material, "image", None)
        return {"base_color": _rgb(picture)} if is_textured(visual) else {}
    except Exception as error:  # Pillow's decoders raise any type
        raise MeshError(
            f"{path}: a texture cannot be read ({excerpt(error)}); export it again."
        ) from error


def is_textured(visual: Any) -> bool:
    """Return whether a mesh has at least one texture picture."""
    material = getattr(visual, "material", None)
    if getattr(material, "image", None) is not None:
        return hash(material) != hash(
            empty_material()
        )  # default of trimesh for UVs without a material
    names = ("baseColorTexture", "metallicRoughnessTexture")
    return any(getattr(material, name, None) is not None for name in names)


def ignored_in_obj(visual: Any) -> list[str]:
    """Return the names of ignored parts of an OBJ's material, such as ``a bump map``."""
    said = getattr(getattr(visual, "material", None), "kwargs", None) or {}
    return [name for key, name in IGNORED.items() if key in said]


def load_pictures(visual: Any) -> None:
    """Decode all pictures of a material; raise ValueError if one is too large."""
    material = getattr(visual, "material", None)
    for name in ("image", "baseColorTexture", "metallicRoughnessTexture"):
        picture = getattr(material, name, None)
        if picture is None:
            continue
        if picture.width * picture.height > MAX_PIXELS:
            raise ValueError(f"a texture of {picture.width} x {picture.height} pixels is too large")
        picture.load()


def png_of(path: Path) -> bytes:
    """Convert a picture, such as an EXR, to a PNG of 8 bits in sRGB; values above 1 become 1."""
    linear = np.stack(open_image(path).linear(), axis=-1)
    stream = io.BytesIO()
    Image.fromarray(quantized(srgb(np.clip(np.nan_to_num(linear), 0, 1)))).save(stream, "PNG")
    return stream.getvalue()


def normal_picture(path: Path, visual: Any) -> np.ndarray | None:
    """Return the normal map of a glTF's only material, (H, W, 3) bytes; None without a usable one.

    It must use the UVs of the base colour, without scale or extensions, as the tangents of
    Mitsuba's ``normalmap`` do.
    """
    picture = getattr(getattr(visual, "material", None), "normalTexture", None)
    with_maps = [m for m in header_of(path).get("materials", ()) if "normalTexture" in m]
    if picture is None or len(with_maps) != 1 or picture.width * picture.height > MAX_PIXELS:
        return None
    entry = with_maps[0]["normalTexture"]
    base = with_maps[0].get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    if entry.get("texCoord", 0) != base.get("texCoord", 0) or entry.get("scale", 1) != 1:
        return None
    if "extensions" in entry or "extensions" in base:
        return None
    return np.array(picture.convert("RGB"))


def write_pictures(textures: Textures, folder: Path) -> None:
    """Write pictures by name: ``base_color.png``, ``roughness.png``, ``metallic.png``."""
    for name, pixels in textures.items():
        with replacing(folder / f"{name}.png") as temporary:
            Image.fromarray(np.ascontiguousarray(pixels)).save(temporary)


def _gltf_textures(material: Any) -> Textures:
    base, factor = _rgb(material.baseColorTexture), material.baseColorFactor
    factor = np.ones(3) if factor is None else np.array(factor, np.float64)[:3]
    # trimesh may store the linear factor as bytes.
    factor = factor / 255 if factor.max() > 1 else factor
    packed = _rgb(material.metallicRoughnessTexture)
    rough, metal = (
        1.0 if value is None else float(value)
        for value in (material.roughnessFactor, material.metallicFactor)
    )
    if (factor != 1).any():
        base = quantized(srgb(decoded(base / 255) * factor))
    return {
        "base_color": base,
        "roughness": quantized(packed[..., 1] / 255 * rough),
        "metallic": quantized(packed[..., 2] / 255 * metal),
    }


def _rgb(picture: Any) -> np.ndarray:
    """Return (H, W, 3) bytes; white without a texture."""
    if picture is None:
        return np.full((CONSTANT, CONSTANT, 3), 255, np.uint8)
    return np.array(picture.convert("RGB"))


def check_gltf(path: Path, *, geometry_only: bool) -> int:
    """Return the size of a glTF and its buffers in bytes; raise for unsupported features."""
    record = header_of(path)
    refuse_extensions(str(path), record, geometry_only=geometry_only)
    held = _file_bytes(path, record)
    known = checked(record, HEADER)
    _refuse_bombs(path, record, [accessor["count"] for accessor in known["accessors"]], held)
    roots = known["scenes"][known["scene"]]["nodes"]
    _refuse_nesting(path, [node["children"] for node in known["nodes"]], roots)
    attributes = ATTRIBUTES[:2] if geometry_only else ATTRIBUTES
    accessors = record.get("accessors", ())
    for primitive in _primitives(record):
        used = {name: primitive["attributes"].get(name) for name in attributes}
        for name, index in {**used, "indices": primitive.get("indices")}.items():
            given = {} if index is None else accessors[index]
            quantised = name != "indices" and given.get("componentType", FLOAT) != FLOAT
            if quantised or "sparse" in given:
                raise MeshError(
                    f"{path}: its {name} is quantised or sparse; export it with plain numbers, or "
                    "convert it with gltf-transform dequantize."
                )
    if not geometry_only and any(map(_has_transform, _nested_objects(record.get("materials", ())))):
        raise MeshError(
            f"{path}: its textures are moved or scaled by {TRANSFORM}; apply that to the UVs, or "
            "import only the geometry with --geometry-only."
        )
    return held


def ignored_in_gltf(path: Path) -> list[str]:
    """Return the names of ignored parts of a glTF's materials, such as ``a normal map``."""
    record = header_of(path)
    materials = record.get("materials", [])
    primitives = _primitives(record)
    used = [materials[p["material"]] for p in primitives if "material" in p]
    names = []
    for material in used:
        names += [n for key, n in IGNORED_GLTF.items() if material.get(key, "OPAQUE") != "OPAQUE"]
        names += ["emission"] if any(material.get("emissiveFactor", ())) else []
        extensions = [key for key in material.get("extensions", ()) if key.startswith(MODEL)]
        names += [key.removeprefix(MODEL) for key in extensions]
    names += ["vertex colours" for p in primitives if "COLOR_0" in p["attributes"]]
    return list(dict.fromkeys(names))


def _primitives(record: Mapping[str, Any]) -> list[Any]:
    return [p for mesh in record.get("meshes", ()) for p in mesh["primitives"]]


def header_of(path: Path) -> dict[str, Any]:
    """Return the JSON part of a glTF or GLB file."""
    if path.suffix.lower() == ".gltf":
        return dict(json.loads(path.read_bytes()))
    with path.open("rb") as stream:
        (length,) = struct.unpack_from("<I", stream.read(20), 12)
        return dict(json.loads(stream.read(length)))


def with_header(path: Path, record: Mapping[str, Any]) -> io.BytesIO:
    """Return the content of a glTF or GLB file with another JSON part."""
    text = json.dumps(record).encode()
    if path.suffix.lower() == ".gltf":
        return io.BytesIO(text)
    raw = path.read_bytes()
    rest = raw[20 + struct.unpack_from("<I", raw, 12)[0] :]
    text += b" " * (-len(text) % 4)
    lengths = struct.pack("<II", 20 + len(text) + len(rest), len(text))
    return io.BytesIO(raw[:8] + lengths + b"JSON" + text + rest)


def unread_textures(path: Path, visuals: Sequence[Any]) -> list[str]:
    """Return the names of textures in a glTF that trimesh could not read."""
    names = {name for m in header_of(path).get("materials", ()) for name in used_textures(m)}
    known = [getattr(visual, "material", None) for visual in visuals]
    return sorted(n for n in names if all(getattr(m, n, None) is None for m in known))


def _file_bytes(path: Path, record: Mapping[str, Any]) -> int:
    """Return the size of the file and its buffers in bytes."""
    names = [buffer.get("uri", "data:") for buffer in record.get("buffers", ())]
    names = [unquote(name) for name in names if not name.startswith("data:")]
    files = {path, *(find_file(path.parent, name, str(path), moved=True) for name in names)}
    return sum(file.stat().st_size for file in files if file.is_file())


def _refuse_bombs(path: Path, record: Mapping[str, Any], counts: list[int], held: int) -> None:
    used = [counts[index] for p in _primitives(record) for index in p["attributes"].values()]
    if max(sum(counts), sum(used)) > max(FREE, held):
        raise MeshError(f"{path}: an accessor reads past the end of the file; export it again.")


def _refuse_nesting(path: Path, children: Sequence[list[int]], level: list[int]) -> None:
    """Raise unless the nodes below ``level`` are trees, of limited depth."""
    linked = [*level, *(child for node in children for child in node)]
    if len(set(linked)) < len(linked):
        raise MeshError(f"{path}: a node has two parents; export it again.")
    for _ in range(DEEPEST):
        level = [child for index in level for child in children[index]]
    if level:
        raise MeshError(
            f"{path}: nodes are nested more than {DEEPEST} deep; export it with fewer levels."
        )


def _nested_objects(value: Any) -> Iterator[Mapping[str, Any]]:
    """Return all objects inside a JSON value."""
    if isinstance(value, Mapping):
        yield value
    for item in value.values() if isinstance(value, Mapping) else value:
        if isinstance(item, Mapping | list):
            yield from _nested_objects(item)


def _has_transform(record: Mapping[str, Any]) -> bool:
    given = record.get(TRANSFORM)
    return given is not None and any(given.get(key, same) != same for key, same in IDENTITY.items())
