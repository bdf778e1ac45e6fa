"""What people's files and folders really look like: each case once went wrong."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from svu_mi.capture.picture import read_planes
from svu_mi.capture.poses import film_size, focal_length
from svu_mi.errors import CaptureError, MeshError, OptionError, OutputError
from svu_mi.exr import read_exr, write_exr
from svu_mi.files import making_folder, read_json
from svu_mi.formats.colmap import write_colmap
from svu_mi.formats.geometry import read_geometry
from svu_mi.formats.importing import ImportOptions, import_capture
from svu_mi.formats.photographs import convert
from svu_mi.formats.reading import ReadOptions, read_source
from svu_mi.formats.resampling import squared
from svu_mi.formats.source import Frame, Light, Source
from svu_mi.guidance.candidates import Candidates

# --- folders ------------------------------------------------------------------------------


def test_a_folder_that_cannot_be_made_leaves_nothing(tmp_path, monkeypatch):
    def refused(path: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", refused)
    with pytest.raises(OutputError, match="No space"), making_folder(tmp_path / "project") as made:
        (made / "new").touch()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_made_where_there_is_none_or_an_empty_one(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "project").symlink_to(tmp_path / "disk")
    with making_folder(tmp_path / "project") as made:
        (made / "new").touch()
    assert (tmp_path / "project").is_symlink() and (tmp_path / "disk" / "new").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"project", "disk"}
    with pytest.raises(OutputError, match="holds other files"), making_folder(tmp_path / "disk"):
        pass


def test_json_with_a_mark_of_its_encoding(tmp_path):
    (tmp_path / "t.json").write_text(json.dumps({"name": "Schüssel"}), encoding="utf-8-sig")
    assert read_json(tmp_path / "t.json") == {"name": "Schüssel"}


# --- photographs and masks ----------------------------------------------------------------

SIZE = (40, 20)  # width, height
LEFT = np.zeros(SIZE[::-1], bool)  # the object of all masks here
LEFT[:, :17] = True


def photograph(path: Path, pixels: np.ndarray | None = None, **fields: object) -> Frame:
    """Write a picture, and return it as a frame."""
    if pixels is None:
        pixels = np.full((*SIZE[::-1], 3), 90, np.uint8)
    Image.fromarray(pixels).save(path)
    return Frame(**{
        "label": "frame 0", "image": path, "to_world": np.eye(4), "focal": (50.0, 50.0),
        "center": (20.0, 10.0), "size": SIZE, **fields,
    })  # fmt: skip


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
    assert not convert(frame, tmp_path / "view.exr", (1, 1)).empty
    assert np.array_equal(read_exr(tmp_path / "view.exr")["A"] == 1, LEFT)


def test_blenders_layers(tmp_path):
    planes = {c: np.full((4, 6), k / 4, np.float32) for k, c in enumerate("RGBA", 1)}
    passes = {f"ViewLayer.Combined.{c}": plane for c, plane in planes.items()}
    others = {f"ViewLayer.DiffCol.{c}": np.ones((4, 6), np.float32) for c in "RGB"}
    write_exr(tmp_path / "1.exr", {**passes, **others, "ViewLayer.Depth.Z": planes["R"]})
    found, low_range = read_planes(tmp_path / "1.exr")
    np.testing.assert_array_equal(found, list(planes.values()))
    assert not low_range
    write_exr(tmp_path / "1.exr", {**others, "ViewLayer.Emit.R": planes["R"]})
    with pytest.raises(CaptureError, match="found ViewLayer.*export it as plain RGB"):
        read_planes(tmp_path / "1.exr")


def test_clipped_pixels_of_the_background_are_not_counted(tmp_path):
    cut_out(tmp_path / "mask.png")
    white = np.full((*SIZE[::-1], 3), 255, np.uint8)
    white[:, 1:17] = 90
    frame = photograph(tmp_path / "photo.png", white, mask=tmp_path / "mask.png")
    assert convert(frame, tmp_path / "view.exr", (1, 1)).saturated == SIZE[1]


def test_masks_that_show_nothing(tmp_path):
    source = complete(tmp_path, count=2)
    black = np.zeros(SIZE[::-1], np.uint8)
    frames = []
    for k, frame in enumerate(source.frames):
        Image.fromarray(black).save(tmp_path / f"mask{k}.png")
        frames.append(replace(frame, mask=tmp_path / f"mask{k}.png"))
    with pytest.raises(CaptureError, match="mask0.png: as all others, its mask shows nothing"):
        import_capture(replace(source, frames=frames), tmp_path / "capture")
    cut_out(tmp_path / "mask0.png")
    notes = import_capture(replace(source, frames=frames), tmp_path / "capture")
    assert any("1 of 2 photographs, 1.png first, have an empty mask" in note for note in notes)


def test_masks_that_say_nothing_or_the_opposite(tmp_path):
    source = complete(tmp_path, count=2)
    opaque = np.full((*SIZE[::-1], 4), 255, np.uint8)
    opaque[..., :3] = 90
    frames = [photograph(tmp_path / f"opaque{k}.png", opaque) for k in range(2)]
    notes = import_capture(replace(source, frames=frames), tmp_path / "capture")
    assert any("2 of 2 photographs have no mask" in note for note in notes)
    around = np.full(SIZE[::-1], 255, np.uint8)
    around[5:15, 5:30] = 0
    Image.fromarray(around).save(tmp_path / "mask.png")
    frames = [replace(frame, mask=tmp_path / "mask.png") for frame in source.frames]
    notes = import_capture(replace(source, frames=frames), tmp_path / "capture")
    assert any("2 of 2 masks have the border" in note for note in notes)


def complete(folder: Path, count: int) -> Source:
    """Photographs, a triangle and a light."""
    triangle = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False)
    triangle.export(folder / "mesh.ply")
    write_exr(folder / "light.exr", {"RGB": np.ones((4, 8, 3))})
    frames = [photograph(folder / f"{k}.png") for k in range(count)]
    light = Light(path=folder / "light.exr")
    return Source(
        format="test", root=folder, frames=frames, mesh=folder / "mesh.ply", light=light
    )


@pytest.mark.parametrize("shrink", [1.0, 1.9])
def test_memory_of_a_photograph_is_bounded(tmp_path, shrink):
    side = 768
    pixels = np.full((side, side, 3), 90, np.uint8)
    frame = photograph(
        tmp_path / "photo.png", pixels, size=(side, side), focal=(900.0, 900.0), center=(384, 384)
    )
    tracemalloc.start()
    convert(frame, tmp_path / "view.exr", squared(frame, shrink)[1])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 48 * side * side


def test_what_somebody_put_beside_a_capture_is_kept(tmp_path):
    source = complete(tmp_path, count=1)
    for _ in range(2):
        import_capture(source, tmp_path / "capture")
    (tmp_path / "capture" / "recovered").mkdir()
    with pytest.raises(OutputError, match="holds other files"):
        import_capture(source, tmp_path / "capture")
    assert (tmp_path / "capture" / "recovered").exists()


# --- meshes -------------------------------------------------------------------------------

UVS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def square(**changes: object) -> trimesh.Trimesh:
    """A square with UVs and a picture, white above."""
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:4] = 255
    fields = {"baseColorTexture": Image.fromarray(picture), **changes}
    visual = trimesh.visual.TextureVisuals(UVS, PBRMaterial(**fields))
    points = np.pad(2 * UVS - 1, ((0, 0), (0, 1)))
    return trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


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
    compressed: "is compressed .KHR_draco", moved: "moved or scaled by KHR_texture",
}  # fmt: skip


@pytest.mark.parametrize("change", GLTF)
def test_gltf_that_would_be_read_as_something_else(tmp_path, change):
    square().export(tmp_path / "mesh.gltf")
    read_geometry(tmp_path / "mesh.gltf")
    record = json.loads((tmp_path / "mesh.gltf").read_text())
    change(record)
    (tmp_path / "mesh.gltf").write_text(json.dumps(record))
    with pytest.raises(MeshError, match=GLTF[change]):
        read_geometry(tmp_path / "mesh.gltf")
    if change in (quantised, moved):
        read_geometry(tmp_path / "mesh.gltf", geometry_only=True)


def test_gltf_with_its_numbers_in_a_folder(tmp_path):
    trimesh.creation.icosphere(2).export(tmp_path / "mesh.gltf")
    record = json.loads((tmp_path / "mesh.gltf").read_text())
    (tmp_path / "data").mkdir()
    for buffer in record["buffers"]:
        (tmp_path / buffer["uri"]).rename(tmp_path / "data" / f"my {buffer['uri']}")
        buffer["uri"] = f"data/my%20{buffer['uri']}"
    (tmp_path / "mesh.gltf").write_text(json.dumps(record))
    assert len(read_geometry(tmp_path / "mesh.gltf").mesh.faces) == 320


def test_materials_without_a_picture_do_not_matter(tmp_path):
    plain = [
        square(baseColorTexture=None, baseColorFactor=color)
        for color in ([255, 0, 0, 255], [0, 0, 255, 255])
    ]
    trimesh.Scene(plain).export(tmp_path / "mesh.glb")
    geometry = read_geometry(tmp_path / "mesh.glb")
    assert geometry.mesh.uvs is not None and not geometry.textures


def test_vertices_of_no_triangle_are_left_out(tmp_path):
    points = np.vstack([[1e6, 0, 0], np.pad(UVS, ((0, 0), (0, 1)))])
    faces = [[1, 2, 3], [1, 3, 4]]
    trimesh.Trimesh(points, faces, process=False).export(tmp_path / "mesh.ply")
    mesh = read_geometry(tmp_path / "mesh.ply").mesh
    assert np.array_equal(mesh.positions, points[1:])
    assert np.array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])


def test_ply_with_a_texture_has_v_upwards(tmp_path):
    mesh = square()
    mesh.visual = trimesh.visual.TextureVisuals(UVS)
    mesh.export(tmp_path / "mesh.ply", vertex_normal=True, encoding="ascii")
    text = (tmp_path / "mesh.ply").read_text()
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "paint.png")
    text = text.replace("element vertex", "comment TextureFile paint.png\nelement vertex")
    (tmp_path / "mesh.ply").write_text(text)
    geometry = read_geometry(tmp_path / "mesh.ply")
    assert set(geometry.textures) == {"base_color"}
    np.testing.assert_allclose(geometry.mesh.uvs, [0, 1] + UVS * [1, -1])


# --- poses --------------------------------------------------------------------------------

NERF = {"camera_angle_x": 0.7, "frames": [
    {"file_path": "./train/r_0", "transform_matrix": np.eye(4).tolist()},
]}  # fmt: skip


def transforms(folder: Path, **changes: object) -> Path:
    """Write a data set as NeRF's synthetic ones are, with its one photograph."""
    (folder / "train").mkdir(exist_ok=True)
    photograph(folder / "train" / "r_0.PNG")
    (folder / "transforms_train.json").write_text(json.dumps({**NERF, **changes}))
    return folder


def test_nerf_synthetic_with_shouted_suffixes(tmp_path):
    (frame,) = read_source(transforms(tmp_path)).frames
    assert frame.image.name == "r_0.PNG" and frame.size == SIZE
    assert frame.focal == pytest.approx([20 / np.tan(0.35)] * 2)
    (frame,) = read_source(transforms(tmp_path, camera_angle_y=0.5)).frames
    assert frame.focal == pytest.approx([20 / np.tan(0.35), 10 / np.tan(0.25)])
    frame.image.unlink()
    with pytest.raises(CaptureError, match="r_0: no such photograph"):
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
        ({"camera_model": "EQUIRECTANGULAR"}, "equirectangular is no pinhole"),
        ({"is_fisheye": True}, "a fisheye is no pinhole"),
        ({"distortion_params": [0.1, 0, 0, 0]}, "distorted.*--undistort"),
        ({"k1": 1e-3}, "distorted.*--undistort"),
    ],
)
def test_lenses_that_are_not_straight(tmp_path, changes, sentence):
    with pytest.raises(CaptureError, match=sentence):
        read_source(transforms(tmp_path, **changes))


def test_folders_that_a_format_has_no_use_for(tmp_path):
    with pytest.raises(OptionError, match="for COLMAP.*read as transforms"):
        read_source(transforms(tmp_path), ReadOptions(masks=tmp_path))


def test_the_model_that_nerfstudio_keeps(tmp_path):
    frame = photograph(tmp_path / "a.png")
    source = Source(format="test", root=tmp_path, frames=[frame])
    write_colmap(tmp_path / "data" / "colmap", source)
    (tmp_path / "data" / "colmap" / "images").rename(tmp_path / "data" / "images")
    (found,) = read_source(tmp_path / "data").frames
    assert found.image == tmp_path / "data" / "images" / "view_0000.png"


def test_a_photograph_that_is_stored_on_its_side(tmp_path):
    source = complete(tmp_path, count=1)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", SIZE).save(tmp_path / "0.jpg", exif=exif)
    frame = replace(source.frames[0], image=tmp_path / "0.jpg")
    notes = import_capture(replace(source, frames=[frame]), tmp_path / "capture")
    assert any("0.jpg first, are stored turned" in note for note in notes)
    frame = replace(frame, size=SIZE[::-1])
    with pytest.raises(CaptureError, match="0.jpg.*stored on its side"):
        import_capture(replace(source, frames=[frame]), tmp_path / "capture")


def test_an_exr_that_is_a_crop_of_its_photograph(tmp_path):
    corners = {"dataWindow": ((10, 5), (49, 24)), "displayWindow": ((0, 0), (79, 39))}
    header = {key: tuple(np.array(c, np.int32) for c in box) for key, box in corners.items()}
    plane = np.ones(SIZE[::-1], np.float32)
    with OpenEXR.File({**header, "type": OpenEXR.scanlineimage}, dict.fromkeys("RGB", plane)) as f:
        f.write(str(tmp_path / "0.exr"))
    source = complete(tmp_path, count=1)
    frame = replace(source.frames[0], image=tmp_path / "0.exr")
    with pytest.raises(CaptureError, match="0.exr: its data window"):
        import_capture(replace(source, frames=[frame]), tmp_path / "capture")


def test_one_axis_alone_says_nothing(tmp_path):
    with pytest.raises(OptionError, match="give both"):
        import_capture(complete(tmp_path, 1), tmp_path / "capture", ImportOptions(world_up="z"))


def test_photographs_of_one_name_in_two_folders(tmp_path):
    source = complete(tmp_path, count=1)
    frames = []
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        frames.append(photograph(tmp_path / name / "1.png"))
    source = replace(source, frames=frames)
    gains = ImportOptions(exposures=tmp_path / "gains.txt")
    (tmp_path / "gains.txt").write_text("1.png 2\n")
    with pytest.raises(CaptureError, match="2 photographs are called 1.png.*left/1.png"):
        import_capture(source, tmp_path / "capture", gains)
    (tmp_path / "gains.txt").write_text("left/1.png 2\nright/1.png 4\n")
    import_capture(source, tmp_path / "capture", gains)
    record = json.loads((tmp_path / "capture" / "capture.json").read_text())
    assert record["exposure"] == [2, 4]
    assert record["import"]["photographs"] == ["left/1.png", "right/1.png"]
