"""Each row of the table of fields in notebooks/capture.md holds: the field is changed in a file."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from PIL import Image

from svu_mi.capture.importers.registry import read_source
from svu_mi.errors import SvuError

EYE = np.eye(4)
TURNED = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
MIRRORED, SHEARED = np.diag([1.0, 1, -1, 1]), EYE + np.eye(4, k=1) * [[1], [0], [0], [0]]
FRAME = {"file_path": "images/0.png", "transform_matrix": EYE.tolist()}
LENS = {"w": 8, "h": 6, "fl_x": 9.0}


def matrix(value):
    return {"transform_matrix": np.asarray(value).tolist()}


def transforms(folder, change):
    (folder / "transforms.json").write_text(json.dumps({**LENS, "frames": [{**FRAME, **change}]}))


def top(**change):
    return lambda folder: (folder / "transforms.json").write_text(
        json.dumps({**LENS, **change, "frames": [FRAME, {**FRAME, "file_path": "images/1.png"}]})
    )


def colmap(camera="PINHOLE 8 6 9 9 4 3", pose="1 0 0 0 0 0 4", name="0.png", extra=""):
    def write(folder):
        (folder / "cameras.txt").write_text(f"1 {camera}\n")
        (folder / "images.txt").write_text(f"1 {pose} 1 {name}\n\n")
        if extra:
            (folder / extra).write_text("1 1 0\n")

    return write


def llff(column=None, value=0.0):
    def write(folder):
        row = np.array([0, 1, 0, 1, 6, -1, 0, 0, 2, 8, 0, 0, 1, 3, 9, 1, 9], float)
        if column is not None:
            row[column] = value
        np.save(folder / "poses_bounds.npy", np.stack([row, row]))

    return write


def idr(**change):
    world = np.array([[9.0, 0, 4, 1], [0, 9, 3, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    arrays = {"world_mat": world, **change}
    return lambda folder: np.savez(
        folder / "cameras.npz", **{f"{name}_{k}": arrays[name] for name in arrays for k in (0, 1)}
    )


def sfm(view=(), camera=(), pose=(), version="1 2 6", **top):
    intrinsic = {"intrinsicId": "1", "width": "8", "height": "6", "focalLength": "36",
                 "principalPoint": ["0", "0"], "type": "pinhole", **dict(camera)}  # fmt: skip
    place = {"rotation": [*"100010001"], "center": [*"123"], **dict(pose)}
    record = {
        "version": version.split(), **top, "intrinsics": [intrinsic],
        "views": [{"poseId": "1", "intrinsicId": "1", "path": "images/0.png", **dict(view)}],
        "poses": [{"poseId": "1", "pose": {"transform": place, "locked": "0"}}],
    }  # fmt: skip
    return lambda folder: (folder / "cameras.sfm").write_text(json.dumps(record))


PLAIN = {"transforms.json": top(), "COLMAP": colmap(), "LLFF": llff(), "IDR, NeuS": idr(),
         "AliceVision": sfm()}  # fmt: skip
SPLIT = {"train_filenames": ["images/1.png"]}
CASES = {
    "transforms.json": {
        "transform_matrix": [matrix(TURNED)], "scaled matrix": [matrix(2 * EYE[:3])],
        "mirrored or sheared matrix": [matrix(MIRRORED), matrix(SHEARED)],
        "w, h": [top(w=16), top(h=16)], "fl_x, fl_y": [top(fl_x=5), top(fl_y=5)],
        "cx, cy": [top(cx=5), top(cy=5)], "camera_angle_y": [top(camera_angle_y=0.3)],
        "k1, k2, k3, k4, p1, p2": [top(**{k: 0.01}) for k in ("k1", "k2", "k3", "k4", "p1", "p2")],
        "distortion_params": [top(distortion_params=[0.1, 0, 0, 0, 0, 0])],
        "k5, k6": [top(k5=0.1), top(k6=0.1)],
        "camera_model": [top(camera_model="OPENCV_FISHEYE"), top(camera_model="EQUIRECTANGULAR")],
        "is_fisheye, latlong, ortho, ftheta_p0": [
            top(is_fisheye=True), top(latlong=True), top(ortho=True), top(ftheta_p0=1.0)],
        "from_mitsuba, rolling_shutter": [top(from_mitsuba=True), top(rolling_shutter=[0, 1, 0])],
        "file_path, mask_path": [{"file_path": "images/1.png"}, {"mask_path": "images/1.png"}],
        "exposure": [{"exposure": 2.0}], "train_filenames": [top(**SPLIT)],
        "applied_transform, applied_scale": [
            top(applied_transform=TURNED[:3].tolist()), top(applied_scale=2.0)],
        "aabb_scale, scale, offset": [top(aabb_scale=4, scale=0.5, offset=[1, 0, 0])],
        "depth_file_path, ply_file_path, sharpness, colmap_im_id, timestamp": [
            top(ply_file_path="a.ply"), top(sharpness=9.0, colmap_im_id=3, timestamp=1)],
    },
    "COLMAP": {
        "PARAMS": [colmap("PINHOLE 8 6 8 9 4 3"), colmap("RADIAL 8 6 9 4 3 .1 0")],
        "MODEL": [colmap("OPENCV_FISHEYE 8 6 9 9 4 3 .1 0 0 0"), colmap("WIDE 8 6 9 9 4 3")],
        "QW QX QY QZ, TX TY TZ": [colmap(pose="0 1 0 0 0 0 4"), colmap(pose="1 0 0 0 1 0 4")],
        "quaternion that is not of unit length": [colmap(pose="2 0 0 0 0 0 4")],
        "NAME": [colmap(name="1.png")], "rigs, frames": [colmap(extra="rigs.txt")],
    },
    "LLFF": {
        "rotation, position": [llff(3, 5.0)], "height, width, focal": [llff(14, 12.0)],
        "mirrored matrix": [llff(12, -1.0)], "near, far": [llff(15, 5.0)],
    },
    "IDR, NeuS": {
        "world_mat": [idr(world_mat=np.diag([9.0, 8, 1, 1]))],
        "mirrored or skewed world_mat": [
            idr(world_mat=np.diag([9.0, 9, -1, 1])),
            idr(world_mat=np.diag([9.0, 9, 1, 1]) + SHEARED)],
        "scale_mat": [idr(scale_mat=2 * EYE - np.diag([0, 0, 0, 1.0]))],
        "world_mat_inv, camera_mat": [idr(world_mat_inv=EYE, camera_mat=EYE)],
    },
    "AliceVision": {
        "rotation, center": [
            sfm(pose={"center": [*"129"]}), sfm(pose={"rotation": [*"010001100"]})],
        "focalLength, sensorWidth, pixelRatio": [
            sfm(camera={"focalLength": "30"}), sfm(camera={"sensorWidth": "30"}),
            sfm(camera={"pixelRatio": "2"})],
        "principalPoint": [sfm(camera={"principalPoint": ["1", "0"]})],
        "version": [sfm(version="1 2 4", camera={"pixelRatio": ".5"})],
        "distortionType, distortionParams": [
            sfm(camera={"distortionType": "radialk1", "distortionParams": [".1"]})],
        "other distortionType, undistortionType": [
            sfm(camera={"distortionType": "fisheye4"}),
            sfm(camera={"undistortionType": "3deradial4"})],
        "path": [sfm(view={"path": "images/1.png"})],
        "isPoseIndependant": [sfm(view={"isPoseIndependant": "0"})],
        "sensorHeight, initialFocalLength, serialNumber, locked, metadata, structure": [
            sfm(camera={"sensorHeight": "9", "initialFocalLength": "-1", "serialNumber": "3"},
                view={"metadata": {"Make": "a"}}, structure="")],
    },
}  # fmt: skip
ROWS = [(kind, field) for kind, fields in CASES.items() for field in fields]


def table(root):
    """Return what the page says: format and field to followed, refused, reported or harmless."""
    text = (root / "notebooks" / "capture.md").read_text().split("## Fields of poses")[1]
    rows = re.findall(r"^\| (\S.*?) \| (.*?) \| (followed|refused|reported|harmless)\b", text, re.M)
    return {(kind, field.replace("`", "")): what for kind, field, what in rows}


def outcome(folder, write):
    """Return the frames and notes of a file with two photographs."""
    for name in ("images", "image"):
        (folder / name).mkdir(parents=True)
        for k in range(2):
            Image.new("RGB", (8, 6)).save(folder / name / f"{k}.png")
    write(folder) if callable(write) else transforms(folder, write)
    source = read_source(folder)
    frames = [
        (str(f.image.relative_to(folder)), f.mask and f.mask.name, f.to_world.round(6).tolist(),
         f.focal, f.center, f.size, f.exposure, f.lens)
        for f in source.frames
    ]  # fmt: skip
    return frames, len(source.notes)


def test_table_lists_the_cases(root):
    assert sorted(table(root)) == sorted(ROWS)


@pytest.mark.parametrize(("kind", "field"), ROWS)
def test_field_has_the_effect_of_the_table(root, tmp_path, kind, field):
    what = table(root)[kind, field]
    for number, write in enumerate(CASES[kind][field]):
        plain = PLAIN[kind] if callable(write) else {}
        frames, notes = outcome(tmp_path / f"plain{number}", plain)
        if what == "refused":
            with pytest.raises(SvuError):
                outcome(tmp_path / f"{number}", write)
            continue
        changed, changed_notes = outcome(tmp_path / f"{number}", write)
        assert (changed != frames) == (what == "followed"), number
        assert (changed_notes > notes) == (what == "reported" or field == "train_filenames"), number
