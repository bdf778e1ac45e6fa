"""Upward direction of cameras."""

from __future__ import annotations

import numpy as np
import pytest

from svu_mi.capture.up_direction import up_of_poses


@pytest.mark.parametrize(("common", "up"), [(0.25, (0, 1, 0)), (0.35, (0, 0, 1))])
def test_cameras_that_disagree_have_no_direction(common, up):
    """The upward vectors of two cameras cancel but for a part along +Z."""
    side = np.sqrt(1 - common**2)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 1] = [[side, 0, common], [-side, 0, common]]
    poses[:, :3, 2] = [[0, 1, 0], [0, -1, 0]]  # nor do they look the same way
    np.testing.assert_array_equal(up_of_poses(poses), up)


def test_steep_cameras_look_down():
    """Around an object, upward vectors are nearly horizontal and cancel; all look along -Z."""
    angles, steep = np.radians([0, 90, 180, 270]), np.radians(80)
    poses = np.tile(np.eye(4), (4, 1, 1))
    for pose, angle in zip(poses, angles, strict=True):
        inward = np.array([np.cos(angle), np.sin(angle), 0])
        pose[:3, 1] = np.sin(steep) * inward + [0, 0, np.cos(steep)]
        pose[:3, 2] = np.cos(steep) * inward - [0, 0, np.sin(steep)]
    np.testing.assert_array_equal(up_of_poses(poses), [0, 0, 1])
