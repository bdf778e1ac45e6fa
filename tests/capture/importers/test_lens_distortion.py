"""Lens distortion: agreement with COLMAP and OpenCV, and undistortion of photographs.

pycolmap runs in a separate process, see test_colmap.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracle import lens as oracle
from PIL import Image

from svu_mi.capture.image_io import srgb
from svu_mi.capture.importers.convert_photographs import convert_photograph
from svu_mi.capture.importers.lens_distortion import Lens
from svu_mi.capture.importers.nerf import read_transforms, write_transforms
from svu_mi.capture.importers.resampling import (
    square_pixel_frame,
    undistort_planes,
    undistorted_frame,
)
from svu_mi.capture.importers.source import Frame
from svu_mi.capture.photographs import UNUSABLE
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import CaptureError
from svu_mi.guidance.candidates import Candidates

# A phone, a wide angle with pincushion borders, a decentred lens, and one of nerfstudio.
LENSES = {
    "telephone": {"k1": 0.0578, "k2": -0.0796, "p1": -0.0009, "p2": 0.0008},
    "barrel": {"k1": -0.28, "k2": 0.07, "k3": -0.008},
    "tilted": {"k1": 0.02, "p1": 0.013, "p2": -0.021},
    "nerfstudio": {"k1": -0.1, "k2": 0.05, "k3": -0.01, "k4": 0.004, "p1": 1e-3, "p2": -2e-3},
}
WIDTH, HEIGHT, FOCAL, CENTER = 180, 120, (150.0, 140.0), (93.5, 57.25)
PIXEL = 1e-6  # the bar
# Converts directions and pixels with COLMAP's camera of the same coefficients.
PYCOLMAP = """
import json, sys
import numpy as np
import pycolmap
cameras = json.loads(sys.argv[1])
points = np.array(json.loads(sys.argv[2]))
pairs = []
for parameters in cameras:
    camera = pycolmap.Camera(model="FULL_OPENCV", width=180, height=120, params=parameters)
    pixels = camera.img_from_cam(np.c_[points, np.ones(len(points))])
    pairs.append([np.asarray(pixels).tolist(), np.asarray(camera.cam_from_img(pixels)).tolist()])
print(json.dumps(pairs))
"""


def frame_of(lens: Lens | None, image: Path = Path("a.exr"), **fields: object) -> Frame:
    return Frame(**{
        "label": "t.json: frame 0", "image": image, "to_world": np.eye(4), "focal": FOCAL,
        "center": CENTER, "size": (WIDTH, HEIGHT), "lens": lens, **fields,
    })  # fmt: skip


def points() -> np.ndarray:
    """Directions that cover the photograph."""
    x, y = np.meshgrid(np.linspace(-0.55, 0.55, 12), np.linspace(-0.4, 0.4, 9))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def test_pixels_are_those_of_colmaps_camera():
    known = [name for name, numbers in LENSES.items() if "k4" not in numbers]  # not in COLMAP
    cameras = []
    for name in known:
        k1, k2, k3, _, p1, p2 = Lens(**LENSES[name]).record.values()
        cameras.append([*FOCAL, *CENTER, k1, k2, p1, p2, k3, 0, 0, 0])
    words = [json.dumps(cameras), json.dumps(points().tolist())]
    done = subprocess.run(
        [sys.executable, "-c", PYCOLMAP, *words], check=True, capture_output=True, text=True
    )
    for name, (pixels, back) in zip(known, json.loads(done.stdout), strict=True):
        lens = Lens(**LENSES[name])
        np.testing.assert_allclose(lens.distort(points()) * FOCAL + CENTER, pixels, atol=PIXEL)
        straight = lens.undistort((np.array(pixels) - CENTER) / FOCAL)
        np.testing.assert_allclose(straight * FOCAL, np.array(back) * FOCAL, atol=PIXEL)


@pytest.mark.parametrize("name", LENSES)
def test_the_model_is_that_of_the_books_and_its_inverse(name):
    lens = Lens(**LENSES[name])
    wanted = oracle.distort(*points().T, lens.record).T
    np.testing.assert_allclose(lens.distort(points()), wanted, atol=1e-14)
    np.testing.assert_allclose(lens.undistort(wanted), points(), atol=1e-11)
    np.testing.assert_allclose(oracle.straight(*wanted.T, lens.record).T, points(), atol=1e-11)


def photograph(lens: Lens, field: float = 24.0) -> np.ndarray:
    """Chequers of ``size`` pixels through a lens, (HEIGHT, WIDTH)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    seen = (x - CENTER[0]) / FOCAL[0], (y - CENTER[1]) / FOCAL[1]
    u, v = oracle.straight(*seen, lens.record)
    return oracle.chequers(u * FOCAL[0] + CENTER[0], v * FOCAL[1] + CENTER[1], field)


def chequers_of(frame: Frame, field: float = 24.0) -> np.ndarray:
    """The chequers through a camera without distortion."""
    y, x = np.mgrid[: frame.size[1], : frame.size[0]] + 0.5
    u, v = x - frame.center[0] + CENTER[0], y - frame.center[1] + CENTER[1]
    return oracle.chequers(u, v, field)


@pytest.mark.parametrize("name", LENSES)
def test_chequers_become_straight_again(name):
    """The error of bilinear interpolation is at most 2 max |f''| / 8, times the shrinkage."""
    lens = Lens(**LENSES[name])
    (plane,) = undistort_planes([photograph(lens)], frame_of(lens))
    straight = undistorted_frame(frame_of(lens))
    assert plane.shape == straight.size[::-1] and plane.dtype == np.float32
    off = np.abs(plane - chequers_of(straight))
    bound = 2 * 0.5 * (np.pi / 24) ** 2 / 8
    assert off[1:-1, 1:-1].max() < 2.5 * bound and off.mean() < bound / 2
    as_it_was = np.abs(photograph(lens) - chequers_of(frame_of(None)))
    assert as_it_was.mean() > 5 * off.mean()


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_photograph_is_largest_without_borders(name):
    lens = Lens(**LENSES[name])
    made = undistorted_frame(frame_of(lens))
    assert made.lens is None and made.focal == FOCAL
    corners = np.array([(x, y) for x in (0, made.size[0]) for y in (0, made.size[1])], float)
    edges = np.linspace(corners[:-1], corners[1:], 50).reshape(-1, 2)  # around, and a diagonal
    seen = lens.distort((edges - made.center) / made.focal) * FOCAL + CENTER
    assert seen.min() > -0.01 and (seen < np.array([WIDTH, HEIGHT]) + 0.01).all()
    for wider in ((1.5, 0), (0, 1.5)):  # a border would be empty
        low, high = -np.array(wider), np.array(made.size) + wider
        edges = np.concatenate([
            np.stack([np.full(99, x), np.linspace(low[1], high[1], 99)], axis=-1)
            for x in (low[0], high[0])
        ] + [
            np.stack([np.linspace(low[0], high[0], 99), np.full(99, y)], axis=-1)
            for y in (low[1], high[1])
        ])  # fmt: skip
        seen = lens.distort((edges - made.center) / made.focal) * FOCAL + CENTER
        assert (seen < 0).any() or (seen > [WIDTH, HEIGHT]).any()


def test_a_straight_photograph_is_at_most_twice_as_wide():
    """Borders that shrink by more than two would only add blur."""
    center, focal = (WIDTH / 2, HEIGHT / 2), (WIDTH / 2 / 0.46,) * 2
    made = undistorted_frame(frame_of(Lens(**{"k1": -1, "k2": 0.46}), focal=focal, center=center))
    assert made.size[0] == 2 * WIDTH and HEIGHT < made.size[1] < 2 * HEIGHT
    assert made.center[0] == pytest.approx(WIDTH)


@pytest.mark.parametrize("numbers", [{"k1": -0.9}, {"k1": 40.0, "k2": -3e3}, {"p1": 1.0, "p2": -2},
                                     {"k4": 1e300}, {"k3": -1e30}])  # fmt: skip
def test_a_lens_that_folds_over_is_refused(numbers):
    with pytest.raises(CaptureError, match=r"t.json: frame 0: the lens \(.*\) folds over inside"):
        undistorted_frame(frame_of(Lens(**numbers)))


def test_lens_valid_only_in_the_middle_is_refused_but_croppable():
    """Real action cameras fold over in the corners; the message suggests a crop."""
    lens = Lens(**{"k1": -0.26, "k2": 0.09, "k3": -0.015})
    focal = (0.4 * WIDTH, 0.4 * WIDTH)
    sentence = re.escape(
        "the lens (k1 -0.26, k2 0.09, k3 -0.015) folds over inside the photograph, so its "
        "coefficients are not valid up to the corners; correct them, crop the photographs, or "
        "undistort them with the camera's program."
    )
    with pytest.raises(CaptureError, match=sentence):
        undistorted_frame(frame_of(lens, focal=focal))
    size = (WIDTH // 2, HEIGHT // 2)
    cropped = replace(frame_of(lens, focal=focal), size=size, center=(size[0] / 2, size[1] / 2))
    assert undistorted_frame(cropped).size >= size


def test_photographs_are_undistorted_in_linear_radiance(tmp_path):
    lens = Lens(**LENSES["barrel"])
    ramp = np.broadcast_to(np.linspace(0, 8, WIDTH, dtype=np.float32), (HEIGHT, WIDTH)).copy()
    write_exr(tmp_path / "a.exr", {"RGB": np.stack([ramp] * 3, axis=-1)})
    frame = frame_of(lens, tmp_path / "a.exr")
    convert_photograph(frame, tmp_path / "view.exr", square_pixel_frame(frame)[1])
    red = read_exr(tmp_path / "view.exr")["R"]
    wide, scale = square_pixel_frame(frame)
    x = (np.arange(wide.size[0]) + 0.5) / scale[0]  # in pixels of the undistorted photograph
    y = (np.arange(wide.size[1]) + 0.5) / scale[1]
    straight = undistorted_frame(frame)
    u, v = (np.stack(np.meshgrid(x, y), axis=-1) - straight.center).T
    bent = lens.distort(np.stack([u.T / FOCAL[0], v.T / FOCAL[1]], axis=-1))[..., 0] * FOCAL[0]
    wanted = (bent + CENTER[0] - 0.5) / (WIDTH - 1) * 8
    np.testing.assert_allclose(red[3:-3, 3:-3], wanted[3:-3, 3:-3], atol=0.02)
    pixels = (srgb(ramp / 10) * 255 + 0.5).astype(np.uint8)
    Image.fromarray(np.stack([pixels] * 3, axis=-1)).save(tmp_path / "a.png")
    convert_photograph(frame_of(lens, tmp_path / "a.png"), tmp_path / "view.exr", scale)
    eight = read_exr(tmp_path / "view.exr")["R"]
    np.testing.assert_allclose(eight[3:-3, 3:-3], red[3:-3, 3:-3] / 10, atol=0.005)


def test_masks_and_pixels_that_cannot_be_used_go_along(tmp_path):
    lens = Lens(**LENSES["telephone"])
    pixels = np.ones((HEIGHT, WIDTH, 3), np.float32)
    pixels[40, 60] = -3
    write_exr(tmp_path / "a.exr", {"RGB": pixels})
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[30:90, 50:130] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    frame = frame_of(lens, tmp_path / "a.exr", focal=(150.0, 150.0), mask=tmp_path / "mask.png")
    photograph = convert_photograph(frame, tmp_path / "view.exr", square_pixel_frame(frame)[1])
    made = read_exr(tmp_path / "view.exr")
    assert photograph.invalid == 1 and photograph.masked
    rows, columns = np.nonzero(made["R"] == UNUSABLE)
    place = undistorted_frame(frame)
    seen = lens.undistort((np.array([60.5, 40.5]) - CENTER) / frame.focal)
    wanted = seen * place.focal + place.center - 0.5
    assert 1 <= len(rows) <= 9
    np.testing.assert_allclose([columns.mean(), rows.mean()], wanted, atol=1)
    inside = made["A"] >= 0.999
    assert abs(inside.sum() / (60 * 80) - 1) < 0.06 and set(np.unique(made["A"])) > {0, 1}


def written(folder: Path, **changes: object) -> Path:
    """Write a ``transforms.json`` like phones, instant-ngp and nerfstudio."""
    record = {"fl_x": 150.0, "fl_y": 150.0, "w": WIDTH, "h": HEIGHT, **changes}
    frame = {"file_path": "a.exr", "transform_matrix": np.eye(4).tolist()}
    (folder / "transforms.json").write_text(json.dumps({**record, "frames": [frame]}))
    return folder / "transforms.json"


@pytest.mark.parametrize("changes", [
    {"k1": -0.1, "k2": 0.05, "k3": -0.01, "k4": 0.004, "p1": 1e-3, "p2": -2e-3},
    {"camera_model": "OPENCV", "distortion_params": [-0.1, 0.05, -0.01, 0.004, 1e-3, -2e-3]},
])  # fmt: skip
def test_a_distorted_transforms_json_is_read(tmp_path, changes):
    (frame,) = read_transforms(written(tmp_path, **changes)).frames
    assert frame.lens == Lens(**LENSES["nerfstudio"])
    write_transforms(tmp_path / "again.json", [frame])
    assert read_transforms(tmp_path / "again.json").frames[0].lens == frame.lens
    assert read_transforms(written(tmp_path, k1=0.0, p2=0)).frames[0].lens is None


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"distortion_params": [0.1, 0, 0, 0]}, "must be k1, k2, .*, or all 6 as dis"),
    ({"k1": float("nan")}, "k1 must be .*, got nan"), ({"k5": 0.1}, "must be k1, .*p2, or all"),
    ({"k1": "much"}, "frame 0"), ({"distortion_params": {"k1": 1}}, "frame 0"),
])  # fmt: skip
def test_lenses_of_another_kind(tmp_path, changes, sentence):
    with pytest.raises(CaptureError, match=sentence):
        read_transforms(written(tmp_path, **changes))


def test_distorted_camera_has_no_sensor_but_a_pinhole_candidate(tmp_path):
    with pytest.raises(CaptureError, match="the lens is distorted; .* use svu import"):
        frame_of(Lens(**LENSES["barrel"])).sensor()
    assert Candidates.read(written(tmp_path, k1=-0.1)).count == 1
