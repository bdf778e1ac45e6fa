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
    np.testing.assert_array_equal(up_of_poses(poses), up)
