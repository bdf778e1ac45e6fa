"""Meshes in another unit than the poses: found by what the cameras around them show."""

from __future__ import annotations

import re

import numpy as np
import pytest
from support.helpers import ball

from svu_mi.capture.importers.axis_fixes import rotation
from svu_mi.capture.mesh import make_mesh
from svu_mi.capture.mesh_scale import FACTORS, framing, wrong_scale
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import affine, changed_sensor, make_sensor, sphere_sensors

INCHES = (25.4, 39.37)


@pytest.fixture(scope="module")
def sensors():
    return sphere_sensors(make_mesh("ball", ball()), 12, (48, 36))


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("place", [[0, 0, 0], [0.2, -0.1, 0.1]])
def test_the_factor_of_usual_units_is_found(sensors, factor, place):
    """A ball of radius 1, seen from 3.6 radii, in mm, cm, inches ... instead of metres."""
    positions = ball().positions + place
    assert wrong_scale(positions, sensors) is None
    if factor > 1 and factor < 30:  # 0.1 and 0.04 times the ball: small, but possible
        points = np.random.default_rng(5113).normal(size=(300, 3))  # about 3 wide
        wrong = wrong_scale(positions / factor, sensors, points)
    else:
        wrong = wrong_scale(positions / factor, sensors)
    assert wrong is not None
    if max(factor, 1 / factor) in INCHES:  # photographs hardly tell inches in mm from those in m
        named = {round(max(each, 1 / each), 4) for each in wrong.factors}
        assert round(max(factor, 1 / factor), 4) in named and named <= set(INCHES)
        assert bool(re.search(r"\d or \d", wrong.sentence(None))) == (len(wrong.factors) == 2)
    else:
        assert wrong.factor == pytest.approx(factor) and len(wrong.factors) == 1
        assert wrong.sentence(2.0).endswith(f"import with --mesh-scale {2 * factor:.4g}.")
        assert wrong.sentence(None).endswith(f"scale the shape by {factor:.4g}.")


def test_a_point_in_the_plane_of_the_camera_is_not_framed():
    """The focal length is 8 pixels of 16: the others are 4 pixels left and right of the centre."""
    record = {
        "to_world": np.eye(4), "x_fov": 90, "clip": (0.1, 10), "film": (16, 16),
        "crop_offset": (0, 0), "crop_size": (16, 16), "principal_point_offset": (0, 0),
    }  # fmt: skip
    share, size, _ = framing(
        np.array([[-0.5, 0, 1], [0.5, 0, 1], [3, 0, 0]]), [make_sensor(record, "any")]
    )
    assert share == pytest.approx(2 / 3) and size == pytest.approx(0.5)


def test_points_of_the_surroundings_do_not_count(sensors):
    """A room of 40 x 40 x 40 around a ball that the cameras frame."""
    points = np.random.default_rng(881).uniform(-20, 20, (500, 3))
    assert wrong_scale(ball().positions, sensors, points) is None
    assert wrong_scale(ball().positions, sensors, 1e307 * points) is None  # damaged


def test_cameras_in_a_mesh_of_their_surroundings_are_no_mistake(sensors):
    """An object on a ground of 30 x 30 with a lamp above: the cameras are in its bounding box."""
    x, y = np.meshgrid(np.linspace(-2, 2, 30), np.linspace(-2, 2, 30))
    ground = np.stack([x.ravel(), np.full(x.size, -1.0), y.ravel()], axis=1)
    corners = [[-15, -5, -15], [15, 9, 15]]
    assert wrong_scale(np.concatenate([ball().positions, ground, corners]), sensors) is None


def test_a_mesh_in_mm_far_from_the_origin_is_named(sensors):
    """The cameras are outside of its bounding box, and nearly all see nothing of it."""
    place = np.array([4.0, -3.0, 2.0])
    moved = [changed_sensor(s, to_world=(affine(np.eye(3), place) @ to_world(s)).tolist())
             for s in sensors]  # fmt: skip
    positions = ball().positions + place
    assert wrong_scale(positions, moved) is None
    wrong = wrong_scale(1000 * positions, moved)
    assert wrong is not None and wrong.factor == pytest.approx(0.001)
    turned = positions @ rotation("x", 90).T
    assert wrong_scale(turned, moved) is None  # wrong axes have no factor
    both = wrong_scale(1000 * turned, moved)
    assert both is not None and both.factor == pytest.approx(0.001)


def test_an_unknown_factor_is_not_made_up(sensors):
    wrong = wrong_scale(7000 * ball().positions + [3e4, 0, 0], sensors)
    assert wrong is None  # another origin: the cameras are not in the box
    wrong = wrong_scale(5e5 * ball().positions, sensors)
    assert wrong is not None and wrong.factor is None
    assert wrong.sentence(1.0).endswith("check that mesh and poses have one unit and one origin.")


@pytest.mark.parametrize("positions", [np.zeros((3, 3)), ball().positions[:1]])
def test_a_mesh_without_extent_has_no_unit(sensors, positions):
    assert wrong_scale(positions, sensors) is None
    assert wrong_scale(ball().positions, []) is None
