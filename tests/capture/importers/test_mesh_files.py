"""Import of meshes, photographs, masks, environment maps, poses and folders."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image
from support.colmap import write_colmap
from support.helpers import peak_memory
from trimesh.visual.material import PBRMaterial, SimpleMaterial

import svu_mi as svu
from svu_mi.capture.image_io import open_image, read_planes
from svu_mi.capture.importers.axis_fixes import FIXES, scene_edit
from svu_mi.capture.importers.convert_photographs import convert_photograph
from svu_mi.capture.importers.envmap import write_environment
from svu_mi.capture.importers.import_capture import ImportOptions, import_capture
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.registry import FORMATS, ReadOptions, read_source
from svu_mi.capture.importers.repair_normals import repair_normals
from svu_mi.capture.importers.resampling import average_area, square_pixel_frame, with_size
from svu_mi.capture.importers.source import ENVIRONMENT_AXES, OPENGL, Frame, Light, Source
from svu_mi.capture.mesh import MeshArrays, arrays
from svu_mi.capture.photographs import CLIPPED, SATURATION, UNUSABLE
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import describe, film_size, focal_length
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import CaptureError, MeshError, OptionError, OutputError, SceneError
from svu_mi.guidance.candidates import Candidates

SEED = 826417309
PICTURE = np.zeros((8, 8, 3), np.uint8)
PICTURE[:4] = 255  # white above, black below


def quad(material: object | None = None, picture: np.ndarray = PICTURE) -> trimesh.Trimesh:
    """A square with a white upper half (y > 0), to test the direction of V."""
    points = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    material = material or PBRMaterial(baseColorTexture=Image.fromarray(picture))
    visual = trimesh.visual.TextureVisuals(points[:, :2] / 2 + 0.5, material)
    return trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def upper_color(path) -> float:
    """Return the colour of the half with y > 0, with row 0 at v = 0 as in Mitsuba."""
    geometry = read_textured_mesh(path)
    top = geometry.mesh.positions[:, 1] > 0
    v = 0.75 * geometry.mesh.uvs[top, 1].mean() + 0.25 * geometry.mesh.uvs[~top, 1].mean()
    picture = geometry.textures["base_color"]
    return float(picture[int(v * len(picture)), 0, 0])


@pytest.mark.parametrize("kind", ["glb", "gltf", "obj"])
def test_textures_are_the_right_way_up(tmp_path, kind):
    simple = SimpleMaterial(image=Image.fromarray(PICTURE))
    quad(simple if kind == "obj" else None).export(tmp_path / f"quad.{kind}")
    assert upper_color(tmp_path / f"quad.{kind}") == 255


def test_ply_keeps_mitsubas_uvs_and_stl_has_none(tmp_path):
    mesh = quad()
    mesh.visual = trimesh.visual.TextureVisuals(mesh.visual.uv)
    mesh.export(tmp_path / "quad.ply", vertex_normal=True)
    geometry = read_textured_mesh(tmp_path / "quad.ply")
    np.testing.assert_allclose(geometry.mesh.uvs, mesh.visual.uv, atol=1e-6)
    assert not geometry.textures and not geometry.notes
    mesh.export(tmp_path / "quad.stl")
    geometry = read_textured_mesh(tmp_path / "quad.stl")
    assert geometry.mesh.uvs is None and len(geometry.mesh.faces) == 2
    np.testing.assert_allclose(geometry.mesh.normals, [[0, 0, 1]] * len(geometry.mesh.normals))


def test_parts_are_placed_and_mirrored_ones_face_outwards(tmp_path):
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(subdivisions=1)
    scene.add_geometry(ball, transform=np.diag([2.0, 2, 2, 1]))
    mirrored = np.diag([-1.0, 1, 1, 1])
    mirrored[0, 3] = 5
    scene.add_geometry(ball, transform=mirrored)
    scene.export(tmp_path / "two.glb")
    mesh = read_textured_mesh(tmp_path / "two.glb").mesh
    np.testing.assert_allclose(mesh.positions.min(axis=0), [-2, -2, -2], atol=1e-5)
    np.testing.assert_allclose(mesh.positions.max(axis=0), [6, 2, 2], atol=1e-5)
    whole = trimesh.Trimesh(mesh.positions, mesh.faces)
    assert whole.volume == pytest.approx(9 * ball.volume, rel=1e-4)
    center = np.where(mesh.positions[:, :1] > 3, [[5.0, 0, 0]], [[0.0, 0, 0]])
    assert (np.einsum("ij,ij->i", mesh.normals, mesh.positions - center) > 0).all()


def test_same_uvs_for_all_vertices_are_none(tmp_path):
    ball = trimesh.creation.icosphere(1)
    ball.visual = trimesh.visual.TextureVisuals(uv=np.full((len(ball.vertices), 2), 0.5))
    ball.export(tmp_path / "mesh.obj")
    assert "vt 0.5" in (tmp_path / "mesh.obj").read_text()
    assert read_textured_mesh(tmp_path / "mesh.obj").mesh.uvs is None


def test_several_materials_are_refused_unless_geometry_will_do(tmp_path):
    trimesh.Scene([quad(picture=PICTURE + k) for k in (0, 1)]).export(tmp_path / "two.glb")
    with pytest.raises(MeshError, match="two.glb: has 2 materials.*--geometry-only"):
        read_textured_mesh(tmp_path / "two.glb")
    geometry = read_textured_mesh(tmp_path / "two.glb", geometry_only=True)
    assert geometry.mesh.uvs is None and "2 parts (geometry_1, geometry_0)" in geometry.notes[0]
    assert "textures are ignored" in geometry.notes[1]
    plain = [quad(PBRMaterial(baseColorFactor=color)) for color in ([9, 0, 0, 255], [0, 0, 9, 255])]
    trimesh.Scene(plain).export(tmp_path / "plain.glb")  # materials without pictures are irrelevant
    geometry = read_textured_mesh(tmp_path / "plain.glb")
    assert geometry.mesh.uvs is not None and not geometry.textures


def test_normals_with_swapped_axes_are_computed_anew(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3)
    good = MeshArrays(np.array(ball.vertices), np.array(ball.faces), np.array(ball.vertices), None)
    kept, notes = repair_normals(good, "ball")
    assert not notes
    np.testing.assert_allclose(kept.normals, good.normals, atol=1e-12)
    swapped, notes = repair_normals(replace(good, normals=good.normals[:, [0, 2, 1]]), "ball")
    assert "contradict" in notes[0]
    assert np.einsum("ij,ij->i", swapped.normals, good.normals).min() > 0.99
    turned, notes = repair_normals(replace(good, faces=good.faces[:, ::-1]), "ball")
    assert "inside out" in notes[0] and np.array_equal(turned.faces, good.faces)


def test_missing_normals_are_smooth_across_uv_seams(tmp_path):
    ball = trimesh.creation.uv_sphere(count=(24, 24))
    doubled = np.array(ball.triangles).reshape(-1, 3)  # no shared vertices
    faces = np.arange(len(doubled)).reshape(-1, 3)
    mesh, _ = repair_normals(MeshArrays(doubled, faces, None, None), "ball")
    assert np.einsum("ij,ij->i", mesh.normals, doubled).min() > 0.99


def accessor_of(record: dict, name: str) -> dict:
    return record["accessors"][record["meshes"][0]["primitives"][0]["attributes"][name]]


def quantised(record: dict) -> None:
    accessor_of(record, "TEXCOORD_0").update(componentType=5123, normalized=True)


def sparse(record: dict) -> None:
    accessor_of(record, "POSITION")["sparse"] = {"count": 1}


def compressed(record: dict) -> None:
    record["extensionsRequired"] = ["KHR_draco_mesh_compression"]


def moved(record: dict) -> None:
    texture = record["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    texture["extensions"] = {"KHR_texture_transform": {"scale": [0.5, 0.5]}}


GLTF = {
    quantised: "its TEXCOORD_0 is quantised", sparse: "its POSITION is quantised or sparse",
    compressed: "requires KHR_draco_mesh.*gltf-transform copy",
    moved: "moved or scaled by KHR_texture",
}  # fmt: skip


@pytest.mark.parametrize("change", GLTF)
def test_gltf_that_would_be_read_as_something_else(tmp_path, change):
    quad().export(tmp_path / "mesh.gltf")
    read_textured_mesh(tmp_path / "mesh.gltf")
    record = json.loads((tmp_path / "mesh.gltf").read_text())
    change(record)
    (tmp_path / "mesh.gltf").write_text(json.dumps(record))
    with pytest.raises(MeshError, match=GLTF[change]):
        read_textured_mesh(tmp_path / "mesh.gltf")
    if change in (quantised, moved):
        read_textured_mesh(tmp_path / "mesh.gltf", geometry_only=True)


def test_gltf_with_its_numbers_in_a_folder(tmp_path):
    trimesh.creation.icosphere(2).export(tmp_path / "mesh.gltf")
    record = json.loads((tmp_path / "mesh.gltf").read_text())
    (tmp_path / "data").mkdir()
    for buffer in record["buffers"]:
        (tmp_path / buffer["uri"]).rename(tmp_path / "data" / f"my {buffer['uri']}")
        buffer["uri"] = f"data/my%20{buffer['uri']}"
    (tmp_path / "mesh.gltf").write_text(json.dumps(record))
    assert len(read_textured_mesh(tmp_path / "mesh.gltf").mesh.faces) == 320


def test_vertices_of_no_triangle_are_left_out(tmp_path):
    points = np.vstack([[1e6, 0, 0], quad().vertices])
    trimesh.Trimesh(points, quad().faces + 1, process=False).export(tmp_path / "mesh.ply")
    mesh = read_textured_mesh(tmp_path / "mesh.ply").mesh
    assert np.array_equal(mesh.positions, points[1:])
    assert np.array_equal(mesh.faces, quad().faces)


def test_ply_with_a_texture_has_v_upwards(tmp_path):
    mesh = quad()
    uvs = np.array(mesh.visual.uv)
    mesh.visual = trimesh.visual.TextureVisuals(uvs)
    mesh.export(tmp_path / "mesh.ply", vertex_normal=True, encoding="ascii")
    text = (tmp_path / "mesh.ply").read_text()
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "paint.png")
    text = text.replace("element vertex", "comment TextureFile paint.png\nelement vertex")
    (tmp_path / "mesh.ply").write_text(text)
    geometry = read_textured_mesh(tmp_path / "mesh.ply")
    assert set(geometry.textures) == {"base_color"}
    np.testing.assert_allclose(geometry.mesh.uvs, [0, 1] + uvs * [1, -1])


# --- photographs --------------------------------------------------------------------------


GREY = np.full((20, 40, 3), 90, np.uint8)
LEFT = np.zeros(GREY.shape[:2], bool)  # the object of masks
LEFT[:, :17] = True


def photograph(path: Path, pixels: np.ndarray = GREY, **fields: object) -> Frame:
    """Write a picture, and return its frame."""
    Image.fromarray(pixels).save(path)
    size = pixels.shape[1::-1]
    return Frame(**{
        "label": "frame 0", "image": path, "to_world": np.eye(4), "focal": (50.0, 50.0),
        "center": (size[0] / 2, size[1] / 2), "size": size, **fields,
    })  # fmt: skip


def test_eight_bits_are_decoded_and_clipped_channels_marked(tmp_path):
    pixels = np.full((4, 6, 3), 128, np.uint8)
    pixels[1, 2] = (255, 10, 10)
    photo = tmp_path / "photo.png"
    copy = convert_photograph(photograph(photo, pixels), tmp_path / "view.exr", (1, 1))
    image = read_exr(tmp_path / "view.exr")
    assert copy.bits == 8 and copy.saturated == 1 and not copy.masked and "A" not in image
    assert image["R"][0, 0] == pytest.approx(0.2158605, rel=1e-3)  # half floats
    assert image["R"][1, 2] == CLIPPED
    assert image["G"][1, 2] == pytest.approx((10 / 255) / 12.92, rel=1e-3)
    header = open_image(tmp_path / "view.exr").header.attributes
    assert header[SATURATION] == pytest.approx(((0.98 + 0.055) / 1.055) ** 2.4, rel=1e-5)
    convert_photograph(
        photograph(photo, pixels, transfer="gamma 2.2"), tmp_path / "view.exr", (1, 1)
    )
    assert read_exr(tmp_path / "view.exr")["R"][0, 0] == pytest.approx((128 / 255) ** 2.2, rel=1e-3)
    header = open_image(tmp_path / "view.exr").header.attributes
    assert header[SATURATION] == pytest.approx(0.98**2.2, rel=1e-5)


def test_average_of_saturated_and_other_pixels_is_unusable(tmp_path):
    pixels = np.full((4, 8, 3), 128, np.uint8)
    pixels[:, 3:] = 255  # after averaging, column 1 is mixed, 2 and 3 are white
    convert_photograph(photograph(tmp_path / "photo.png", pixels), tmp_path / "view.exr", (0.5, 1))
    red = read_exr(tmp_path / "view.exr")["R"]
    np.testing.assert_array_equal(red[:, 1], UNUSABLE)
    np.testing.assert_array_equal(red[:, 2:], CLIPPED)
    assert (red[:, 0] > 0).all()


def test_masks_from_files_and_alpha_both_count(tmp_path):
    pixels = np.full((4, 4, 4), 100, np.uint8)
    pixels[..., 3] = 255
    pixels[0, 0, 3] = 0
    mask = np.full((4, 4), 255, np.uint8)
    mask[3, 3] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    given = photograph(tmp_path / "photo.png", pixels, mask=tmp_path / "mask.png")
    assert convert_photograph(given, tmp_path / "view.exr", (1, 1)).masked
    alpha = read_exr(tmp_path / "view.exr")["A"]
    assert alpha[0, 0] == alpha[3, 3] == 0 and alpha.sum() == 14
    Image.fromarray(mask[:2]).save(tmp_path / "mask.png")
    with pytest.raises(CaptureError, match="mask.png: the mask has 4 x 2"):
        convert_photograph(given, tmp_path / "view.exr", (1, 1))


@pytest.mark.parametrize("scale", [(1.0, 0.5), (0.371, 0.62), (1 / 3, 1.0)])
def test_pixels_are_averaged_over_their_area(scale):
    image = np.random.default_rng(SEED).random((12, 15, 2)).astype(np.float32)
    averaged = average_area(image, scale)
    wanted = overlap(12, scale[1]) @ np.moveaxis(overlap(15, scale[0]) @ image, 2, 0)
    np.testing.assert_allclose(averaged, np.moveaxis(wanted, 0, 2), atol=1e-6)


def overlap(count: int, scale: float) -> np.ndarray:
    """Return the share of each new pixel that each old pixel covers, entry by entry."""
    edges = np.arange(int(count * scale + 1e-6) + 1) / scale
    matrix = np.zeros((len(edges) - 1, count))
    for new, old in np.ndindex(matrix.shape):
        shared = min(edges[new + 1], old + 1) - max(edges[new], old)
        matrix[new, old] = max(shared, 0) * scale
    return matrix


def test_cameras_follow_their_photographs(tmp_path):
    black = np.zeros((40, 60, 3), np.uint8)
    given = photograph(tmp_path / "a.png", black, focal=(80.0, 50.0), center=(31.0, 17.0))
    rays = pixel_rays(given)
    for shrink in (1.0, 1.7):
        square, scale = square_pixel_frame(given, shrink)
        assert square.has_square_pixels and square.size == (int(60 * scale[0]), int(40 * scale[1]))
        np.testing.assert_allclose(pixel_rays(square), rays, atol=1e-12)
    half = with_size(given, (30, 20))
    np.testing.assert_allclose(pixel_rays(half), rays, atol=1e-12)
    assert with_size(given, (30, 22)).size == (30, 22)  # two pixels for rounding
    for size in ((30, 23), (30, 30)):
        with pytest.raises(CaptureError, match="another aspect ratio"):
            with_size(given, size)
    with pytest.raises(CaptureError, match="stored on its side"):
        with_size(given, (20, 31))
    with pytest.raises(OptionError, match="shrinking by|--shrink"):
        square_pixel_frame(given, 0.5)


@pytest.mark.parametrize(("off", "is_square"), [(0.04, True), (0.06, False)])
def test_pixels_are_square_if_the_border_moves_by_a_twentieth_of_one(off, is_square):
    frame = Frame(label="", image=Path("a"), to_world=np.eye(4), center=(30.0, 20.0),
                  focal=(50 * (1 + off / 30), 50.0), size=(60, 40))  # fmt: skip
    assert (square_pixel_frame(frame)[1] == (1, 1)) == is_square


def test_a_jpeg_of_4_megapixels_is_copied(tmp_path):
    frame = photograph(tmp_path / "photo.jpg", np.full((2048, 2048, 3), 90, np.uint8))
    convert_photograph(frame, tmp_path / "view.exr", (1.0, 1.0))
    assert (tmp_path / "view.jpg").read_bytes() == (tmp_path / "photo.jpg").read_bytes()


def pixel_rays(frame: Frame) -> np.ndarray:
    """Slopes at the corner of the first pixel, (0, 0)."""
    return -np.array(frame.center) / frame.focal


def palette(path: Path) -> None:
    picture = Image.fromarray(LEFT.astype(np.uint8), "P")
    picture.putpalette([0, 0, 0, 0, 128, 0])  # label 1 is green
    picture.save(path)


def cut_out(path: Path) -> None:
    color = np.full((*LEFT.shape, 4), 10, np.uint8)  # the object is dark
    color[..., 3] = np.where(LEFT, 255, 0)
    Image.fromarray(color).save(path)


MASKS = {
    "bits": lambda path: Image.fromarray(LEFT).save(path),
    "labels": lambda path: Image.fromarray(LEFT.astype(np.uint8)).save(path),
    "palette": palette,
    "cut-out": cut_out,
}


@pytest.mark.parametrize("kind", MASKS)
def test_masks_of_all_kinds(tmp_path, kind):
    MASKS[kind](tmp_path / "mask.png")
    frame = photograph(tmp_path / "photo.png", mask=tmp_path / "mask.png")
    assert not convert_photograph(frame, tmp_path / "view.exr", (1, 1)).empty
    assert np.array_equal(read_exr(tmp_path / "view.exr")["A"] == 1, LEFT)


def test_blenders_layers(tmp_path):
    planes = {c: np.full((4, 6), k / 4, np.float32) for k, c in enumerate("RGBA", 1)}
    passes = {f"ViewLayer.Combined.{c}": plane for c, plane in planes.items()}
    others = {f"ViewLayer.DiffCol.{c}": np.ones((4, 6), np.float32) for c in "RGB"}
    write_exr(tmp_path / "1.exr", {**passes, **others, "ViewLayer.Depth.Z": planes["R"]})
    channels, low_range = read_planes(tmp_path / "1.exr")
    np.testing.assert_array_equal(channels, list(planes.values()))
    assert not low_range
    write_exr(tmp_path / "1.exr", {**others, "ViewLayer.Emit.R": planes["R"]})
    with pytest.raises(CaptureError, match="found ViewLayer.*export it as plain RGB"):
        read_planes(tmp_path / "1.exr")


def test_clipped_pixels_of_the_background_are_not_counted(tmp_path):
    cut_out(tmp_path / "mask.png")
    white = np.full_like(GREY, 255)
    white[:, 1:17] = 90
    frame = photograph(tmp_path / "photo.png", white, mask=tmp_path / "mask.png")
    assert convert_photograph(frame, tmp_path / "view.exr", (1, 1)).saturated == len(GREY)


@pytest.mark.parametrize("shrink", [1.0, 1.9])
def test_memory_of_a_photograph_is_bounded(tmp_path, shrink):
    side = 768
    frame = photograph(tmp_path / "photo.png", np.full((side, side, 3), 90, np.uint8))
    scale = square_pixel_frame(frame, shrink)[1]
    peak = peak_memory(lambda: convert_photograph(frame, tmp_path / "view.exr", scale))
    assert peak < 48 * side * side


# --- environment maps ---------------------------------------------------------------------


def spot(width: int, column: int, row: int) -> np.ndarray:
    pixels = np.full((width // 2, width, 3), 0.1, np.float32)
    pixels[row, column] = 5
    return pixels


@pytest.mark.parametrize("axes", ENVIRONMENT_AXES)
def test_a_spot_stands_where_its_convention_says(tmp_path, axes):
    """Each convention has its own up axis at the top and direction in the centre."""
    top, center = {
        "mitsuba": ("+y", "+z"), "opengl": ("+y", "-z"), "threejs": ("+y", "+x"),
        "blender": ("+z", "+x"),
    }[axes]  # fmt: skip
    for row, column, wanted in ((0, 0, top), (16, 32, center)):
        write_exr(tmp_path / "map.exr", {"RGB": spot(64, column, row)})
        light = Light(path=tmp_path / "map.exr", to_world=ENVIRONMENT_AXES[axes])
        matrix, _ = write_environment(light, tmp_path / "environment.exr")
        local = np.array([0.0, 1, 0]) if row == 0 else np.array([0.0, 0, 1])  # of Mitsuba's envmap
        axis = (1 if wanted[0] == "+" else -1) * np.eye(3)["xyz".index(wanted[1])]
        np.testing.assert_allclose(matrix[:3, :3] @ local, axis, atol=1e-12)


def test_a_mirrored_map_is_turned_over(tmp_path):
    write_exr(tmp_path / "map.exr", {"RGB": spot(64, 5, 9)})
    light = Light(path=tmp_path / "map.exr", to_world=np.diag([-1.0, 1, 1]))
    matrix, _ = write_environment(light, tmp_path / "environment.exr")
    assert np.linalg.det(matrix) > 0
    assert read_exr(tmp_path / "environment.exr")["R"][2 * 9 + 1, 64 - 1 - 5] == 5


def test_every_row_of_a_map_is_where_its_pixels_are(tmp_path):
    """Mitsuba's rows 0 and H - 1 are the poles; rows of files are centred half a row away."""
    for height, rows in ((16, 33), (520, 521)):
        bright = height // 4
        pixels = np.zeros((height, 2 * height, 3), np.float32)
        pixels[bright] = 1
        write_exr(tmp_path / "map.exr", {"RGB": pixels})
        light = Light(path=str(tmp_path / "map.exr"))
        write_environment(light, tmp_path / "environment.exr")
        made = read_exr(tmp_path / "environment.exr")["R"]
        assert made.shape == (rows, 2 * height)
        emitter = mi.load_dict({"type": "envmap", "filename": str(tmp_path / "environment.exr")})
        theta = np.linspace(0, np.pi, 5001)
        towards = np.stack([0 * theta, np.cos(theta), np.sin(theta)])
        si = dr.zeros(mi.SurfaceInteraction3f, theta.size)
        si.wi = -mi.Vector3f(towards.astype(np.float32))
        seen = np.array(emitter.eval(si))[0]
        center = (theta * seen).sum() / seen.sum()
        assert center == pytest.approx((bright + 0.5) * np.pi / height, abs=0.02 * np.pi / height)
        flux = (seen * np.sin(theta)).sum() * theta[1]
        edges = np.array([bright, bright + 1]) * np.pi / height
        assert flux == pytest.approx(-np.diff(np.cos(edges))[0], rel=2e-3)


def test_an_even_map_stays_even(tmp_path):
    write_exr(tmp_path / "map.exr", {"RGB": np.full((8, 16, 3), 0.7, np.float32)})
    light = Light(path=tmp_path / "map.exr", scale=2.0)
    write_environment(light, tmp_path / "environment.exr")
    made = read_exr(tmp_path / "environment.exr")["R"]
    np.testing.assert_allclose(made, 1.4, rtol=1e-6)
    assert made.shape == (17, 16)


def light_of(path: Path, pose: np.ndarray) -> np.ndarray:
    """Radiance of Mitsuba's envmap from 2000 directions of the world."""
    emitter = mi.load_dict({
        "type": "envmap", "filename": str(path), "to_world": mi.ScalarTransform4f(pose),
    })  # fmt: skip
    towards = np.random.default_rng(0).normal(size=(3, 2000))
    si = dr.zeros(mi.SurfaceInteraction3f, 2000)
    si.wi = -mi.Vector3f((towards / np.linalg.norm(towards, axis=0)).astype(np.float32))
    return np.array(emitter.eval(si))


@pytest.mark.parametrize("height", [3, 16, 520])
@pytest.mark.parametrize("turn", [np.eye(3), np.diag([-1.0, 1, 1])])
def test_an_imported_map_can_be_imported_again(tmp_path, height, turn):
    """The header marks rows of Mitsuba, which are not resampled again."""
    pixels = np.random.default_rng(height).random((height, 2 * height, 3), np.float32)
    write_exr(tmp_path / "map.exr", {"RGB": pixels})
    first, again = tmp_path / "environment.exr", tmp_path / "again.exr"
    pose, _ = write_environment(Light(path=tmp_path / "map.exr", to_world=turn), first)
    turned, _ = write_environment(Light(path=first, to_world=pose[:3, :3]), again)
    np.testing.assert_array_equal(light_of(again, turned), light_of(first, pose))
    write_environment(Light(path=first, to_world=np.diag([-1.0, 1, 1])), again)
    np.testing.assert_array_equal(read_exr(again)["G"], read_exr(first)["G"][:, ::-1])


def test_maps_that_are_none(tmp_path):
    for pixels, said, sentence in (
        (np.ones((8, 8, 3)), {}, "twice as wide"), (np.zeros((8, 16, 3)), {}, "entirely black"),
        # One row cannot be both poles; other values of the mark are ignored.
        (np.ones((1, 8, 3)), {"svu:rows": "poles"}, "twice as wide"),
        (np.ones((33, 32, 3)), {"svu:rows": "elsewhere"}, "twice as wide"),
    ):  # fmt: skip
        write_exr(tmp_path / "map.exr", {"RGB": pixels}, said)
        with pytest.raises(CaptureError, match=sentence):
            write_environment(Light(path=tmp_path / "map.exr"), tmp_path / "e.exr")
    Image.fromarray(np.zeros((8, 16, 3), np.uint8)).save(tmp_path / "map.png")
    with pytest.raises(CaptureError, match="8-bit images"):
        write_environment(Light(path=tmp_path / "map.png"), tmp_path / "e.exr")
    assert not (tmp_path / "e.exr").exists()


# --- the importer -------------------------------------------------------------------------


@pytest.fixture
def source(tmp_path) -> Source:
    """A source with two photographs of a quad, its mesh and light."""
    folder = tmp_path / "given"
    folder.mkdir()
    quad().export(folder / "quad.obj")
    write_exr(folder / "map.exr", {"RGB": spot(32, 3, 4)})
    frames = []
    for k in range(2):
        write_exr(folder / f"{k}.exr", {"RGB": np.full((6, 8, 3), 0.5 + k)})
        pose = np.diag([-1.0, 1, -1, 1])  # in front of the quad, a little below
        pose[:3, 3] = (0.3 * k, -0.2, 4)
        frames.append(Frame(
            label=f"frame {k}", image=folder / f"{k}.exr", to_world=pose, focal=(9.0, 9.0),
            center=(4.2, 2.9), size=(8, 6), exposure=2.0,
        ))  # fmt: skip
    return Source(
        format="test", root=folder, frames=frames, mesh=folder / "quad.obj",
        light=Light(path=folder / "map.exr"), camera_axes=OPENGL,
    )  # fmt: skip


def loaded(source: Source, folder, **options: object) -> svu.Capture:
    import_capture(source, folder, ImportOptions(**options))
    return svu.load_capture(folder)


def test_an_imported_capture_says_where_it_is_from(source, tmp_path):
    capture = loaded(source, tmp_path / "capture", every=2)
    assert capture.count == 1 and capture.exposures == (2.0,)
    np.testing.assert_allclose(capture.images[0], 0.25)
    record = json.loads((tmp_path / "capture" / "capture.json").read_text())["import"]
    assert record["format"] == "test" and record["photographs"] == ["0.exr"]
    assert "no mask" in record["notes"][0]
    assert {path.name for path in tmp_path.iterdir()} == {"given", "capture"}  # nothing is left


@pytest.mark.parametrize("fix", [name for name, fix in FIXES.items() if fix.kind == "camera"])
def test_fixed_cameras(source, tmp_path, fix):
    capture = loaded(source, tmp_path / "capture", fixes=(fix,))
    for sensor, frame in zip(capture.sensors, source.frames, strict=True):
        if fix == "camera-inverse":
            # The result of reading the matrix as its inverse.
            wanted = np.linalg.inv(frame.to_world @ OPENGL) @ OPENGL
        else:
            axis = "xyz".index(fix.removeprefix("camera-")[0])
            wanted = frame.to_world @ np.diag([1.0 if k in (axis, 3) else -1.0 for k in range(4)])
        np.testing.assert_allclose(to_world(sensor), wanted, atol=1e-6)


@pytest.mark.parametrize("fix", [fix for fix in FIXES.values() if fix.matrix is not None])
def test_the_edit_of_a_scene_is_the_correction(fix):
    edit, _, place = scene_edit(fix).partition("> ")
    elements = ['<rotate y="1" angle="25"/><translate x="2"/>', f"{edit}>"]
    given, turned = (
        np.array(mi.traverse(mi.load_string(
            '<shape version="3.0.0" type="rectangle"><transform name="to_world">'
            f"{''.join(some)}</transform></shape>"
        ))["to_world"].matrix).reshape(4, 4)
        for some in (elements[:1], elements if "as the last" in place else elements[::-1])
    )  # fmt: skip
    matrix = np.pad(fix.matrix, (0, 1))
    matrix[3, 3] = 1
    wanted = matrix @ given if fix.kind == "mesh" else given @ matrix
    np.testing.assert_allclose(turned, wanted, atol=1e-5)


def test_fixed_mesh_and_texture(source, tmp_path):
    plain = arrays(loaded(source, tmp_path / "plain").mesh)
    turned = arrays(loaded(source, tmp_path / "turned", mesh_up="y", world_up="z").mesh)
    x, y, z = plain.positions.T
    np.testing.assert_allclose(turned.positions, np.stack([x, -z, y], axis=-1), atol=1e-6)
    np.testing.assert_allclose(turned.normals, [[0, -1, 0]] * 4, atol=1e-6)
    mirrored = arrays(loaded(source, tmp_path / "m", fixes=("mesh-mirror",), mesh_scale=3.0).mesh)
    np.testing.assert_allclose(mirrored.positions, plain.positions * [-3, 3, 3], atol=1e-6)
    np.testing.assert_allclose(mirrored.normals, plain.normals, atol=1e-6)
    assert np.array_equal(mirrored.faces, plain.faces[:, ::-1])
    flipped = arrays(loaded(source, tmp_path / "v", fixes=("texture-flip-v",)).mesh)
    np.testing.assert_allclose(flipped.uvs, [0, 1] + plain.uvs * [1, -1], atol=1e-6)


def test_a_mesh_without_uvs_gets_some_and_keeps_them(source, tmp_path):
    capture = loaded(source, tmp_path / "capture", geometry_only=True)
    assert capture.mesh.has_vertex_texcoords() and not capture.warnings
    assert not (tmp_path / "capture" / "base_color.png").exists()


def test_a_photograph_of_another_size_is_noted(source, tmp_path):
    write_exr(source.frames[1].image, {"RGB": np.full((3, 4, 3), 0.5)})
    notes = import_capture(source, tmp_path / "capture")
    (note,) = [one for one in notes if "resized" in one]
    width, height = source.frames[1].size
    shape = f"({width // 2} x {height // 2} pixels instead of {width} x {height})"
    assert f"1 of {len(source.frames)} photographs is resized, first 1.exr {shape}" in note


def test_photographs_are_shrunk_with_their_cameras(source, tmp_path):
    capture = loaded(source, tmp_path / "capture", shrink=2.0)
    record = describe(capture.sensors[0])
    assert record["film"] == [4, 3] and capture.images[0].shape == (3, 4, 3)
    assert record["principal_point_offset"][0] == pytest.approx(0.5 - 2.1 / 4, abs=1e-6)


def test_what_is_missing_is_asked_for(source, tmp_path):
    with pytest.raises(OptionError, match="contains no mesh of the object; give it with --mesh"):
        import_capture(replace(source, mesh=None), tmp_path / "capture")
    for options, sentence in (
        ({"every": 0}, "--every"), ({"mesh_scale": -1.0}, "positive"), ({"shrink": 0.5}, "shrink"),
        ({"fixes": ("up",)}, "Unknown fix 'up'"), ({"world_up": "z"}, "give both"),
    ):  # fmt: skip
        with pytest.raises(OptionError, match=sentence):
            import_capture(source, tmp_path / "capture", ImportOptions(**options))
    (source.root / "1.exr").unlink()
    with pytest.raises(CaptureError, match="1 of 2 photographs is missing, first 1.exr; add"):
        import_capture(source, tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


def test_a_capture_without_a_light_says_so_and_can_be_checked(source, tmp_path):
    """Poses can be checked without an environment map."""
    few = import_capture(replace(source, light=None), tmp_path / "few")
    needed = "An unknown light needs at least 4 photographs of the same places, and the capture "
    assert few[-1] == f"{needed}has 2: add photographs, or give the light."
    frames = [*source.frames, *source.frames]
    notes = import_capture(replace(source, frames=frames, light=None), tmp_path / "capture")
    sentence = (
        "The capture has no light. Commands estimate it from the photographs; svu light shows the "
        "estimate. If you have an environment map, import again with --environment."
    )
    assert sentence in notes
    record = json.loads((tmp_path / "capture" / "capture.json").read_text())
    assert sentence in record["import"]["notes"]
    assert not (tmp_path / "capture" / "environment.exr").exists()
    with pytest.raises(SceneError, match="capture: was imported without a light.*--environment"):
        svu.load_capture(tmp_path / "capture")
    assert svu.load_capture(tmp_path / "capture", light="optional").count == 4


def test_only_an_earlier_import_is_replaced(source, tmp_path):
    import_capture(source, tmp_path / "capture")
    import_capture(source, tmp_path / "capture", ImportOptions(every=2))
    assert not (tmp_path / "capture" / "view_0001.exr").exists()
    (tmp_path / "mine").mkdir()
    for folder in (tmp_path / "capture", tmp_path / "mine"):  # imported there, or not
        (folder / "recovered").mkdir()
        (folder / "recovered" / "notes.txt").touch()
        with pytest.raises(OutputError, match="contains other files"):
            import_capture(source, folder)
        assert (folder / "recovered" / "notes.txt").exists()
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="is a file"):
        import_capture(source, tmp_path / "file")


def test_pixels_marked_by_the_import_are_ignored_silently(source, tmp_path):
    pixels = np.full((6, 8, 3), 90, np.uint8)
    pixels[2, 3:5] = 255
    Image.fromarray(pixels).save(source.root / "0.png")
    frames = [replace(source.frames[0], image=source.root / "0.png"), source.frames[1]]
    capture = loaded(replace(source, frames=frames), tmp_path / "capture")
    assert capture.unusable == (2, 0) and capture.warnings == ()
    assert np.isnan(capture.images[0][2, 3:5]).all()
    spoiled = np.full((6, 8, 3), 0.5)
    spoiled[0, :3] = -0.5
    write_exr(tmp_path / "capture" / "view_0001.exr", {"RGB": spoiled})
    with pytest.warns(svu.SvuWarning, match="3 pixels are NaN, infinite or negative"):
        svu.load_capture(tmp_path / "capture")


def test_exposures_from_a_list(source, tmp_path):
    (tmp_path / "gains.txt").write_text("# name gain\n0.exr 4\n\n1.exr 0.5  # dark\n")
    capture = loaded(source, tmp_path / "capture", exposures=tmp_path / "gains.txt")
    assert capture.exposures == (4.0, 0.5)
    np.testing.assert_allclose(capture.images[1], 3.0)
    for text, sentence in (
        ("0.exr 1\n", "no exposure for 1.exr"), ("0.exr\n", "'0.exr': .*; write NAME GAIN"),
        ("0.exr 1\n1.exr -2", "line 2.*must be a number"), ("0.exr nan", "must be a num.* got nan"),
    ):  # fmt: skip
        (tmp_path / "gains.txt").write_text(text)
        with pytest.raises(CaptureError, match=sentence):
            loaded(source, tmp_path / "again", exposures=tmp_path / "gains.txt")


def test_exposures_from_exif(source, tmp_path):
    frames = []
    for k, (time, iso, aperture) in enumerate(((1 / 50, 100, 4.0), (1 / 200, 800, 8.0))):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: time, 0x8827: iso, 0x829D: aperture})
        path = source.root / f"{k}.jpg"
        Image.fromarray(np.full((6, 8, 3), 90, np.uint8)).save(path, exif=exif)
        frames.append(replace(source.frames[k], image=path))
    with pytest.warns(svu.SvuWarning, match="relative to each other"):
        capture = loaded(replace(source, frames=frames), tmp_path / "capture", exposures="exif")
    ratio = (1 / 200 * 800 / 64) / (1 / 50 * 100 / 16)
    assert capture.exposures[1] / capture.exposures[0] == pytest.approx(ratio, rel=1e-5)
    with pytest.raises(CaptureError, match="0.exr: no exposure time"):
        loaded(source, tmp_path / "again", exposures="exif")


def with_exif(source, *settings):
    """Return the source with JPEGs of these exposure times and apertures (None: not recorded)."""
    frames = []
    for k, (time, aperture) in enumerate(settings):
        exif = Image.Exif()
        tags = {0x829A: time, 0x829D: aperture, 0x8827: 64}
        exif.get_ifd(0x8769).update({tag: x for tag, x in tags.items() if x is not None})
        path = source.root / f"exif{k}.jpg"
        Image.fromarray(np.full((6, 8, 3), 90, np.uint8)).save(path, exif=exif)
        frames.append(replace(source.frames[k], image=path, exposure=1.0))
    return replace(source, frames=frames)


def test_exif_is_used_if_all_photographs_have_it(source, tmp_path):
    unlike = with_exif(source, (1 / 80, 1.8), (1 / 50, 1.8))
    notes = import_capture(unlike, tmp_path / "default")
    assert sum(note.startswith("EXIF: exposures differ by 1.6 x; pixels") for note in notes) == 1
    assert sum("relative to each other" in note for note in notes) == 1
    with pytest.warns(svu.SvuWarning, match="or with --exposures FILE"):
        capture = svu.load_capture(tmp_path / "default")
    assert min(capture.light_uncertainty.scale) > 0.5  # base colours have a factor of about two
    assert source.light is not None
    assert capture.exposures[1] / capture.exposures[0] == pytest.approx(1.6, rel=1e-5)
    assert capture.exposures_known
    for gains, known in (("none", True), ("estimate", False)):
        notes = import_capture(unlike, tmp_path / gains, ImportOptions(exposures=gains))
        capture = svu.load_capture(tmp_path / gains)
        assert capture.exposures == (1.0, 1.0) and capture.exposures_known == known
        assert not any("EXIF" in note for note in notes)
    radiance = [replace(frame, exposure=1.0) for frame in source.frames]  # EXR
    assert loaded(replace(source, frames=radiance), tmp_path / "radiance").exposures_known
    recorded = [replace(frame, exposure=2.0) for frame in unlike.frames]
    assert loaded(replace(unlike, frames=recorded), tmp_path / "own").exposures == (2.0, 2.0)


@pytest.mark.parametrize(("settings", "unused"), [
    (((1 / 80, 1.8), (1 / 80, 1.8)), ""), (((1 / 80, None), (1 / 80, None)), ""),
    (((1 / 80, 1.8), (1 / 80, None)), "2 of 2"), (((1 / 80, 1.8), (None, 1.8)), "1 of 2"),
    (((1 / 80, 1.8), (0, 1.8)), "1 of 2"), (((None, 1.8), (0, None)), "none"),
])  # fmt: skip
def test_equal_and_partial_exif(source, tmp_path, settings, unused):
    """A missing time or aperture is not guessed: the exposures are unknown, which is reported."""
    known = not unused
    some = with_exif(source, *settings)
    notes = import_capture(some, tmp_path / "default")
    capture = svu.load_capture(tmp_path / "default")
    assert capture.exposures == (1.0, 1.0) and capture.exposures_known == known
    said = [note for note in notes if "EXIF" in note]
    assert len(said) == unused.endswith("of 2")
    for note in said:
        assert note.startswith(f"EXIF: exposures of {unused} photographs are not used, and gains")
        assert "exif1.jpg: no " in note and note.endswith("as a list with --exposures.")
    if not known:
        with pytest.raises(CaptureError, match=r"exif[01].jpg: .* EXIF data"):
            import_capture(some, tmp_path / "again", ImportOptions(exposures="exif"))


def test_masks_that_show_nothing(source, tmp_path):
    frames = []
    for k in range(2):
        Image.fromarray(np.zeros_like(GREY[..., 0])).save(tmp_path / f"mask{k}.png")
        frames.append(photograph(source.root / f"{k}.png", mask=tmp_path / f"mask{k}.png"))
    empty = replace(source, frames=frames)
    with pytest.raises(CaptureError, match="mask0.png: this mask and all others are empty"):
        import_capture(empty, tmp_path / "capture")
    cut_out(tmp_path / "mask0.png")
    notes = import_capture(empty, tmp_path / "capture")
    assert any("1.png: not used, because the mask is empty" in note for note in notes)


def test_masks_that_say_nothing_or_the_opposite(source, tmp_path):
    opaque = np.pad(GREY, ((0, 0), (0, 0), (0, 1)), constant_values=255)
    around = np.full_like(GREY[..., 0], 255)
    around[5:15, 5:30] = 0
    Image.fromarray(around).save(tmp_path / "mask.png")
    for mask, said in ((None, "no mask"), (tmp_path / "mask.png", "the mask includes")):
        frames = [photograph(source.root / f"{k}.png", opaque, mask=mask) for k in range(2)]
        notes = import_capture(replace(source, frames=frames), tmp_path / "capture")
        assert any(f"2 of 2 photographs, 0.png first: {said}" in note for note in notes)


def test_a_photograph_that_is_stored_on_its_side(source, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (8, 6)).save(source.root / "0.jpg", exif=exif)
    frame = replace(source.frames[0], image=source.root / "0.jpg")
    notes = import_capture(replace(source, frames=[frame]), tmp_path / "capture")
    assert any("0.jpg: not turned, although EXIF data" in note for note in notes)
    notes = import_capture(
        replace(source, frames=[replace(frame, size=(6, 8))]), tmp_path / "capture"
    )
    assert any("0.jpg: turned as the EXIF orientation" in note for note in notes)
    Image.new("RGB", (8, 6)).save(source.root / "0.jpg")
    with pytest.raises(CaptureError, match="0.jpg.*stored on its side"):
        import_capture(replace(source, frames=[replace(frame, size=(6, 8))]), tmp_path / "capture")


def test_an_exr_that_is_a_crop_of_its_photograph(source, tmp_path):
    corners = {"dataWindow": ((10, 5), (17, 10)), "displayWindow": ((0, 0), (79, 39))}
    header = {key: tuple(np.array(c, np.int32) for c in box) for key, box in corners.items()}
    plane = np.ones((6, 8), np.float32)
    with OpenEXR.File({**header, "type": OpenEXR.scanlineimage}, dict.fromkeys("RGB", plane)) as f:
        f.write(str(source.frames[0].image))
    with pytest.raises(CaptureError, match="0.exr: its data window"):
        import_capture(source, tmp_path / "capture")


def test_photographs_of_one_name_in_two_folders(source, tmp_path):
    frames = []
    for name in ("left", "right"):
        (source.root / name).mkdir()
        frames.append(photograph(source.root / name / "1.png"))
    source = replace(source, frames=frames)
    gains = ImportOptions(exposures=tmp_path / "gains.txt")
    (tmp_path / "gains.txt").write_text("1.png 2\n")
    with pytest.raises(CaptureError, match="2 photographs are named 1.png.*left/1.png"):
        import_capture(source, tmp_path / "capture", gains)
    (tmp_path / "gains.txt").write_text("left/1.png 2\nright/1.png 4\n")
    import_capture(source, tmp_path / "capture", gains)
    record = json.loads((tmp_path / "capture" / "capture.json").read_text())
    assert record["exposure"] == [2, 4]
    assert record["import"]["photographs"] == ["left/1.png", "right/1.png"]


# --- poses ----------------------------------------------------------------------------


NERF = {"camera_angle_x": 0.7, "frames": [
    {"file_path": "./train/r_0", "transform_matrix": np.eye(4).tolist()},
]}  # fmt: skip


def transforms(folder: Path, **changes: object) -> Path:
    """Write a data set like NeRF synthetic, with a byte-order mark, and a photograph."""
    (folder / "train").mkdir(exist_ok=True)
    photograph(folder / "train" / "r_0.PNG")
    (folder / "transforms_train.json").write_text(
        json.dumps({**NERF, **changes}), encoding="utf-8-sig"
    )
    return folder


def test_nerf_synthetic_with_shouted_suffixes(tmp_path):
    (frame,) = read_source(transforms(tmp_path), ReadOptions(format=None)).frames
    assert frame.image.name == "r_0.PNG" and frame.size == (40, 20)
    assert frame.focal == pytest.approx([20 / np.tan(0.35)] * 2)
    (frame,) = read_source(transforms(tmp_path, camera_angle_y=0.5)).frames
    assert frame.focal == pytest.approx([20 / np.tan(0.35), 10 / np.tan(0.25)])
    frame.image.unlink()
    with pytest.raises(CaptureError, match="1 of 1 photographs is missing, first train/r_0; move"):
        read_source(tmp_path)


def test_poses_of_pixels_that_are_not_square_are_candidates(tmp_path):
    record = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 80.0, "file_path": "elsewhere/1.jpg"}
    frame = {**record, "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "poses.json").write_text(json.dumps({"frames": [frame]}))
    (sensor,) = Candidates.read(tmp_path / "poses.json").sensors
    assert film_size(sensor) == (64, 36) and focal_length(sensor) == pytest.approx(60)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "equirectangular is not a pinhole"),
        ({"is_fisheye": True}, "a fisheye is not a pinhole"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1}, "opencv_fisheye is not a pinhole"),
        ({"distortion_params": [0.1, 0, 0, 0]}, "or all 6 as distortion_params; undistort"),
    ],
)
def test_lenses_that_are_not_straight(tmp_path, changes, sentence):
    with pytest.raises(CaptureError, match=sentence):
        read_source(transforms(tmp_path, **changes))


def test_a_format_is_a_module_and_a_line_of_the_table(tmp_path, monkeypatch):
    source = Source(format="mine", root=tmp_path, frames=())
    mine = SimpleNamespace(recognises=lambda path, _: path.is_dir(), read=lambda *_: source)
    monkeypatch.setitem(sys.modules, "svu_mi.capture.importers.mine", mine)
    monkeypatch.setitem(FORMATS, "mine", "mine")
    for chosen in ("auto", "mine"):
        assert read_source(tmp_path, ReadOptions(format=chosen)) is source
    with pytest.raises(OptionError, match="Unknown format 'theirs'; use one of auto, .*, mine"):
        read_source(tmp_path, ReadOptions(format="theirs"))


def test_any_part_of_a_data_set_can_be_asked_for(tmp_path):
    folder = transforms(tmp_path)
    valid = folder / "transforms_valid.json"
    with pytest.raises(OptionError, match="has no transforms_valid.json; use an existing split"):
        read_source(folder, ReadOptions(split="valid"))
    train = (folder / "transforms_train.json").rename(valid)
    assert read_source(folder, ReadOptions(split="valid")).frames[0].label.startswith(str(valid))
    assert read_source(valid, ReadOptions(split="no such part")).frames
    with pytest.raises(CaptureError, match="not a capture of a known format"):
        read_source(folder)
    valid.rename(train)


def test_a_stray_file_beside_a_model_is_none_of_its_parts(tmp_path):
    frame = photograph(tmp_path / "a.png")
    write_colmap(tmp_path, Source(format="test", root=tmp_path, frames=[frame]))
    (tmp_path / "transforms_backup.json").write_text("{}")
    assert read_source(tmp_path).format == "colmap"


def test_folders_that_a_format_has_no_use_for(tmp_path, monkeypatch):
    source = Source(format="orb", root=tmp_path, frames=())
    mine = SimpleNamespace(recognises=lambda path, _: path.is_dir(), read=lambda *_: source)
    monkeypatch.setitem(sys.modules, "svu_mi.capture.importers.stanford_orb", mine)
    with pytest.raises(OptionError, match="for transforms.json.*read as stanford-orb, whose files"):
        read_source(tmp_path, ReadOptions(masks=tmp_path))


def test_the_model_that_nerfstudio_keeps(tmp_path):
    frame = photograph(tmp_path / "a.png")
    source = Source(format="test", root=tmp_path, frames=[frame])
    write_colmap(tmp_path / "data" / "colmap", source)
    (tmp_path / "data" / "colmap" / "images").rename(tmp_path / "data" / "images")
    (copy,) = read_source(tmp_path / "data").frames
    assert copy.image == tmp_path / "data" / "images" / "view_0000.png"
