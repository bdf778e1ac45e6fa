"""Upward direction of a capture, from its cameras."""

from typing import Any

import numpy as np

from svu_mi.capture.scene import to_world

UP = (0.0, 1.0, 0.0)
STEEP = 0.3  # shortest mean upward vector of the cameras that defines a direction
NEAR_AXIS = 0.9  # cosine above which a direction is snapped to an axis


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

    The mean upward direction, or the direction towards cameras that all look steeply down, snapped
    to a world axis if close; +Y if the cameras have no common direction, or without poses.
    """
    if not len(poses):
        return np.array(UP)
    mean = poses[:, :3, 1].mean(axis=0)
    if np.linalg.norm(mean) < STEEP:
        mean = -poses[:, :3, 2].mean(axis=0)
    length = np.linalg.norm(mean)
    if length < STEEP:
        return np.array(UP)
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(mean)))
    axis[largest] = np.sign(mean[largest])
    return axis if mean @ axis > NEAR_AXIS * length else mean / length
