"""Names in files of other tools: accepted and refused paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from svu_mi.capture.importers.source import Frame
from svu_mi.capture.importers.source_files import safe_path
from svu_mi.errors import CaptureError

GOOD = {
    "a.png": "a.png", "./a/b.png": "a/b.png", "a/../b.png": "b.png", "a\\b.png": "a/b.png",
    "..a": "..a", "ü ß.png": "ü ß.png",
}  # fmt: skip
OUTSIDE = ["../a", "..", "a/../../b", "a\\..\\..\\b", "/a", "//a/b", "\\a", "C:\\a", "C:a"]
NO_NAME = [
    "", ".", "a/..", "a\0b", "a\nb", "\x1b[31m", "\x7f", "\ud800", "x" * 300, "a/" * 2000 + "b",
    None, 3, ["a"],
]  # fmt: skip


@pytest.mark.parametrize("name", GOOD)
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
