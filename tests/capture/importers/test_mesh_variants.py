"""Variants of glTF, OBJ, MTL and PLY that other programs write."""

from __future__ import annotations

import io
import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from svu_mi.capture.importers import mesh_files, mesh_materials
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.errors import MeshError

POINTS = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], "<f4")
FACES = np.array([0, 1, 2, 0, 2, 3], "<u4")
UVS = np.array([[0.1, 0.9], [0.9, 0.9], [0.9, 0.2], [0.1, 0.2]], "<f4")
PICTURE = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)


def png() -> bytes:
    stream = io.BytesIO()
    Image.fromarray(PICTURE).save(stream, "PNG")
    return stream.getvalue()


def glb(path: Path, edit: Any = None) -> Path:
    """Write two textured triangles; ``edit(record, add)`` changes the header and adds arrays."""
    data = bytearray()
    record: dict[str, Any] = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}], "bufferViews": [], "accessors": [],
    }  # fmt: skip

    def view(raw: bytes) -> int:
        data.extend(bytes(-len(data) % 4))
        place = {"buffer": 0, "byteOffset": len(data), "byteLength": len(raw)}
        record["bufferViews"].append(place)
        data.extend(raw)
        return len(record["bufferViews"]) - 1

    def add(array: np.ndarray) -> int:
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        component = {"f": 5126, "u": 5125}[array.dtype.kind]
        record["accessors"].append({
            "bufferView": view(array.tobytes()), "componentType": component, "count": len(array),
            "type": kind,
        })  # fmt: skip
        return len(record["accessors"]) - 1

    attributes = {"POSITION": add(POINTS), "TEXCOORD_0": add(UVS)}
    triangles = {"attributes": attributes, "indices": add(FACES), "material": 0}
    base = {"baseColorTexture": {"index": 0}}
    record |= {
        "meshes": [{"primitives": [triangles]}],
        "images": [{"bufferView": view(png()), "mimeType": "image/png"}],
        "textures": [{"source": 0}], "materials": [{"pbrMetallicRoughness": base}],
    }  # fmt: skip
    if edit is not None:
        edit(record, add)
    record["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(record).encode()
    text += b" " * (-len(text) % 4)
    raw = bytes(data) + bytes(-len(data) % 4)
    lengths = struct.pack("<II", 2, 28 + len(text) + len(raw))
    chunks = struct.pack("<I", len(text)) + b"JSON" + text + struct.pack("<I", len(raw)) + b"BIN\0"
    path.write_bytes(b"glTF" + lengths + chunks + raw)
    return path


def triangles_of(record: dict[str, Any]) -> dict[str, Any]:
    return record["meshes"][0]["primitives"][0]


def base_of(record: dict[str, Any]) -> dict[str, Any]:
    return record["materials"][0]["pbrMetallicRoughness"]


def second_set(record: dict[str, Any], add: Any) -> None:
    """Two sets, of which the texture uses the second."""
    attributes = triangles_of(record)["attributes"]
    attributes |= {"TEXCOORD_0": add(UVS * np.float32(0.5)), "TEXCOORD_1": attributes["TEXCOORD_0"]}
    base_of(record)["baseColorTexture"]["texCoord"] = 1


def by_transform(record: dict[str, Any], add: Any) -> None:
    second_set(record, add)
    moved = {"KHR_texture_transform": {"texCoord": 1}}
    base_of(record)["baseColorTexture"] = {"index": 0, "texCoord": 0, "extensions": moved}


def of_normals(record: dict[str, Any], add: Any) -> None:
    """A texture that is ignored may use another set."""
    triangles_of(record)["attributes"]["TEXCOORD_1"] = add(UVS * np.float32(0.5))
    record["materials"][0]["normalTexture"] = {"index": 0, "texCoord": 1}


@pytest.mark.parametrize("edit", [None, second_set, by_transform, of_normals])
def test_uv_set_of_the_texture(tmp_path, edit):
    geometry = read_textured_mesh(glb(tmp_path / "mesh.glb", edit))
    np.testing.assert_allclose(geometry.mesh.uvs, UVS, atol=1e-6)
    np.testing.assert_array_equal(geometry.textures["base_color"], PICTURE)
    assert bool(geometry.notes) == (edit is of_normals)


def two_sets(record: dict[str, Any], add: Any) -> None:
    second_set(record, add)
    base_of(record)["metallicRoughnessTexture"] = {"index": 0}


def no_set(record: dict[str, Any], add: Any) -> None:
    base_of(record)["baseColorTexture"]["texCoord"] = 2


def requires(*names: str) -> Any:
    return lambda record, _: record.update(extensionsRequired=list(names))


def instanced(record: dict[str, Any], add: Any) -> None:
    scale = {"SCALE": add(np.full((1, 3), 0.1, "<f4"))}
    record["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": scale}}


def skinned(record: dict[str, Any], add: Any) -> None:
    record["nodes"][0]["skin"] = 0
    record["skins"] = [{"joints": [0]}]


def morphed(record: dict[str, Any], add: Any) -> None:
    record["meshes"][0]["weights"] = [0.5]
    triangles_of(record)["targets"] = [{"POSITION": add(POINTS)}]


def fan(record: dict[str, Any], add: Any) -> None:
    triangles_of(record)["mode"] = 6


REFUSED = {  # edit, message, whether --geometry-only helps
    "two UV sets": (two_sets, r"several UV sets \(0, 1\); bake", True),
    "a UV set that is not there": (no_set, "uses TEXCOORD_2, which the mesh lacks", True),
    "Basis": (requires("KHR_texture_basisu"), "KHR_texture_basisu.*gltf-transform", True),
    "AVIF": (requires("EXT_texture_avif"), "EXT_texture_avif.*gltf-transform", True),
    "Draco": (requires("KHR_draco_mesh_compression"), "requires KHR_draco.*gltf-transform", False),
    "meshopt": (requires("EXT_meshopt_compression"), "requires EXT_mesh.*gltf-transform", False),
    "instances": (instanced, "EXT_mesh_gpu_instancing, .*bake the instances", False),
    "an unknown extension": (requires("VENDOR_x"), "VENDOR_x, .*export it without", False),
    "a skeleton": (skinned, "deformed by a skeleton", False),
    "morph targets": (morphed, "deformed by morph targets", False),
    "a fan": (fan, "triangle fans", False),
}


@pytest.mark.parametrize("case", REFUSED)
def test_gltf_that_is_refused(tmp_path, case):
    edit, message, is_about_textures = REFUSED[case]
    path = glb(tmp_path / "mesh.glb", edit)
    with pytest.raises(MeshError, match=f"^{path}: .*{message}"):
        read_textured_mesh(path)
    if is_about_textures:
        mesh = read_textured_mesh(path, geometry_only=True).mesh
        np.testing.assert_array_equal(mesh.positions[mesh.faces.ravel()], POINTS[FACES])
    else:
        with pytest.raises(MeshError, match=message):
            read_textured_mesh(path, geometry_only=True)


def lines(record: dict[str, Any], add: Any) -> None:
    part = {"attributes": triangles_of(record)["attributes"], "mode": 1}
    record["meshes"][0]["primitives"].append(part)


def points_elsewhere(record: dict[str, Any], add: Any) -> None:
    part = {"attributes": {"POSITION": add(POINTS * np.float32(9))}, "mode": 0}
    record["meshes"].append({"primitives": [part]})
    record["nodes"].append({"mesh": 1})
    record["scenes"][0]["nodes"].append(1)


def unread(record: dict[str, Any], add: Any) -> None:
    record["bufferViews"][record["images"][0]["bufferView"]]["byteLength"] = 20


def optional_basis(record: dict[str, Any], add: Any) -> None:
    record["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}


def animated(record: dict[str, Any], add: Any) -> None:
    record["animations"] = [{"channels": [], "samplers": []}]


def colored(record: dict[str, Any], add: Any) -> None:
    triangles_of(record)["attributes"]["COLOR_0"] = add(np.ones((4, 4), "<f4"))


REPORTED = {
    "lines": (lines, "1 parts are lines or points"),
    "points in another node": (points_elsewhere, "1 parts are lines or points"),
    "a broken picture": (unread, "baseColorTexture could not be read"),
    "an optional KTX2 picture": (optional_basis, "baseColorTexture could not be read"),
    "animations": (animated, "animations are ignored"),
    "vertex colours": (colored, "vertex colours"),
}


@pytest.mark.parametrize("case", REPORTED)
def test_gltf_that_is_reported(tmp_path, case):
    edit, message = REPORTED[case]
    geometry = read_textured_mesh(glb(tmp_path / "mesh.glb", edit))
    assert any(message in note for note in geometry.notes)
    np.testing.assert_array_equal(
        geometry.mesh.positions[geometry.mesh.faces.ravel()], POINTS[FACES]
    )


def test_lines_alone_are_no_mesh(tmp_path):
    path = glb(tmp_path / "mesh.glb", lambda record, _: triangles_of(record).update(mode=1))
    with pytest.raises(MeshError, match="contains no triangle mesh"):
        read_textured_mesh(path)


def obj(
    folder: Path, statement: str, *, picture: str = "base.png", library: str = "mesh.mtl"
) -> Path:
    """Write two triangles with a material that has one statement."""
    corners = [f"v {x} {y} {z}" for x, y, z in POINTS]
    coordinates = [f"vt {u:.6f} {1 - v:.6f}" for u, v in UVS]
    faces = ["usemtl m", "f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
    folder.mkdir(exist_ok=True)
    path = folder / "mesh.obj"
    path.write_text("\n".join([f"mtllib {library}", *corners, *coordinates, *faces]) + "\n")
    (folder / "mesh.mtl").write_text(f"newmtl m\nKd 1 1 1\n{statement}\n")
    if picture:
        (folder / picture).write_bytes(png())
    return path


PLAIN = [
    "map_Kd base.png", "MAP_KD base.png", "map_Kd\tbase.png", "  map_kd base.png  # a comment",
    "map_Kd C:\\scan\\out\\base.png", "map_Kd /home/me/out/base.png", "map_Kd BASE.PNG",
    "map_Kd -s 1 1 1 -clamp on base.png", "map_Kd -o 0 0 -mm 0 1 -bm 1.0 base.png",
    "map_Kd -blendu off -imfchan r -s 1 base.png",
    'map_Kd "base.png"', 'map_Kd -s 1 1 1 "base.png"',
]  # fmt: skip


@pytest.mark.parametrize("statement", PLAIN)
def test_pictures_of_obj_materials(tmp_path, statement):
    geometry = read_textured_mesh(obj(tmp_path, statement))
    np.testing.assert_array_equal(geometry.textures["base_color"], PICTURE)
    np.testing.assert_allclose(geometry.mesh.uvs, UVS, atol=1e-6)
    elsewhere = [note for note in geometry.notes if "not at the given paths" in note]
    assert len(elsewhere) == any(sign in statement for sign in ("\\", "/home", "BASE"))


@pytest.mark.parametrize("statement", ["map_Kd my#1 tex.png", 'map_Kd "my#1 tex.png"'])
def test_names_with_spaces(tmp_path, statement):
    geometry = read_textured_mesh(obj(tmp_path, statement, picture="my#1 tex.png"))
    np.testing.assert_array_equal(geometry.textures["base_color"], PICTURE)


@pytest.mark.parametrize(
    "option", ["-s 2 2 1", "-o 0.5 0", "-clamp on -s 1 2", "-O 0 0.1", "-t 1 0 0"]
)
def test_moved_textures_are_refused(tmp_path, option):
    path = obj(tmp_path, f"map_Kd {option} base.png")
    name = next(word for word in option.lower().split() if word in ("-s", "-o", "-t"))
    with pytest.raises(MeshError, match=f"moved or scaled by {name}; apply .*--geometry-only"):
        read_textured_mesh(path)
    assert read_textured_mesh(path, geometry_only=True).mesh.uvs is None


@pytest.mark.parametrize(
    ("options", "name"),
    [("-clamp", "-clamp"), ("-o 0 0", "0"), ("-bm -s 1", "1"), ("-clamp on " * 50_000 + "a", "a")],
)
def test_the_last_word_of_a_statement_is_the_picture(tmp_path, options, name):
    (note,) = read_textured_mesh(obj(tmp_path, f"map_Kd {options}")).notes
    assert note == f"{tmp_path / 'mesh.obj'}: refers to {name}, which does not exist."


@pytest.mark.parametrize(("name", "limit"), [("mesh.mtl", 16), ("base.png", 2048)])
def test_files_of_a_mesh_that_are_too_large_are_refused_unread(tmp_path, name, limit):
    path = obj(tmp_path, "map_Kd base.png")
    os.truncate(tmp_path / name, 2**38)  # without the memory for it, trimesh would leave it out
    sentence = f"mesh.obj: {name} is larger than {limit} MiB; export a smaller one"
    with pytest.raises(MeshError, match=sentence):
        read_textured_mesh(path)


def test_limits_of_a_mesh_and_its_pictures(tmp_path, monkeypatch):
    path = obj(tmp_path, "map_Kd base.png")
    for module, name, most, sentence in (
        (mesh_materials, "MAX_PIXELS", 4 * 5, "a texture of 5 x 4 pixels is too large"),
        (mesh_files, "MAX_BYTES", path.stat().st_size, "mesh.obj: larger than 0 MiB; simplify"),
    ):
        monkeypatch.setattr(module, name, most)
        assert read_textured_mesh(path).textures
        monkeypatch.setattr(module, name, most - 1)
        with pytest.raises(MeshError, match=sentence):
            read_textured_mesh(path)
        monkeypatch.undo()


def test_a_material_with_too_many_textures_is_refused(tmp_path):
    path = obj(tmp_path, "map_Kd base.png\n" * 1000)
    np.testing.assert_array_equal(read_textured_mesh(path).textures["base_color"], PICTURE)
    path = obj(tmp_path, "map_Kd base.png\n" * 1001)
    with pytest.raises(MeshError, match="its MTL has over 1000 textures; export one material"):
        read_textured_mesh(path)


@pytest.mark.parametrize("name", ["points.obj", "points.ply"])
def test_points_are_no_mesh(tmp_path, name):
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    (tmp_path / "points.ply").write_text(f"{head}end_header\n0 0 0\n1 0 0\n0 1 0\n")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(MeshError, match=f"{name}: contains no triangle mesh; export one"):
        read_textured_mesh(tmp_path / name)


def test_geometry_only_opens_no_material(tmp_path):
    path = obj(tmp_path, "map_Kd /etc/passwd", picture="")
    with pytest.raises(MeshError, match="lies outside"):
        read_textured_mesh(path)
    geometry = read_textured_mesh(path, geometry_only=True)
    assert len(geometry.mesh.faces) == 2 and not geometry.notes
    (tmp_path / "mesh.mtl").unlink()
    assert not read_textured_mesh(path, geometry_only=True).notes
    (note,) = read_textured_mesh(path).notes
    assert "refers to mesh.mtl, which does not exist" in note


def ply(path: Path, *, header: str = "", properties: str = "", extra: str = "") -> Path:
    """Write two triangles with UVs, and ``extra`` values per vertex."""
    rows = [
        f"{x} {y} {z} {u} {1 - v:.6f}{extra}" for (x, y, z), (u, v) in zip(POINTS, UVS, strict=True)
    ]
    names = [f"property float {name}" for name in ("x", "y", "z", "s", "t")]
    lines = [
        "ply", "format ascii 1.0", *header.split("\n")[:-1], f"element vertex {len(POINTS)}",
        *names, *properties.split("\n")[:-1], "element face 2",
        "property list uchar int vertex_indices", "end_header", *rows, "3 0 1 2", "3 0 2 3",
    ]  # fmt: skip
    path.write_text("\n".join(lines) + "\n")
    (path.parent / "base.png").write_bytes(png())
    return path


def moved(record: dict[str, Any], _: Any) -> None:
    scaled = {"KHR_texture_transform": {"scale": [2, 2]}}
    base_of(record)["baseColorTexture"]["extensions"] = scaled


def placed(record: dict[str, Any], add: Any) -> None:
    """Two mirrored nodes that cancel each other."""
    record["nodes"] = [{"children": [1], "scale": [-2, 1, 1]}, {"mesh": 0, "scale": [-0.5, 1, 1]}]


def with_normal_map(record: dict[str, Any], _: Any) -> None:
    record["materials"][0]["normalTexture"] = {"index": 0}


def with_occlusion(record: dict[str, Any], _: Any) -> None:
    record["materials"][0]["occlusionTexture"] = {"index": 0}


def both_sides(record: dict[str, Any], _: Any) -> None:
    record["materials"][0]["doubleSided"] = True


def changed_obj(folder: Path, old: str, new: str) -> Path:
    path = obj(folder, "map_Kd base.png")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def colored_obj(folder: Path) -> Path:
    path = obj(folder, "map_Kd base.png")
    rows = path.read_text().split("\n")
    path.write_text("\n".join(f"{row} 1 0 0" if row[:2] == "v " else row for row in rows))
    return path


COLORS = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
PAINTED = "comment TextureFile base.png\n"
FIELDS = {  # by words of the row of the table
    "transforms of nodes": lambda d: glb(d / "a.glb", placed),
    "`texCoord`": lambda d: glb(d / "a.glb", second_set),
    "several UV sets": lambda d: glb(d / "a.glb", two_sets),
    "`KHR_texture_transform`": lambda d: glb(d / "a.glb", moved),
    "compression": lambda d: glb(d / "a.glb", requires("EXT_meshopt_compression")),
    "`EXT_mesh_gpu": lambda d: glb(d / "a.glb", instanced),
    "`KHR_texture_basisu`": lambda d: glb(d / "a.glb", requires("KHR_texture_basisu")),
    "other required": lambda d: glb(d / "a.glb", requires("VENDOR_x")),
    "skins": lambda d: glb(d / "a.glb", skinned),
    "triangle fans": lambda d: glb(d / "a.glb", fan),
    "lines and points": lambda d: glb(d / "a.glb", lines),
    "animations": lambda d: glb(d / "a.glb", animated),
    "`COLOR_0`": lambda d: glb(d / "a.glb", colored),
    "normal texture": lambda d: glb(d / "a.glb", with_normal_map),
    "occlusion": lambda d: glb(d / "a.glb", with_occlusion),
    "pictures that": lambda d: glb(d / "a.glb", optional_basis),
    "`doubleSided`": lambda d: glb(d / "a.glb", both_sides),
    "lines (`l`)": lambda d: changed_obj(d, "usemtl m", "l 1 2\np 1\ng part\ns off\nusemtl m"),
    "colours after": colored_obj,
    "several objects": lambda d: changed_obj(d, "f 1/1 3/3 4/4", "o table\nf 1/1 3/3 4/4\no vase"),
    "vertex 0": lambda d: changed_obj(d, "f 1/1 3/3 4/4", "f 0/1 2/3 3/4"),
    "relative indices": lambda d: changed_obj(d, "f 1/1 3/3 4/4", "f -4/1 -2/3 -1/4\nv 0 0 9"),
    "paths of `map_Kd`": lambda d: obj(d, "map_Kd textures/base.png"),
    "options `-s`": lambda d: obj(d, "map_Kd -s 2 2 base.png"),
    "other options": lambda d: obj(d, "map_Kd -clamp on base.png"),
    "bump, normal": lambda d: obj(d, "map_Kd base.png\nmap_Bump base.png"),
    "`comment TextureFile`": lambda d: ply(d / "a.ply", header=PAINTED),
    "several textures": lambda d: ply(d / "a.ply", header=PAINTED * 2),
    "PLY | vertex colours": lambda d: ply(d / "a.ply", properties=COLORS, extra=" 9 9 9"),
    "other properties": lambda d: ply(
        d / "a.ply", header=PAINTED, properties="property float quality\n", extra=" 0.5"
    ),
}


def rows() -> list[str]:
    text = (Path(__file__).parents[3] / "notebooks/capture.md").read_text()
    table = text.split("**Meshes, field by field.**")[1].split("\n\n")[1]
    return table.split("\n")[2:]


def test_every_row_has_a_case():
    assert [sum(words in row for words in FIELDS) for row in rows()] == [1] * len(FIELDS)


@pytest.mark.parametrize("row", rows())
def test_treatment_of_a_field(tmp_path, row):
    (make,) = (make for words, make in FIELDS.items() if words in row)
    treatment = row.split("|")[-2].strip()
    if treatment == "refused":
        with pytest.raises(MeshError):
            read_textured_mesh(make(tmp_path))
        return
    geometry = read_textured_mesh(make(tmp_path))
    np.testing.assert_allclose(geometry.mesh.positions[geometry.mesh.faces.ravel()], POINTS[FACES])
    if treatment in ("followed", "harmless"):
        np.testing.assert_allclose(geometry.mesh.uvs, UVS, atol=1e-6)
        np.testing.assert_array_equal(geometry.textures["base_color"], PICTURE)
    assert bool(geometry.notes) == (treatment == "reported" or "paths" in row)
