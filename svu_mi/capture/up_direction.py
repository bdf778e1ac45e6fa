"""Upward direction of a capture, from its cameras."""

from typing import Any

import numpy as np

from svu_mi.capture.scene import to_world

UP = (0.0, 1.0, 0.0)
STEEP = 0.3  # shortest mean upward vector of the cameras that defines a direction
NEAR_AXIS, LEVEL = 0.9, 0.996  # cosines above which a mean and a vertical are snapped to an axis
ROLLED, APART = 0.02, 0.1  # largest mean square of sines of rolls; least one of other directions


def up_direction(capture: Any) -> np.ndarray:
    """Return the upward direction (3,) of a capture (see ``up_of_poses``)."""
    sensors = capture.used_sensors or capture.sensors
    return up_of_poses(np.array([to_world(sensor) for sensor in sensors]))


def is_seen_from_above(capture: Any) -> bool:
    """Return whether no used camera is below the object's bounding box; False without cameras."""
    box, up = capture.shape.bbox(), up_direction(capture)
    eyes = [to_world(sensor)[:3, 3] @ up for sensor in capture.used_sensors]
    lowest = np.minimum(np.array(box.min) * up, np.array(box.max) * up).sum()
    return bool(eyes) and bool(min(eyes) > lowest)


def up_of_poses(poses: np.ndarray) -> np.ndarray:
    """Return the upward direction (3,) of poses (V, 4, 4), camera to world.

    The direction perpendicular to the horizontal axes of cameras that are not rolled and look in
    several directions; else the mean upward direction of the cameras. It is snapped to a world axis
    if close; +Y if the cameras have no common direction, or without poses.
    """
    if not len(poses):
        return np.array(UP)
    right, up, ahead = (poses[:, :3, k] for k in range(3))
    mean, near = up.mean(axis=0), NEAR_AXIS
    if np.linalg.norm(mean) < STEEP:  # all look steeply down, if anywhere
        mean = -ahead.mean(axis=0)
    (rolled, apart, _), axes = np.linalg.eigh(right.T @ right / len(right))
    if rolled < ROLLED and apart > APART:
        mean, near = axes[:, 0] * (axes[:, 0] @ mean), LEVEL
    length = np.linalg.norm(mean)
    if length < STEEP:
        return np.array(UP)
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(mean)))
    axis[largest] = np.sign(mean[largest])
    return axis if mean @ axis > near * length else mean / length
