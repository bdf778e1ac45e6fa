"""Upward direction of cameras."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

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


@pytest.mark.parametrize(("tilt", "snapped"), [(17, False), (3, True)])
def test_the_vertical_of_cameras_that_are_not_rolled(tilt, snapped):
    """More photographs from one side tilt the mean of upward vectors, but not the vertical."""
    turn = scipy.spatial.transform.Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    angles = np.radians([0, 20, 40, 60, 80, 100, 180, 270])
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    for pose, angle in zip(poses, angles, strict=True):
        ahead = np.array([np.sin(angle), -0.6, np.cos(angle)]) / np.sqrt(1.36)
        right = np.cross([0, 1, 0], ahead)
        right /= np.linalg.norm(right)
        pose[:3, :3] = turn @ np.stack([right, np.cross(ahead, right), ahead], axis=1)
    found = up_of_poses(poses)
    np.testing.assert_allclose(found, [0, 1, 0] if snapped else turn[:, 1], atol=1e-6)
