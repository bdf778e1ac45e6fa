"""transforms.json of NeRF tools, Blender and nerfstudio, and errors in it."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from svu_mi.capture.importers.import_capture import import_capture
from svu_mi.capture.importers.import_options import ImportOptions
from svu_mi.capture.importers.nerf import read_transforms, write_transforms
from svu_mi.capture.importers.nerfstudio_world import AppliedWorld, read_normalisation
from svu_mi.capture.importers.registry import ReadOptions, read_source
from svu_mi.capture.importers.source import OPENGL, Frame
from svu_mi.capture.mesh import read_ply
from svu_mi.capture.sensors import affine, describe
from svu_mi.core.io.exr import write_exr
from svu_mi.errors import CaptureError, OptionError

GOOD = {"transform_matrix": np.eye(4).tolist(), "w": 8, "h": 6, "fl_x": 9.0}
BROKEN = {
    "no matrix": ({"transform_matrix": None}, "a frame needs"),
    "a small matrix": ({"transform_matrix": [[1, 0], [0, 1]]}, "a frame needs"),
    "words in the matrix": ({"transform_matrix": [["a"] * 4] * 4}, "a frame needs"),
    "no focal length": ({"fl_x": "drop"}, "camera_angle_x"),
    "no width": ({"w": "drop"}, "frame 1: w or h is missing; a frame needs"),
    "a width of none": ({"w": 0}, r"w must be a number in \[1, 65536\] pixels, got 0;"),
    "a focal length of 0": ({"fl_x": 0}, "fl_x must be a number .* pixels, got 0"),
    "a focal length of nan": ({"fl_x": float("nan")}, "fl_x must be .* pixels, got nan"),
    "a height of nan": ({"fl_y": float("nan")}, "fl_y must be .* pixels, got nan"),
    "a height in words": ({"fl_y": "long"}, "a frame needs"),
    **{
        f"an angle of {angle}": (
            {"fl_x": "drop", "camera_angle_x": angle},
            r"camera_angle_x must be "
            r"a number in \[1e-06, 3.14159\] radians",
        )
        for angle in (0, -1, 4, 1e308, float("nan"))
    },
    "nan in the matrix": (
        {"transform_matrix": np.full((4, 4), np.nan).tolist()},
        r"\[0\] must be 4 num.* nan",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_frame_is_named(tmp_path, case):
    changes, sentence = BROKEN[case]
    frame = {k: v for k, v in {**GOOD, **changes}.items() if v != "drop"}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": [GOOD, frame]}))
    with pytest.raises(CaptureError, match=sentence) as error:
        read_transforms(path)
    assert f"{path}: frame 1" in str(error.value)


def test_too_many_frames_are_refused_unread(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": [0] * 10_001}))  # not frames
    with pytest.raises(
        CaptureError, match="transforms.json: .* 1 to 10000 photographs, got a list of 10001;"
    ):
        read_transforms(path)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"frames": []}', '{"frames": {}}', "[" * 100_000])
def test_no_poses_at_all(tmp_path, text):
    (tmp_path / "poses.json").write_text(text)
    with pytest.raises(CaptureError, match="poses.json: no"):
        read_transforms(tmp_path / "poses.json")
    with pytest.raises(CaptureError, match="none.json"):
        read_transforms(tmp_path / "none.json")


@pytest.mark.parametrize("frame", [
    None, 3, "view", [1, 2],
    *({**GOOD, "file_path": name}  # photographs elsewhere
      for name in ("../a.png", "/etc/passwd", "C:\\a.png", "x/../../a.png", 3)),
])  # fmt: skip
def test_a_frame_that_is_none(tmp_path, frame):
    (tmp_path / "poses.json").write_text(json.dumps({"frames": [frame]}))
    with pytest.raises(CaptureError, match=r"frames\[0\] must be an object, got|frame 0: "):
        read_transforms(tmp_path / "poses.json")


def test_intrinsics_of_the_file_are_those_of_its_frames(tmp_path):
    shared = {"w": 8, "h": 6, "camera_angle_x": np.radians(40), "fl_y": 4 / np.tan(np.radians(20))}
    frames = [{"transform_matrix": np.eye(4)[:3].tolist()}, {**GOOD, "fl_y": 9.0}]
    (tmp_path / "t.json").write_text(json.dumps({**shared, "frames": frames}))
    first, second = (describe(f.sensor()) for f in read_transforms(tmp_path / "t.json").frames)
    assert first["x_fov"] == pytest.approx(40) and first["film"] == [8, 6]
    assert second["x_fov"] == pytest.approx(2 * np.degrees(np.arctan(4 / 9)))
    # OpenGL's camera looks along -Z, with +X to the right; ours along +Z, with +X to the left.
    np.testing.assert_allclose(first["to_world"], np.diag([-1, 1, -1, 1]))


def split_capture(folder, **lists):
    """Write poses of six photographs, and lists of the numbers of each part."""
    names = [f"images/{k}.png" for k in range(6)]
    frames = [{**GOOD, "file_path": f"./{name}"} for name in names]
    parts = {f"{part}_filenames": [names[k] for k in numbers] for part, numbers in lists.items()}
    (folder / "transforms.json").write_text(json.dumps({**parts, "frames": frames}))
    return folder


@pytest.mark.parametrize(
    ("split", "numbers"), [("train", "013"), ("test", "45"), ("val", "2"), ("all", "012345")]
)
def test_split_lists_of_nerfstudio_are_followed(tmp_path, split, numbers):
    folder = split_capture(tmp_path, train=[3, 0, 1], test=[4, 5], val=[2])
    source = read_source(folder, ReadOptions(split=split))
    assert "".join(frame.image.stem for frame in source.frames) == numbers
    assert source.frames[-1].label == f"{folder / 'transforms.json'}: frame {numbers[-1]}"
    left_out = f"{6 - len(numbers)} of 6 photographs are not in {split}_filenames and left out"
    assert [left_out in note for note in source.notes] == ([True] if split != "all" else [])


@pytest.mark.parametrize(
    ("lists", "sentence"),
    [
        ({"test": [4]}, "has test_filenames, but no train_filenames; use another --split"),
        ({"train": []}, "train_filenames is empty; .* with --split all"),
        ({"train": [0]}, "train_filenames contains images/0.jpg, which has no pose"),
        ({"train": [0], "test": [1]}, "train_filenames must be"),
    ],
)
def test_wrong_split_lists_are_refused(tmp_path, lists, sentence):
    file = split_capture(tmp_path, **lists) / "transforms.json"
    text = file.read_text()
    if "jpg" in sentence:
        text = text.replace('["images/0.png"]', '["images/0.jpg"]')
    if "must be" in sentence:
        text = text.replace('["images/0.png"]', '"images/0.png"')
    file.write_text(text)
    with pytest.raises((CaptureError, OptionError), match=sentence):
        read_source(tmp_path)


def test_files_without_lists_have_no_splits(tmp_path):
    folder = split_capture(tmp_path)
    for split in ("train", "test", "all"):
        assert len(read_source(folder, ReadOptions(split=split)).frames) == 6


def turned(seed: int) -> np.ndarray:
    """Return a random rotation and translation."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix[:3, 0] *= np.linalg.det(matrix[:3, :3])
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def frame(tmp_path, seed: int, **fields: object) -> Frame:
    return Frame(**{
        "label": "frame", "image": tmp_path / "images" / f"{seed}.png", "to_world": turned(seed),
        "focal": (900.0, 700.0), "center": (130.5, 80.25), "size": (320, 200), **fields,
    })  # fmt: skip


def test_frames_come_back_as_they_were(tmp_path):
    given = [
        frame(tmp_path, 1718),
        frame(tmp_path, 5391, mask=tmp_path / "masks" / "5391.png", exposure=0.25),
    ]
    write_transforms(tmp_path / "transforms.json", given)
    source = read_transforms(tmp_path / "transforms.json")
    assert source.root == tmp_path and source.notes == ()
    for actual, wanted in zip(source.frames, given, strict=True):
        np.testing.assert_allclose(actual.to_world, wanted.to_world, atol=1e-12)
        for name in ("image", "mask", "focal", "center", "size", "exposure"):
            assert getattr(actual, name) == getattr(wanted, name)


def test_a_transform_that_nerfstudio_applied_is_told_or_undone(tmp_path):
    applied = turned(94)
    record = {"applied_transform": applied[:3].tolist()}
    frame = {**GOOD, "transform_matrix": (applied @ turned(7) @ OPENGL).tolist()}
    (tmp_path / "t.json").write_text(json.dumps({**record, "frames": [frame]}))
    kept = read_transforms(tmp_path / "t.json")
    assert "applied_transform" in kept.notes[0]
    np.testing.assert_allclose(kept.frames[0].to_world, applied @ turned(7), atol=1e-12)
    undone = read_transforms(tmp_path / "t.json", original_world=True)
    np.testing.assert_allclose(undone.frames[0].to_world, turned(7), atol=1e-12)


@pytest.mark.parametrize("original", [False, True])
def test_a_mesh_of_the_normalised_world_is_moved_back(tmp_path, original):
    """x' = scale (transform x), with x before ``applied_transform``, as in nerfstudio's source."""
    applied, transform, scale = turned(94), turned(55), 0.23
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.vertices = ball.vertices * [1, 0.8, 0.6] + [0.1, 0, 0.2]
    points, frames = np.array(ball.vertices), []
    for angle in (0.0, 2.0, 4.0):
        z = np.array([np.cos(angle), 0, np.sin(angle)])
        pose = affine(np.stack([np.cross([0, 1, 0], z), [0, 1, 0], z], axis=1), 4.5 * z)
        frames.append({**GOOD, "file_path": "0.exr", "transform_matrix": (applied @ pose).tolist()})
    write_exr(tmp_path / "0.exr", {"RGB": np.full((6, 8, 3), 0.5)})
    (tmp_path / "transforms.json").write_text(
        json.dumps({"applied_transform": applied[:3].tolist(), "frames": frames})
    )
    ball.vertices = scale * (points @ transform[:3, :3].T + transform[:3, 3])
    (tmp_path / "exports").mkdir()
    ball.export(tmp_path / "exports/scan.ply")
    record = {"transform": transform[:3].tolist(), "scale": scale}
    (tmp_path / "exports/dataparser_transforms.json").write_text(json.dumps(record))
    source = read_transforms(tmp_path / "transforms.json", original_world=original)
    options = ImportOptions(mesh=tmp_path / "exports/scan.ply")
    notes = import_capture(source, tmp_path / "capture", options)
    assert sum("(scale 4.35). If it was there already, remove this file." in n for n in notes) == 1
    wanted = points if original else points @ applied[:3, :3].T + applied[:3, 3]
    moved = read_ply(tmp_path / "capture/mesh.ply")
    distance = np.linalg.norm(moved.positions[:, None] - wanted, axis=2).min(axis=0)
    np.testing.assert_allclose(distance, 0, atol=1e-5)
    cross, away = moved.crosses, moved.positions[moved.faces[:, 0]] - wanted.mean(axis=0)
    assert ((cross * away).sum(axis=1) > 0).all()

    ball.vertices = wanted  # exported with --save-world-frame
    ball.export(tmp_path / "exports/scan.ply")
    notes = import_capture(source, tmp_path / "again", options)
    assert any("not used, as the mesh is in the world of the poses without" in n for n in notes)
    kept = read_ply(tmp_path / "again/mesh.ply").positions
    np.testing.assert_allclose(
        [kept.min(0), kept.max(0)], [wanted.min(0), wanted.max(0)], atol=1e-5
    )


def test_a_scale_that_nerfstudio_applied(tmp_path):
    """``scale`` of dataparser_transforms.json contains it; --original-world cannot undo it."""
    path = tmp_path / "t.json"
    path.write_text(json.dumps({"applied_scale": 5.0, "frames": [GOOD]}))
    source = read_transforms(path)
    assert "applied_transform or applied_scale" in source.notes[0]
    (tmp_path / "d.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 2}))
    matrix = read_normalisation(tmp_path / "d.json", source.applied)
    np.testing.assert_allclose(matrix, np.diag([2.5, 2.5, 2.5, 1]))
    with pytest.raises(OptionError, match="an applied_scale of 5, which --original-world does not"):
        read_transforms(path, original_world=True)
    for bad in (0, -1, "wide", [], float("nan")):
        path.write_text(json.dumps({"applied_scale": bad, "frames": [GOOD]}))
        with pytest.raises(CaptureError, match="t.json: no poses: applied_scale must be a number"):
            read_transforms(path)


@pytest.mark.parametrize("change", [
    {"scale": 0}, {"scale": "x"}, {"transform": [[1, 0], [0, 1]]}, {"scale": float("inf")},
    {"transform": np.diag([1.0, 2, 1])[:, [0, 1, 2, 2]].tolist()}, {"transform": None},
])  # fmt: skip
def test_a_damaged_normalisation_is_named(tmp_path, change):
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 1, **change}))
    with pytest.raises(CaptureError, match=r"dataparser_transforms.json: .*; copy it again, or"):
        read_normalisation(path, AppliedWorld(np.eye(4)))


def test_a_scale_in_a_pose_is_dropped_and_a_mirror_refused(tmp_path):
    scaled = turned(31) @ np.diag([2.5, 2.5, 2.5, 1])
    np.testing.assert_allclose(frame(tmp_path, 1, to_world=scaled).to_world, turned(31), atol=1e-12)
    with pytest.raises(CaptureError, match="mirrored"):
        frame(tmp_path, 1, to_world=turned(31) @ np.diag([1, 1, -1, 1]))
    with pytest.raises(CaptureError, match="shear"):
        frame(tmp_path, 1, to_world=turned(31) @ np.diag([1, 2, 1, 1]))


def test_pixels_that_are_not_square_make_no_sensor(tmp_path):
    with pytest.raises(CaptureError, match="not square"):
        frame(tmp_path, 2).sensor()
