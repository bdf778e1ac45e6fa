"""``svu export``: what is in each file, read back by other programs, and what is refused."""

from __future__ import annotations

import base64
import io
import json
import shutil
import struct
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import MaterialX as mx
import MaterialX.PyMaterialXGenGlsl as gen_glsl
import MaterialX.PyMaterialXGenShader as gen_shader
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from support.helpers import ball, lettered, recovered_folder, write_known, write_older

import svu_mi as svu
from svu_mi.capture import mesh as meshes
from svu_mi.capture.image_io import srgb
from svu_mi.capture.normal_map import texture_of
from svu_mi.cli.main import main
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import CaptureError, MeshError, OptionError, OutputError, ShapeError
from svu_mi.output.export.asset import usable_normals
from svu_mi.output.export.glb import front_faces
from svu_mi.output.export.uv_gutters import at_vertices, inside_charts, with_gutters
from svu_mi.output.export.write_asset import FORMATS
from svu_mi.recovery.svbrdf_textures import Textures

RNG_SEED = 2061455329
WIDTH, HEIGHT = 56, 40
PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n"
NORMAL = "property float nx\n"
UVS = np.array([0.15, 0.1]) + np.array([0.75, 0.7]) * ball().uvs


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A folder as ``svu recover`` writes it, with entropy at another resolution."""
    folder = tmp_path_factory.mktemp("result")
    capture = recovered_folder(folder, lettered(WIDTH, HEIGHT))
    entropy, coverage = write_known(folder, 32, 48)
    return SimpleNamespace(folder=folder, capture=capture, entropy=entropy, coverage=coverage)


@pytest.fixture(scope="module")
def exported(result, tmp_path_factory):
    """Everything that can be exported of it."""
    folder = tmp_path_factory.mktemp("asset")
    svu.export_asset(result.folder, folder)
    return folder


@pytest.fixture
def asset(result):
    return svu.load_asset(result.folder)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def pixels(path):
    return np.array(mi.Bitmap(str(path)))


def gltf(path):
    """JSON part of a GLB file (glTF 2.0, Sec. 4.4)."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + size])


# --- Files --------------------------------------------------------------------------------


def test_the_record_names_every_file(exported, result):
    record = json.loads((exported / "asset.json").read_text())
    named = [each["file"] for each in record["files"]]
    assert sorted(named) == sorted(EVERY_HERE)
    assert files(exported) == sorted([*named, "asset.json"])
    assert record["source"] == str(result.folder)
    assert record["name"] == "ball"
    assert record["textures"]["resolution"] == [WIDTH, HEIGHT]
    spaces = {each["file"]: each["values"] for each in record["files"]}
    assert (
        "sRGB" in spaces["textures/base_color.png"]
        and "white is 3" in spaces["textures/coverage.png"]
    )


IMAGES = ("base_color", "roughness", "metallic", "orm", "entropy", "coverage")
EVERY_HERE = [
    *(f"textures/{name}.png" for name in IMAGES),
    *(f"textures/{name}.exr" for name in IMAGES if name != "orm"),
    "asset.glb", "entropy.glb", "object.xml", "preview.xml", "mesh.ply", "material.mtlx",
    "mesh.obj",
]  # fmt: skip


@pytest.mark.parametrize(("formats", "names"), [
    (("glb",), ["asset.glb", "entropy.glb"]),
    (("materialx",), ["material.mtlx", "mesh.obj", "textures/orm.png"]),
    (("xml",), ["mesh.ply", "object.xml", "preview.xml", "textures/base_color.exr"]),
])  # fmt: skip
def test_a_format_writes_its_files_and_replaces_an_older_export(asset, tmp_path, formats, names):
    older = ("entropy.glb", "textures/roughness.png", "textures/coverage.exr", "mesh.obj")
    write_older(tmp_path, "export", "asset.json", older)
    svu.export_asset(asset, tmp_path, svu.ExportOptions(formats=formats))
    record = json.loads((tmp_path / "asset.json").read_text())
    named = {each["file"] for each in record["files"]}
    assert set(names) <= named
    assert set(files(tmp_path)) == {*named, "asset.json"}
    assert b"older" not in {(tmp_path / name).read_bytes() for name in named}


def test_a_folder_with_other_files_is_refused(asset, tmp_path):
    (tmp_path / "object.xml").write_text("mine")
    with pytest.raises(OutputError, match="contains other files: object.xml"):
        svu.export_asset(asset, tmp_path)
    assert files(tmp_path) == ["object.xml"] and (tmp_path / "object.xml").read_text() == "mine"


# --- Images -------------------------------------------------------------------------------


def test_exr_textures_are_those_recovered(exported, result, asset, tmp_path):
    inside = inside_charts(asset, (HEIGHT, WIDTH))
    for name in ("base_color", "roughness", "metallic"):
        written, given = (read_exr(folder / f"{name}.exr")
                        for folder in (exported / "textures", result.folder))  # fmt: skip
        assert list(written) == list(given)
        for channel, values in given.items():
            np.testing.assert_array_equal(written[channel][inside], values[inside])
    svu.export_asset(result.folder, tmp_path, svu.ExportOptions(formats=("exr",), half=True))
    assert pixels(tmp_path / "textures/roughness.exr").dtype == np.float16


@pytest.mark.parametrize("bits", [8, 16])
def test_png_textures_are_rounded_and_encoded(asset, tmp_path, bits):
    svu.export_asset(asset, tmp_path, svu.ExportOptions(formats=("exr", "png"), bits=bits))
    most, folder = 2**bits - 1, tmp_path / "textures"
    names = ("base_color", "roughness", "metallic", "entropy", "coverage")
    truth = {name: pixels(folder / f"{name}.exr").squeeze() for name in names}
    truth["base_color"] = srgb(truth["base_color"])
    truth["coverage"] = truth["coverage"] / 3
    truth["orm"] = np.dstack([np.ones((HEIGHT, WIDTH)), truth["roughness"], truth["metallic"]])
    for name, values in truth.items():
        image = pixels(folder / f"{name}.png").squeeze()
        assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
        np.testing.assert_allclose(image / most, values, atol=0.501 / most, err_msg=name)
        # A gamma of data would make a viewer change it.
        assert (b"gAMA" in (folder / f"{name}.png").read_bytes()) == (name == "base_color")


def test_gutters_hold_the_nearest_value(asset):
    """Junk outside the charts never survives; beyond a narrow gutter nothing is known."""
    inside = inside_charts(asset, (HEIGHT, WIDTH))
    junk = {name: np.where(inside[..., None], np.array(tensor), np.float32(0.9))
            for name, tensor in asset.textures.items()}  # fmt: skip
    around = ~inside_charts(asset, asset.entropy.shape)
    entropy = np.where(around, np.float32(0.3), asset.entropy)
    spoilt = replace(asset, textures=Textures.of(junk), entropy=entropy)
    filled, narrow = with_gutters(spoilt, None), with_gutters(spoilt, 2)
    assert not np.isin(np.float32(0.9), np.array(filled.textures.roughness))
    assert filled.coverage[0, 0] == 3 and filled.coverage[0, -1] == 0
    row = HEIGHT // 2
    changed = np.array(narrow.textures.roughness)[row, :, 0] != junk["roughness"][row, :, 0]
    first, *_, last = np.flatnonzero(inside[row])
    assert list(np.flatnonzero(changed)) == [first - 2, first - 1, last + 1, last + 2]
    assert narrow.entropy[0, 0] == 1 and narrow.coverage[0, 0] == 0


# --- Meshes -------------------------------------------------------------------------------


def test_trimesh_reads_the_glb(exported, asset):
    scene = trimesh.load_scene(exported / "asset.glb", process=False)
    ((name, mesh),) = scene.geometry.items()
    assert name == "ball"
    np.testing.assert_allclose(mesh.vertices, asset.mesh.positions, atol=1e-6)
    np.testing.assert_allclose(mesh.vertex_normals, asset.mesh.normals, atol=1e-6)
    np.testing.assert_allclose(1 - mesh.visual.uv[:, 1], asset.mesh.uvs[:, 1], atol=1e-6)
    np.testing.assert_allclose(mesh.visual.uv[:, 0], asset.mesh.uvs[:, 0], atol=1e-6)
    material = mesh.visual.material
    png = exported / "textures"
    for texture, file in ((material.baseColorTexture, "base_color"),
                          (material.metallicRoughnessTexture, "orm")):  # fmt: skip
        np.testing.assert_array_equal(np.array(texture), np.array(Image.open(png / f"{file}.png")))
    tree = gltf(exported / "asset.glb")
    described = tree["materials"][0]
    pbr = described["pbrMetallicRoughness"]
    assert pbr.get("metallicFactor", 1) == pbr.get("roughnessFactor", 1) == 1
    assert pbr.get("baseColorFactor", [1] * 4) == [1] * 4
    assert not described.get("doubleSided", False)
    assert "uri" not in tree["buffers"][0] and all("uri" not in i for i in tree["images"])
    assert set(tree["meshes"][0]["primitives"][0]["attributes"]) == {
        "POSITION", "NORMAL", "TEXCOORD_0", "_ENTROPY", "_COVERAGE",
    }  # fmt: skip


def test_entropy_is_at_the_vertices_of_both_glb_files(exported, asset):
    main = trimesh.load_scene(exported / "asset.glb", process=False).to_mesh()
    known = main.vertex_attributes["_ENTROPY"].ravel()
    u, v = asset.mesh.uvs.T
    inner = (u > 0.25) & (u < 0.45) & (v > 0.15) & (v < 0.75)
    np.testing.assert_allclose(known[inner], u[inner], atol=0.02)
    assert (known[(u > 0.6) & (u < 0.8) & (v > 0.15) & (v < 0.75)] == 1).all()
    (colored,) = trimesh.load_scene(exported / "entropy.glb", process=False).geometry.values()
    colors = colored.visual.vertex_attributes["color"][:, :3]
    # viridis ends in (253, 231, 37) of sRGB; COLOR_0 is linear.
    ends = np.round(255 * ((np.array([253, 231, 37]) / 255 + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(colors[np.argmax(known)], ends, atol=1)
    tree = gltf(exported / "entropy.glb")
    assert "KHR_materials_unlit" in tree["materials"][0]["extensions"]
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]


def test_means_at_vertices_know_no_seam(asset):
    """A constant stays; a linear function of position returns; a pole has one value."""
    ones = np.ones((160, 192), np.float32)
    np.testing.assert_allclose(at_vertices(asset.mesh, ones), 1, rtol=1e-6)
    laid_out = svu.texels(meshes.make_mesh("ball", asset.mesh), (192, 160))
    heights = at_vertices(asset.mesh, laid_out.to_image(np.array(laid_out.position)[1]))
    middle = np.abs(asset.mesh.positions[:, 1]) < 0.8
    edge = np.pi / 24
    np.testing.assert_allclose(heights[middle], asset.mesh.positions[middle, 1], atol=edge / 4)
    assert len(set(heights[asset.mesh.positions[:, 1] == 1])) == 1
    u = np.round(asset.mesh.uvs[:, 0], 6)  # the seam: one meridian at both ends of the chart
    np.testing.assert_array_equal(heights[u == u.min()], heights[u == u.max()])
    coarse = at_vertices(asset.mesh, np.arange(6, dtype=np.float32).reshape(3, 2))
    assert np.isfinite(coarse).all() and coarse.min() >= 0 and coarse.max() <= 5


def test_faces_are_wound_as_their_normals_point():
    mesh = ball()
    inside_out = replace(mesh, faces=mesh.faces[:, ::-1])
    rng = np.random.default_rng(RNG_SEED)
    some = rng.random(len(mesh.faces)) < 0.5
    mixed = replace(mesh, faces=np.where(some[:, None], mesh.faces, mesh.faces[:, ::-1]))
    for wrong in (inside_out, mixed, mesh):
        made = trimesh.Trimesh(wrong.positions, front_faces(wrong), process=False)
        assert made.volume == pytest.approx(4 / 3 * np.pi, rel=0.03)
    flat = replace(inside_out, normals=None)
    np.testing.assert_array_equal(front_faces(flat), flat.faces)  # nothing says otherwise


def test_a_flat_two_sided_mesh_stays_so(tmp_path):
    recovered_folder(tmp_path / "result", lettered(16, 16), two_sided=True, normals=None)
    path = tmp_path / "result" / "recovered.xml"
    asset = svu.load_asset(path.parent)
    flat = replace(asset, mesh=replace(asset.mesh, normals=None))
    for each, name in ((asset, "smooth"), (flat, "flat")):
        svu.export_asset(each, tmp_path / name)
        tree = gltf(tmp_path / name / "asset.glb")
        assert tree["materials"][0]["doubleSided"]
        assert ("NORMAL" in tree["meshes"][0]["primitives"][0]["attributes"]) == (name == "smooth")
        lines = (tmp_path / name / "mesh.obj").read_text().splitlines()
        assert any(line.startswith("vn ") for line in lines) == (name == "smooth")
        (shape,) = mi.load_file(str(tmp_path / name / "object.xml")).shapes()
        assert "TwoSided" in shape.bsdf().class_name()
        assert shape.has_vertex_normals() == (name == "smooth")


def test_a_world_with_z_up_is_turned_in_the_glb(asset, tmp_path):
    tall = replace(asset, mesh=replace(asset.mesh, positions=asset.mesh.positions * [1, 2, 3]))
    svu.export_asset(tall, tmp_path, svu.ExportOptions(formats=("glb", "xml"), up="z"))
    for name in ("asset.glb", "entropy.glb"):
        extents = trimesh.load_scene(tmp_path / name).to_mesh().extents
        np.testing.assert_allclose(extents, [2, 6, 4], rtol=0.01)
    turned = trimesh.load_scene(tmp_path / "asset.glb", process=False).to_mesh()
    np.testing.assert_allclose(turned.vertices[:, 1], tall.mesh.positions[:, 2], atol=1e-6)
    np.testing.assert_allclose(turned.vertices[:, 2], -tall.mesh.positions[:, 1], atol=1e-6)
    camera = mi.load_file(str(tmp_path / "preview.xml")).sensors()[0]
    assert np.array(camera.world_transform().matrix).reshape(4, 4)[2, 1] > 0.9  # its top is +Z


def test_a_normal_map_is_in_every_format(result, tmp_path, library):
    """As Mitsuba's; on mirrored UVs, tangents of other programs differ."""
    folder = shutil.copytree(result.folder, tmp_path / "result")
    bumps = np.random.default_rng(RNG_SEED).random((6, 5, 3)).astype(np.float32)
    write_exr(folder / "assets" / "normals.exr", {"RGB": bumps})
    path = folder / "recovered.xml"
    tree = ElementTree.parse(path)
    (shape,) = tree.findall("shape")
    inner = shape.find("bsdf")
    shape.remove(inner)
    layer = ElementTree.SubElement(shape, "bsdf", type="normalmap")
    ElementTree.SubElement(layer, "texture", name="normalmap", type="bitmap")
    layer.append(inner)
    tree.write(path)
    mapped = svu.load_asset(folder)
    svu.export_asset(mapped, tmp_path / "asset")
    bytes_of = np.round(255 * bumps)
    np.testing.assert_array_equal(pixels(tmp_path / "asset/textures/normal.png"), bytes_of)
    material = trimesh.load(tmp_path / "asset/asset.glb", force="mesh").visual.material
    np.testing.assert_array_equal(np.array(material.normalTexture.convert("RGB")), bytes_of)
    (loaded,) = mi.load_file(str(tmp_path / "asset/object.xml")).shapes()
    assert loaded.bsdf().class_name() == "NormalMap"
    np.testing.assert_allclose(np.array(mi.traverse(texture_of(loaded.bsdf()))["data"]), bumps)
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(tmp_path / "asset/material.mtlx"))
    document.importLibrary(library)
    assert document.validate()[0]
    flipped = replace(mapped.mesh, uvs=mapped.mesh.uvs * [-1, 1] + [1, 0])
    both = usable_normals(bumps, mapped.mesh), usable_normals(bumps, flipped)
    assert [each is None for each in both].count(True) == 1


def test_normal_map_that_is_lost_is_reported(result, tmp_path):
    folder = shutil.copytree(result.folder, tmp_path / "result")
    path = folder / "recovered.xml"
    tree = ElementTree.parse(path)
    (shape,) = tree.findall("shape")
    ElementTree.SubElement(shape.find("bsdf"), "texture", name="normalmap", type="bitmap")
    tree.write(path)
    with pytest.warns(svu.SvuWarning, match="recovered.xml: the object's bump map, or normal map"):
        svu.load_asset(folder)


def test_up_follows_the_cameras_of_the_recovery(result, tmp_path):
    assert svu.load_asset(result.folder).up == "y"
    folder = shutil.copytree(result.folder, tmp_path / "result")
    path = folder / "recovered.xml"
    tree = ElementTree.parse(path)
    to_z = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    for matrix in tree.findall("sensor/transform/matrix"):
        pose = to_z @ np.array(matrix.get("value").split(), float).reshape(4, 4)
        matrix.set("value", " ".join(map(str, pose.ravel())))
    tree.write(path)
    assert svu.load_asset(folder).up == "z"
    svu.export_asset(folder, tmp_path / "asset", svu.ExportOptions(formats=("glb",)))
    assert json.loads((tmp_path / "asset" / "asset.json").read_text())["mesh"]["up"] == "z"
    _, high = trimesh.load_scene(tmp_path / "asset" / "asset.glb").bounds
    mesh = svu.load_asset(folder).mesh.positions
    np.testing.assert_allclose(high[1], mesh[:, 2].max(), atol=1e-5)
    lean = np.eye(4)
    lean[:3, :3] = Rotation.from_euler("xz", [140, 30], degrees=True).as_matrix()
    for matrix in tree.findall("sensor/transform/matrix"):
        pose = lean @ np.array(matrix.get("value").split(), float).reshape(4, 4)
        matrix.set("value", " ".join(map(str, pose.ravel())))
    tree.write(path)
    upward = lean[:3, 2]
    np.testing.assert_allclose(svu.load_asset(folder).up, upward, atol=0.02)
    svu.export_asset(folder, tmp_path / "asset", svu.ExportOptions(formats=("glb", "xml")))
    _, high = trimesh.load_scene(tmp_path / "asset" / "asset.glb").bounds
    np.testing.assert_allclose(high[1], (mesh @ upward).max(), atol=0.03)
    for broken in ("1 2", "x " * 16):  # says nothing, and is no reason to refuse the textures
        for matrix in tree.findall("sensor/transform/matrix"):
            matrix.set("value", broken)
        tree.write(path)
        assert svu.load_asset(folder).up == "y"


@pytest.mark.parametrize("name", ["lamp", "camera", "room", "roughness"])
def test_object_may_have_a_name_that_the_preview_uses(asset, tmp_path, name):
    options = svu.ExportOptions(formats=("xml",))
    svu.export_asset(replace(asset, name=name), tmp_path, options)
    scene = mi.load_file(str(tmp_path / "preview.xml"), optimize=False)
    assert name in [shape.id() for shape in scene.shapes()]


def test_objects_of_several_exports_fit_into_one_scene(asset, tmp_path):
    included = ""
    for name, value in (("left", 0.25), ("right", 0.5)):
        textures = {n: np.full_like(np.array(t), value) for n, t in asset.textures.items()}
        other = replace(asset, name=name, textures=Textures.of(textures))
        svu.export_asset(other, tmp_path / name, svu.ExportOptions(formats=("xml",)))
        path = tmp_path / name / "object.xml"
        lines = path.read_text()  # as its comment says
        for file in ("textures/", "mesh.ply"):
            lines = lines.replace(f'value="{file}', f'value="{tmp_path / name}/{file}')
        path.write_text(lines)
        included += f'<include filename="{path}"/>'
    scene = mi.load_string(f'<scene version="3.0.0">{included}</scene>', optimize=False)
    colors = {s.id(): mi.traverse(s.bsdf())["base_color.data"] for s in scene.shapes()}
    assert {name: float(np.mean(data)) for name, data in colors.items()} == {
        "left": 0.25, "right": 0.5,
    }  # fmt: skip


# --- MaterialX ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def library():
    """The standard nodes of MaterialX."""
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    return library


def test_materialx_is_valid_and_becomes_a_shader(exported, library):
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(exported / "material.mtlx"))
    document.importLibrary(library)
    valid, message = document.validate()
    assert valid, message
    (material,) = document.getMaterialNodes()
    (surface,) = mx.getShaderNodes(material)
    assert surface.getNodeDef().getName() == "ND_standard_surface_surfaceshader"
    inputs = {"base_color": "srgb_texture", "specular_roughness": "", "metalness": ""}
    for name, space in inputs.items():
        file = surface.getConnectedNode(name).getInput("file")
        assert (exported / file.getValueString()).is_file()
        assert file.getColorSpace() == space
    assert document.getColorSpace() == "lin_rec709"
    generator = gen_glsl.EsslShaderGenerator.create()
    colors = gen_shader.DefaultColorManagementSystem.create(generator.getTarget())
    colors.loadLibrary(library)
    generator.setColorManagementSystem(colors)
    context = gen_shader.GenContext(generator)
    context.registerSourceCodeSearchPath(mx.getDefaultDataSearchPath())
    shader = generator.generate("shader", material, context)
    source = shader.getSourceCode(gen_shader.PIXEL_STAGE)
    assert source.count("srgb_texture_to_lin_rec709_color3(") == 2  # defined, and used once


def test_v_of_the_obj_runs_up(exported, asset):
    """(0, 0) is the lower left corner of an image for OBJ and MaterialX alike."""
    lines = [line.split() for line in (exported / "mesh.obj").read_text().splitlines()]
    uvs = np.array([line[1:] for line in lines if line[0] == "vt"], float)
    np.testing.assert_allclose(uvs, asset.mesh.uvs * [1, -1] + [0, 1], atol=1e-6)
    assert not [line for line in lines if line[0] in ("mtllib", "usemtl")]


# --- Reading ------------------------------------------------------------------------------


def test_an_asset_of_results_in_memory(result, asset):
    texels = svu.texels(result.capture.mesh, (WIDTH, HEIGHT))
    recovery = SimpleNamespace(texels=texels, textures=asset.textures,
                               coverage=mi.UInt32(np.arange(texels.count) % 4))  # fmt: skip
    made = svu.Asset.of(result.capture, recovery)
    np.testing.assert_array_equal(made.mesh.uvs, asset.mesh.uvs)
    assert made.name == asset.name and made.entropy is None and made.coverage.max() == 3
    few = svu.texels(result.capture.mesh, 16)
    estimate = SimpleNamespace(texels=few, entropy=mi.Float(np.full(few.count, 0.25)),
                               coverage=mi.UInt32(np.full(few.count, 7)))  # fmt: skip
    both = svu.Asset.of(result.capture, recovery, estimate)
    assert both.entropy.shape == both.coverage.shape == (16, 16)
    assert set(both.entropy.ravel()) == {0.25, 1} and both.coverage.max() == 7


def test_entropy_of_another_layout_is_refused(result, tmp_path):
    known = {name: read_exr(result.folder / f"{name}.exr")["Y"] for name in ("entropy", "coverage")}
    for name, image in known.items():
        write_exr(tmp_path / f"{name}.exr", {"Y": image[::-1, ::-1]})
    asset = svu.load_asset(result.folder, tmp_path)
    with pytest.raises(CaptureError, match="belong to other UVs"):
        svu.export_asset(asset, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_with_entropy_alone_lists_missing_files(tmp_path):
    write_known(tmp_path, 20, 30)
    with pytest.raises(CaptureError, match=r"no base_color\.exr, .* of svu entropy; run svu rec"):
        svu.load_asset(tmp_path)
    (tmp_path / "entropy.exr").unlink()
    with pytest.raises(CaptureError, match=r"no base_color\.exr, .* not a result of svu recover;"):
        svu.load_asset(tmp_path)
    with pytest.raises(CaptureError, match="no such folder"):
        svu.load_asset(tmp_path / "none")


@pytest.mark.parametrize(("file", "content", "error", "sentence"), [
    ("recovered.xml", "<scene>", CaptureError, r"recovered\.xml: cannot be read"),
    ("recovered.xml", "<scene/>", CaptureError, "no shape has the mesh"),
    ("assets/mesh.ply", f"{PLY}end_header\n", MeshError, r"mesh\.ply: has no vertex normals"),
    ("assets/mesh.ply", f"{PLY}{NORMAL}nonsense", MeshError, r"mesh\.ply: cannot be read"),
    ("coverage.exr", "no image", CaptureError, r"coverage\.exr: not an EXR"),
    ("entropy.exr", {"Y": np.full((48, 32), 1.5)}, CaptureError, r"in \[0, 1\], got 1.5; compute"),
    ("entropy.exr", {"R": np.ones((48, 32))}, CaptureError, "expected the channel Y, found R"),
    ("entropy.exr", {"Y": np.ones((8, 8))}, ShapeError, "differ in size"),
    ("metallic.exr", {"Y": np.ones((8, 8))}, CaptureError, "differ in size"),
])  # fmt: skip
def test_damaged_results_are_refused(result, tmp_path, file, content, error, sentence):
    folder = tmp_path / "result"
    shutil.copytree(result.folder, folder)
    if isinstance(content, str):
        (folder / file).write_text(content)
    else:
        write_exr(folder / file, content)
    with pytest.raises(error, match=sentence):
        svu.export_asset(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"uvs": None}, "no UVs"),
    ({"faces": np.zeros((0, 3), int)}, "no triangles"),
    ({"faces": np.array([[0, 1, 10**6]])}, "faces must be numbers for 1 triangles x 3 in"),
    ({"positions": np.full_like(ball().positions, np.nan)}, "positions must .*, got nan"),
    ({"uvs": np.full_like(UVS, np.inf)}, "uvs must be numbers .*, got inf"),
])  # fmt: skip
def test_meshes_that_cannot_be_exported(asset, changes, sentence):
    with pytest.raises(MeshError, match=sentence):
        replace(asset, mesh=replace(asset.mesh, **changes))


def test_charts_outside_the_unit_square_are_refused(asset, tmp_path):
    moved = replace(asset, mesh=replace(asset.mesh, uvs=asset.mesh.uvs + 3))
    with pytest.raises(MeshError, match="no texel of a 56 x 40 texture lies on a chart"):
        svu.export_asset(moved, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_maps_that_cannot_be_exported(asset):
    with pytest.raises(OptionError, match="of entropy are NaN or outside"):
        replace(asset, entropy=asset.entropy + 1)
    with pytest.raises(ShapeError, match=r"entropy must have shape \(H, W\)"):
        replace(asset, entropy=asset.entropy[..., None])


@pytest.mark.parametrize("wrong", [
    {"formats": ("obj",)}, {"formats": ()}, {"bits": 12}, {"gutter": -1}, {"gutter": 1.5},
    {"up": "x"}, {"half": 1},
])  # fmt: skip
def test_options_out_of_range(wrong):
    with pytest.raises(OptionError, match=rf"ExportOptions: {next(iter(wrong))}(\[0\])? must be"):
        svu.ExportOptions(**wrong)


# --- The program --------------------------------------------------------------------------


def run(*words):
    return main([str(word) for word in words])


def test_the_program_exports(result, tmp_path, variant, capsys):
    write_known(tmp_path / "known", 20, 30)
    words = ("export", result.folder, "-o", tmp_path / "out", "--entropy", tmp_path / "known")
    assert run(*words, "--formats", "png", "glb", "--bits", 16, "--gutter", 3, "--up", "z") == 0
    assert f"Wrote {tmp_path / 'out'}" in capsys.readouterr().out.replace("\n", "")
    record = json.loads((tmp_path / "out" / "asset.json").read_text())
    assert record["settings"] == {
        "formats": ["png", "glb"], "bits": 16, "half": False, "gutter": 3, "up": "z",
    }  # fmt: skip
    assert pixels(tmp_path / "out" / "textures" / "entropy.png").shape[:2] == (30, 20)
    assert not (tmp_path / "out" / "object.xml").exists()
    assert set(FORMATS) == {"exr", "png", "glb", "xml", "materialx"}
    assert run("export", tmp_path, "-o", tmp_path / "none") == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "none").exists()


def test_standard_deviations_are_maps_and_attributes(result, tmp_path):
    folder = shutil.copytree(result.folder, tmp_path / "result")
    height, width = read_exr(folder / "roughness.exr")["Y"].shape
    rough = np.linspace(0, 0.4, height * width, dtype=np.float32).reshape(height, width)
    colors = {f"base_color.sd.{c}": rough * k for c, k in zip("RGB", (0.2, 0.5, 0.1), strict=True)}
    channels = {"roughness.sd": rough, "roughness.low": rough, **colors}
    write_exr(folder / "uncertainty.exr", channels)
    asset = svu.load_asset(folder)
    assert set(asset.deviations) == {"base_color", "roughness"}
    np.testing.assert_allclose(asset.deviations["base_color"], 0.5 * rough)
    svu.export_asset(asset, tmp_path / "out")
    there = files(tmp_path / "out")
    assert {"textures/roughness_sd.exr", "textures/base_color_sd.png"} <= set(there)
    tree = gltf(tmp_path / "out" / "asset.glb")
    attributes = set(tree["meshes"][0]["primitives"][0]["attributes"])
    assert {"_ROUGHNESS_SD", "_BASE_COLOR_SD"} <= attributes
    extras = tree["materials"][0]["extras"]
    assert set(extras) == {"roughness_sd", "base_color_sd"}
    for name, texture in extras.items():
        image = tree["images"][tree["textures"][texture["index"]]["source"]]
        data = base64.b64decode(image["uri"].removeprefix("data:image/png;base64,"))
        inside = np.array(Image.open(io.BytesIO(data)))[6:26, 12:44]  # of the chart
        factor = 0.5 if name == "base_color_sd" else 1
        np.testing.assert_allclose(inside / 255, factor * rough[6:26, 12:44], atol=0.5 / 255)
    trimesh.load_scene(tmp_path / "out" / "asset.glb")
    record = json.loads((tmp_path / "out" / "asset.json").read_text())
    said = {one["holds"]: one["values"] for one in record["files"]}
    assert said["roughness_sd"].endswith("standard deviation")
    write_exr(folder / "uncertainty.exr", {"roughness.sd": rough + 1})
    with pytest.raises(
        CaptureError, match="uncertainty.exr: roughness must be numbers for 40 rows"
    ):
        svu.load_asset(folder)
