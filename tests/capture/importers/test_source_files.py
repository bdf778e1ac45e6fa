"""Names in files of other tools: accepted and refused paths."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from svu_mi.capture.importers.nerf import read_transforms
from svu_mi.capture.importers.registry import ReadOptions, read_source
from svu_mi.capture.importers.source import Frame
from svu_mi.capture.importers.source_files import find_file, safe_path
from svu_mi.errors import CaptureError

GOOD = {
    "a.png": "a.png", "./a/b.png": "a/b.png", "a/../b.png": "b.png", "a\\b.png": "a/b.png",
    "..a": "..a", "ü ß.png": "ü ß.png", 1021 * "x/" + "b": 1021 * "x/" + "b",
}  # fmt: skip
OUTSIDE = ["../a", "..", "a/../../b", "a\\..\\..\\b", "/a", "//a/b", "\\a", "C:\\a", "C:a"]
NO_NAME = [
    "", ".", "a/..", "a\0b", "a\nb", "\x1b[31m", "\x7f", "\ud800", "x" * 300, "a/" * 1021 + "bb",
    None, 3, ["a"],
]  # fmt: skip


@pytest.mark.parametrize("name", GOOD, ids=range(len(GOOD)))
def test_a_file_inside(name):
    assert safe_path(Path("root"), name, "frame 3") == Path("root", GOOD[name])


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_file_outside(name):
    with pytest.raises(CaptureError, match="frame 3: .* lies outside root; move"):
        safe_path(Path("root"), name, "frame 3")


@pytest.mark.parametrize("name", NO_NAME, ids=range(len(NO_NAME)))
def test_no_name_at_all(name):
    with pytest.raises(CaptureError, match="frame 3: .*name") as error:
        safe_path(Path("root"), name, "frame 3")
    assert len(str(error.value)) < 120 and str(error.value).isascii()


FOUND = {  # file below the folder, and names that other programs write for it
    "photos/a.png": [
        "/home/me/scan/photos/a.png", "C:\\scan\\photos\\a.png", "../photos/a.png",
        "a/../photos/a.png", "/elsewhere/a.png", "D:a.png", "Photos/A.PNG",
    ],
    "b\u00fc.png": ["bu\u0308.png", "BU\u0308.png", "//server/share/b\u00fc.png"],
}  # fmt: skip


@pytest.mark.parametrize(
    ("file", "name"), [(file, name) for file, names in FOUND.items() for name in names]
)
def test_names_of_other_programs(tmp_path, file, name):
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).touch()
    (tmp_path / "secret").mkdir()
    assert find_file(tmp_path, name, "frame 3") == tmp_path / file


def test_names_inside_are_resolved_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in (f"{tmp_path}/root/a.png", "../root/a.png", "x/../a.png"):
        assert safe_path(Path("root"), name, "frame 3") == Path("root/a.png")
    for name in (f"{tmp_path}/roots/a.png", f"{tmp_path}/root/../a.png"):
        with pytest.raises(CaptureError, match="lies outside root"):
            safe_path(Path("root"), name, "frame 3")


@pytest.mark.parametrize("names", [["x/c.png", "X/c.png"], ["C.png", "c.PNG"]])
def test_several_candidates_are_no_choice(tmp_path, names):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(CaptureError, match="lies outside"):
        find_file(tmp_path, "/home/me/c.png", "frame 3")
    assert not find_file(tmp_path, "c.png", "frame 3").exists()


def test_folder_is_listed_once_for_many_names(tmp_path, monkeypatch):
    listed, iterdir = [], Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda path: listed.append(path) or iterdir(path))
    for k in range(20):
        (tmp_path / f"img_{k}.jpg").touch()
    for k in range(20):
        assert find_file(tmp_path, f"IMG_{k}.JPG", "a").name == f"img_{k}.jpg"
    assert listed == [tmp_path]
    (tmp_path / "later.jpg").touch()
    os.utime(tmp_path, ns=(1, 1))
    assert find_file(tmp_path, "Later.jpg", "a").name == "later.jpg"


def test_links_and_files_elsewhere_are_not_followed_by_name(tmp_path):
    (tmp_path / "root").mkdir()
    (tmp_path / "secret.png").touch()
    with pytest.raises(CaptureError, match="lies outside"):
        find_file(tmp_path / "root", str(tmp_path / "secret.png"), "frame 3")


def write_poses(folder: Path, names: list[str]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    record = {"w": 4, "h": 2, "fl_x": 3.0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(record))
    return folder / "transforms.json"


def put(*files: Path) -> None:
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()


def test_poses_with_paths_of_another_machine(tmp_path):
    put(tmp_path / "images/0.png", tmp_path / "images/1.png")
    file = write_poses(tmp_path, ["/home/me/images/0.png", "images/1.png"])
    source = read_transforms(file)
    assert [f.image for f in source.frames] == [tmp_path / f"images/{k}.png" for k in (0, 1)]
    (note,) = source.notes
    assert note == (
        f"{file}: 1 of 2 files are not at the given paths, first '/home/me/images/0.png'; "
        "images/0.png is used."
    )
    assert read_transforms(write_poses(tmp_path, [f"{tmp_path}/images/0.png"])).notes == ()
    with pytest.raises(CaptureError, match="'/a/0.png' and '/b/0.png' would both be"):
        read_transforms(write_poses(tmp_path, ["/a/0.png", "/b/0.png"]))


def test_folders_of_photographs_and_masks_for_transforms(tmp_path):
    put(tmp_path / "new/0.png", tmp_path / "masks/0.jpg", tmp_path / "new/x/1.JPG")
    poses = write_poses(tmp_path / "poses", ["C:\\scan\\0.png", "../x/1"])
    options = ReadOptions(images=tmp_path / "new", masks=tmp_path / "masks")
    first, second = read_source(poses, options).frames
    assert (first.image, first.mask) == (tmp_path / "new/0.png", tmp_path / "masks/0.jpg")
    assert (second.image, second.mask) == (tmp_path / "new/x/1.JPG", None)
    with pytest.raises(CaptureError, match="lies outside"):
        read_source(poses)


def frame(to_world: np.ndarray) -> Frame:
    size = {"focal": (9.0, 9.0), "center": (4.0, 3.0), "size": (8, 6)}
    return Frame(label="frame 0", image=Path("0.png"), to_world=to_world, **size)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 5e29])
def test_scale_of_a_pose_is_removed(scale):
    turn = np.diag([0.0, 0, 0, 1])
    turn[:3, :3] = scale * np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    expected = [[0.6, -0.8, 0, 0], [0.8, 0.6, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(frame(turn).to_world, expected, atol=1e-12)


POSES = {
    "too large": (np.diag([2e30, 2e30, 2e30, 1]), "not a finite 4 x 4 matrix"),
    "far": (np.eye(4) + 2e9 * np.eye(4, k=3), "2e[+]09 units away from the origin, farther than"),
    "NaN": (np.full((4, 4), np.nan), "not a finite 4 x 4 matrix"),
    "three rows": (np.eye(4)[:3], "not a finite 4 x 4 matrix"),
    "transposed": (np.eye(4) + np.eye(4, k=-3), "the last row of the pose must be 0 0 0 1"),
    "mirrored": (np.diag([-1.0, 1, 1, 1]), "the pose is mirrored"),
    "sheared": (np.eye(4) + np.eye(4, k=1) * [0, 1, 0, 0], "not a rigid transform"),
    "flat": (np.diag([0.0, 0, 0, 1]), "not a rigid transform"),
}  # fmt: skip


@pytest.mark.parametrize("case", POSES)
def test_a_pose_that_is_none_is_refused(case):
    matrix, says = POSES[case]
    with pytest.raises(CaptureError, match=f"^frame 0: .*{says}"):
        frame(matrix)
