"""Meshroom's cameras.sfm against a construction from angles, in pixels of projected points."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.helpers import projected

from svu_mi.capture.importers.lens_distortion import Lens
from svu_mi.capture.importers.registry import ReadOptions, read_source
from svu_mi.errors import CaptureError

WIDTH, HEIGHT, FOCAL, CENTER = 40, 30, (50.0, 50.0), (22.0, 13.0)
POINTS = np.random.default_rng(60317).uniform(-0.4, 0.4, (5, 3))
OLD = {"pxFocalLength": "50", "principalPoint": ["22", "13"]}
BOTH = {"pxFocalLength": ["50", "50"], "principalPoint": ["22", "13"]}
# 45 mm / 36 mm * 40 pixels = 50 pixels; 22 = 20 + 2, 13 = 15 - 2.
NEW = {"focalLength": "45", "sensorWidth": "36", "principalPoint": ["2", "-2"]}


def rotated(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a rotation world to camera (+Y down) that looks at the origin, and the position."""
    position = np.array([3 * np.sin(angle), 0.5, -3 * np.cos(angle)])
    forward = -position / np.linalg.norm(position)
    right = np.cross([0.0, 1, 0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward]), position


def record(version: str, intrinsic: dict, angles=(0.3, 2.0), folder="/home/anna/scan", **view: str):
    """Return a file as AliceVision writes it: numbers as text, empty lists as empty text."""
    poses, views = [], []
    for k, angle in enumerate(angles):
        rotation, position = rotated(angle)
        pose = {"rotation": [str(float(v)) for v in rotation.ravel(order="F")],
                "center": [str(float(v)) for v in position]}  # fmt: skip
        poses.append({"poseId": str(90 + k), "pose": {"transform": pose, "locked": "0"}})
        views.append({"viewId": str(7 + k), "poseId": str(90 + k), "intrinsicId": "4027310957",
                      "path": f"{folder}/{k}.jpg", "metadata": "", **view})  # fmt: skip
    camera = {"intrinsicId": "4027310957", "width": str(WIDTH), "height": str(HEIGHT),
              "serialNumber": "", "type": "pinhole", "distortionParams": "",
              **intrinsic}  # fmt: skip
    return {"version": version.split("."), "views": views, "intrinsics": [camera], "poses": poses}


def written(root, *arguments, name="cameras.sfm", **options):
    (root / name).write_text(json.dumps(record(*arguments, **options), indent=4))
    (root / "images").mkdir(exist_ok=True)
    for k in range(2):
        (root / "images" / f"{k}.jpg").touch()
    return root / name


@pytest.mark.parametrize(
    ("version", "intrinsic", "focal"),
    [
        ("1.0.0", OLD, FOCAL),
        ("1.2.0", BOTH, FOCAL),
        ("1.2.1", {**BOTH, "principalPoint": ["2", "-2"]}, FOCAL),
        ("1.2.2", {**NEW, "pixelRatio": "0.5"}, (50.0, 100.0)),
        ("1.2.6", {**NEW, "pixelRatio": "0.5"}, (50.0, 25.0)),
        ("1.2.14", {**NEW, "pixelRatio": "1"}, FOCAL),
    ],
)
def test_points_are_projected_as_by_the_formula(tmp_path, version, intrinsic, focal):
    """A pixel is focal (R (X - C))_xy / (R (X - C))_z + center, with +Y down."""
    source = read_source(written(tmp_path, version, intrinsic))
    assert source.format == "alicevision" and "--fix mesh-x180" in source.notes[0]
    for k, (frame, angle) in enumerate(zip(source.frames, (0.3, 2.0), strict=True)):
        rotation, position = rotated(angle)
        seen = (POINTS - position) @ rotation.T
        wanted = seen[:, :2] / seen[:, 2:] * focal + CENTER
        assert frame.focal == pytest.approx(focal) and frame.center == pytest.approx(CENTER)
        assert frame.size == (WIDTH, HEIGHT) and frame.image == tmp_path / "images" / f"{k}.jpg"
        np.testing.assert_allclose(projected(frame, POINTS), wanted, atol=1e-4)


@pytest.mark.parametrize(
    ("intrinsic", "lens"),
    [
        ({"type": "radial1", "distortionParams": ["0.1"]}, Lens(k1=0.1)),
        ({"type": "radial3", "distortionParams": ["0.1", "0.05", "-0.01"]}, Lens(0.1, 0.05, -0.01)),
        ({"distortionType": "radialk3", "distortionParams": ["0.1", "0", "0"]}, Lens(k1=0.1)),
        ({"type": "brown", "distortionParams": ["0.1", "0", "0", "0.02", "0.03"]},
         Lens(k1=0.1, p1=0.02, p2=0.03)),
        ({"type": "radial3", "distortionParams": ["0", "0", "0"]}, None),
        ({"distortionType": "none"}, None),
    ],
)  # fmt: skip
def test_distortions_are_read(tmp_path, intrinsic, lens):
    assert read_source(written(tmp_path, "1.2.6", {**NEW, **intrinsic})).frames[0].lens == lens


REFUSED = {
    "fisheye": (
        "1.2.0",
        {**BOTH, "type": "fisheye4"},
        {},
        "model fisheye4 is not read; .*Colmap",
    ),
    "equidistant": (
        "1.2.6",
        {**NEW, "type": "equidistant", "distortionType": "radialk3"},
        {},
        "lens model equidistant",
    ),
    "normalised": ("1.2.6", {**NEW, "distortionType": "radialk3pt"}, {}, "model radialk3pt"),
    "anamorphic": ("1.2.14", {**NEW, "pixelRatio": "2"}, {}, "aspect ratio 2"),
    "undistortion": ("1.2.6", {**NEW, "undistortionType": "3declassicld"}, {}, "lens model"),
    "coefficients": ("1.2.0", {**BOTH, "type": "radial3", "distortionParams": ["1"]}, {}, "has 3"),
    "rig": ("1.2.6", NEW, {"isPoseIndependant": "0"}, "part of a rig"),
    "words": ("1.2.6", {**NEW, "focalLength": "long"}, {}, "focalLength must be a number"),
    "nan": ("1.2.6", {**NEW, "focalLength": "nan"}, {}, "focalLength must be a number .* nan"),
    "no length": ("1.2.6", {"principalPoint": ["0", "0"]}, {}, "focalLength is missing"),
    "no pose": ("1.2.6", NEW, {"poseId": "5"}, "no view has a pose"),
    "outside": ("1.2.6", NEW, {"path": "a/../../b.jpg"}, "outside|not a valid"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_other_cameras_are_refused_by_name(tmp_path, case):
    version, intrinsic, view, sentence = REFUSED[case]
    with pytest.raises(CaptureError, match=sentence) as error:
        read_source(written(tmp_path, version, intrinsic, **view))
    assert str(tmp_path) in str(error.value)


def test_views_without_poses_are_left_out(tmp_path):
    file = written(tmp_path, "1.2.6", NEW)
    changed = json.loads(file.read_text())
    changed["views"][0].pop("poseId")
    file.write_text(json.dumps(changed))
    source = read_source(tmp_path)
    assert [frame.image.name for frame in source.frames] == ["1.jpg"]
    assert source.notes[1] == f"{file}: 1 of 2 views have no pose and are left out."


@pytest.mark.parametrize("folder", ["D:\\scan\\images", "/images", "elsewhere", "images"])
def test_photographs_are_found_by_the_end_of_their_path(tmp_path, folder):
    file = written(tmp_path, "1.2.6", NEW, folder=folder, name="sfm.json")
    source = read_source(tmp_path)
    assert source.frames[0].image == tmp_path / "images" / "0.jpg"
    assert "2 of 2 files are not at the given paths" in source.notes[-1]
    (tmp_path / "images").rename(tmp_path / "moved")
    assert read_source(file, ReadOptions(images=tmp_path / "moved")).frames[0].image.is_file()


@pytest.mark.parametrize("text", ['{"version":["1","2","6"],"views":[],"poses":[]}',
                                  '{"version":["1","2","6"],"views":""}'])  # fmt: skip
def test_file_without_cameras(tmp_path, text):
    (tmp_path / "cameras.sfm").write_text(text)
    with pytest.raises(CaptureError, match=r"cameras\.sfm: no view has a pose .* Meshroom"):
        read_source(tmp_path)


def test_transforms_beside_a_file_of_meshroom_are_read(tmp_path):
    """Who has converted the poses has them in transforms.json."""
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    shared = {"fl_x": 50, "fl_y": 50, "cx": 8, "cy": 6, "w": 16, "h": 12}
    (tmp_path / "transforms.json").write_text(json.dumps({**shared, "frames": [frame]}))
    (tmp_path / "cameras.sfm").write_text(json.dumps({"version": ["1", "2", "6"], "views": []}))
    (tmp_path / "a.png").write_bytes(b"not read")
    assert read_source(tmp_path).format == "transforms"
