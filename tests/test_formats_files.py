"""What captures consist of: meshes, photographs, masks, environment maps of any kind."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial, SimpleMaterial

import svu_mi as svu
from svu_mi.capture.images import UNUSABLE
from svu_mi.capture.mesh import MeshArrays, arrays
from svu_mi.capture.poses import describe
from svu_mi.capture.scene import to_world
from svu_mi.cli.main import main
from svu_mi.errors import CaptureError, MeshError, OptionError, OutputError
from svu_mi.exr import read_exr, write_exr
from svu_mi.formats.fixes import FIXES
from svu_mi.formats.geometry import read_geometry
from svu_mi.formats.importing import ImportOptions, import_capture
from svu_mi.formats.light import write_environment
from svu_mi.formats.normals import repaired
from svu_mi.formats.photographs import convert
from svu_mi.formats.resampling import fitted, resampled, squared
from svu_mi.formats.source import ENVIRONMENT_AXES, OPENGL, Frame, Light, Source

SEED = 826417309
PICTURE = np.zeros((8, 8, 3), np.uint8)
PICTURE[:4] = 255  # white above, black below


def quad(**changes: object) -> trimesh.Trimesh:
    """A square whose upper half (y > 0) is white: V is up in trimesh."""
    points = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    uvs = points[:, :2] / 2 + 0.5
    material = changes.pop("material", SimpleMaterial(image=Image.fromarray(PICTURE)))
    visual = trimesh.visual.TextureVisuals(uvs, material) if material is not None else None
    return trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False, **changes)


def upper_color(path) -> float:
    """The colour of the half with y > 0, looked up as Mitsuba does: row 0 is v = 0."""
    geometry = read_geometry(path)
    top = geometry.mesh.positions[:, 1] > 0
    v = 0.75 * geometry.mesh.uvs[top, 1].mean() + 0.25 * geometry.mesh.uvs[~top, 1].mean()
    picture = geometry.textures["base_color"]
    return float(picture[int(v * len(picture)), 0, 0])


@pytest.mark.parametrize("kind", ["glb", "gltf", "obj"])
def test_textures_are_the_right_way_up(tmp_path, kind):
    material = PBRMaterial(baseColorTexture=Image.fromarray(PICTURE))
    quad(**({} if kind == "obj" else {"material": material})).export(tmp_path / f"quad.{kind}")
    assert upper_color(tmp_path / f"quad.{kind}") == 255


def test_ply_keeps_mitsubas_uvs_and_stl_has_none(tmp_path):
    mesh = quad(material=None)
    mesh.visual = trimesh.visual.TextureVisuals(mesh.vertices[:, :2] / 2 + 0.5)
    mesh.export(tmp_path / "quad.ply", vertex_normal=True)
    geometry = read_geometry(tmp_path / "quad.ply")
    np.testing.assert_allclose(geometry.mesh.uvs, mesh.visual.uv, atol=1e-6)
    assert not geometry.textures and not geometry.notes
    mesh.export(tmp_path / "quad.stl")
    geometry = read_geometry(tmp_path / "quad.stl")
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
    mesh = read_geometry(tmp_path / "two.glb").mesh
    np.testing.assert_allclose(mesh.positions.min(axis=0), [-2, -2, -2], atol=1e-5)
    np.testing.assert_allclose(mesh.positions.max(axis=0), [6, 2, 2], atol=1e-5)
    whole = trimesh.Trimesh(mesh.positions, mesh.faces)
    assert whole.volume == pytest.approx(9 * ball.volume, rel=1e-4)
    center = np.where(mesh.positions[:, :1] > 3, [[5.0, 0, 0]], [[0.0, 0, 0]])
    assert (np.einsum("ij,ij->i", mesh.normals, mesh.positions - center) > 0).all()


def test_several_materials_are_refused_unless_geometry_will_do(tmp_path):
    scene = trimesh.Scene([
        quad(material=PBRMaterial(baseColorTexture=Image.fromarray(PICTURE + k))) for k in (0, 1)
    ])  # fmt: skip
    scene.export(tmp_path / "two.glb")
    with pytest.raises(MeshError, match="two.glb: has 2 materials.*--geometry-only"):
        read_geometry(tmp_path / "two.glb")
    geometry = read_geometry(tmp_path / "two.glb", geometry_only=True)
    assert geometry.mesh.uvs is None and "textures are left out" in geometry.notes[0]


def test_normals_with_swapped_axes_are_computed_anew(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3)
    good = MeshArrays(np.array(ball.vertices), np.array(ball.faces), np.array(ball.vertices), None)
    kept, notes = repaired(good, "ball")
    assert not notes
    np.testing.assert_allclose(kept.normals, good.normals, atol=1e-12)
    swapped, notes = repaired(replace(good, normals=good.normals[:, [0, 2, 1]]), "ball")
    assert "contradict" in notes[0]
    assert np.einsum("ij,ij->i", swapped.normals, good.normals).min() > 0.99
    turned, notes = repaired(replace(good, faces=good.faces[:, ::-1]), "ball")
    assert "inside out" in notes[0] and np.array_equal(turned.faces, good.faces)


def test_missing_normals_are_smooth_across_uv_seams(tmp_path):
    ball = trimesh.creation.uv_sphere(count=(24, 24))
    doubled = np.array(ball.triangles).reshape(-1, 3)  # every corner a vertex of its own
    faces = np.arange(len(doubled)).reshape(-1, 3)
    mesh, _ = repaired(MeshArrays(doubled, faces, None, None), "ball")
    assert np.einsum("ij,ij->i", mesh.normals, doubled).min() > 0.99


# --- photographs --------------------------------------------------------------------------


def frame(tmp_path, pixels: np.ndarray, **fields: object) -> Frame:
    path = tmp_path / "photo.png"
    Image.fromarray(pixels).save(path)
    size = pixels.shape[1::-1]
    return Frame(**{
        "label": "frame 0", "image": path, "to_world": np.eye(4), "focal": (20.0, 20.0),
        "center": (size[0] / 2, size[1] / 2), "size": size, **fields,
    })  # fmt: skip


def test_eight_bits_are_decoded_and_clipped_pixels_left_out(tmp_path):
    pixels = np.full((4, 6, 3), 128, np.uint8)
    pixels[1, 2] = (255, 10, 10)
    found = convert(frame(tmp_path, pixels), tmp_path / "view.exr", (1, 1))
    image = read_exr(tmp_path / "view.exr")
    assert found.bits == 8 and found.saturated == 1 and not found.masked and "A" not in image
    assert image["R"][0, 0] == pytest.approx(0.2158605, rel=1e-3)  # half floats
    assert image["R"][1, 2] == UNUSABLE
    convert(frame(tmp_path, pixels, transfer="gamma 2.2"), tmp_path / "view.exr", (1, 1))
    assert read_exr(tmp_path / "view.exr")["R"][0, 0] == pytest.approx((128 / 255) ** 2.2, rel=1e-3)


def test_masks_from_files_and_alpha_both_count(tmp_path):
    pixels = np.full((4, 4, 4), 100, np.uint8)
    pixels[..., 3] = 255
    pixels[0, 0, 3] = 0
    mask = np.full((4, 4), 255, np.uint8)
    mask[3, 3] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    given = frame(tmp_path, pixels, mask=tmp_path / "mask.png")
    assert convert(given, tmp_path / "view.exr", (1, 1)).masked
    alpha = read_exr(tmp_path / "view.exr")["A"]
    assert alpha[0, 0] == alpha[3, 3] == 0 and alpha.sum() == 14
    Image.fromarray(mask[:2]).save(tmp_path / "mask.png")
    with pytest.raises(CaptureError, match="mask.png: the mask has 4 x 2"):
        convert(given, tmp_path / "view.exr", (1, 1))


@pytest.mark.parametrize("scale", [(1.0, 0.5), (0.371, 0.62), (1 / 3, 1.0)])
def test_pixels_are_averaged_over_their_area(scale):
    image = np.random.default_rng(SEED).random((12, 15, 2)).astype(np.float32)
    found = resampled(image, scale)
    wanted = overlap(12, scale[1]) @ np.moveaxis(overlap(15, scale[0]) @ image, 2, 0)
    np.testing.assert_allclose(found, np.moveaxis(wanted, 0, 2), atol=1e-6)


def overlap(count: int, scale: float) -> np.ndarray:
    """Part of each new pixel that each old one covers, one entry at a time."""
    edges = np.arange(int(count * scale + 1e-6) + 1) / scale
    matrix = np.zeros((len(edges) - 1, count))
    for new, old in np.ndindex(matrix.shape):
        shared = min(edges[new + 1], old + 1) - max(edges[new], old)
        matrix[new, old] = max(shared, 0) * scale
    return matrix


def test_cameras_follow_their_photographs(tmp_path):
    black = np.zeros((40, 60, 3), np.uint8)
    given = frame(tmp_path, black, focal=(80.0, 50.0), center=(31.0, 17.0))
    rays = pixel_rays(given)
    for shrink in (1.0, 1.7):
        square, scale = squared(given, shrink)
        assert square.has_square_pixels and square.size == (int(60 * scale[0]), int(40 * scale[1]))
        np.testing.assert_allclose(pixel_rays(square), rays, atol=1e-12)
    half = fitted(given, (30, 20))
    np.testing.assert_allclose(pixel_rays(half), rays, atol=1e-12)
    with pytest.raises(CaptureError, match="another shape"):
        fitted(given, (30, 30))
    with pytest.raises(OptionError, match="shrunk"):
        squared(given, 0.5)


def pixel_rays(frame: Frame) -> np.ndarray:
    """Slopes at the corner of the first pixel, (0, 0)."""
    return -np.array(frame.center) / frame.focal


# --- environment maps ---------------------------------------------------------------------


def spot(width: int, column: int, row: int) -> np.ndarray:
    pixels = np.full((width // 2, width, 3), 0.1, np.float32)
    pixels[row, column] = 5
    return pixels


@pytest.mark.parametrize("axes", ENVIRONMENT_AXES)
def test_a_spot_stands_where_its_convention_says(tmp_path, axes):
    """Each convention's top row is its up axis, its centre column its own."""
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
    assert read_exr(tmp_path / "environment.exr")["R"][9, 64 - 1 - 5] == 5


def test_maps_that_are_none(tmp_path):
    for pixels, sentence in (
        (np.ones((8, 8, 3)), "twice as wide"),
        (np.zeros((8, 16, 3)), "entirely black"),
    ):
        write_exr(tmp_path / "map.exr", {"RGB": pixels})
        with pytest.raises(CaptureError, match=sentence):
            write_environment(Light(path=tmp_path / "map.exr"), tmp_path / "e.exr")
    Image.fromarray(np.zeros((8, 16, 3), np.uint8)).save(tmp_path / "map.png")
    with pytest.raises(CaptureError, match="eight bits"):
        write_environment(Light(path=tmp_path / "map.png"), tmp_path / "e.exr")
    assert not (tmp_path / "e.exr").exists()


# --- the importer -------------------------------------------------------------------------


@pytest.fixture
def source(tmp_path) -> Source:
    """Two photographs of a quad, and all that goes with them."""
    folder = tmp_path / "given"
    folder.mkdir()
    quad().export(folder / "quad.obj")
    write_exr(folder / "map.exr", {"RGB": spot(32, 3, 4)})
    frames = []
    for k in range(2):
        write_exr(folder / f"{k}.exr", {"RGB": np.full((6, 8, 3), 0.5 + k)})
        pose = np.eye(4)
        pose[:3, 3] = (0.3 * k, 0.2, -4)
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
            # As if the file's matrix had been taken for its inverse.
            wanted = np.linalg.inv(frame.to_world @ OPENGL) @ OPENGL
        else:
            axis = "xyz".index(fix.removeprefix("camera-")[0])
            wanted = frame.to_world @ np.diag([1.0 if k in (axis, 3) else -1.0 for k in range(4)])
        np.testing.assert_allclose(to_world(sensor), wanted, atol=1e-6)


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


def test_photographs_are_shrunk_with_their_cameras(source, tmp_path):
    capture = loaded(source, tmp_path / "capture", shrink=2.0)
    record = describe(capture.sensors[0])
    assert record["film"] == [4, 3] and capture.images[0].shape == (3, 4, 3)
    assert record["principal_point_offset"][0] == pytest.approx(0.5 - 2.1 / 4, abs=1e-6)


def test_what_is_missing_is_asked_for(source, tmp_path):
    for change, sentence in (({"mesh": None}, "--mesh"), ({"light": None}, "--environment")):
        with pytest.raises(OptionError, match=sentence):
            import_capture(replace(source, **change), tmp_path / "capture")
    for options in ({"every": 0}, {"mesh_scale": -1.0}, {"shrink": 0.5}, {"fixes": ("up",)}):
        with pytest.raises(OptionError):
            import_capture(source, tmp_path / "capture", ImportOptions(**options))
    (source.root / "1.exr").unlink()
    with pytest.raises(CaptureError, match="1.exr: no such photograph"):
        import_capture(source, tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


def test_only_an_earlier_import_is_replaced(source, tmp_path):
    import_capture(source, tmp_path / "capture")
    import_capture(source, tmp_path / "capture", ImportOptions(every=2))
    assert not (tmp_path / "capture" / "view_0001.exr").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="holds other files"):
        import_capture(source, tmp_path / "mine")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="is a file"):
        import_capture(source, tmp_path / "file")


def test_the_command_says_one_line_and_leaves_nothing(tmp_path, capsys):
    assert main(["import", str(tmp_path / "none"), "-o", str(tmp_path / "capture")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("svu: ") and error.count("\n") == 1 and "no such" in error
    assert not (tmp_path / "capture").exists()


def test_pixels_marked_by_the_import_are_left_out_without_a_word(source, tmp_path):
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
        ("0.exr 1\n", "no exposure of 1.exr"), ("0.exr\n", "line 1: expected NAME GAIN"),
        ("0.exr 1\n1.exr -2", "line 2.*not positive"), ("0.exr nan", "not positive"),
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
    capture = loaded(replace(source, frames=frames), tmp_path / "capture", exposures="exif")
    ratio = (1 / 200 * 800 / 64) / (1 / 50 * 100 / 16)
    assert capture.exposures[1] / capture.exposures[0] == pytest.approx(ratio, rel=1e-5)
    with pytest.raises(CaptureError, match="0.exr: no exposure time"):
        loaded(source, tmp_path / "again", exposures="exif")
