"""Which way is up, as far as cameras tell: photographers mostly hold them level."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from svu_mi.capture.poses import directions_of
from svu_mi.capture.scene import to_world

UP = (0.0, 1.0, 0.0)
STEEP = 0.3  # length of the cameras' mean upward direction below which they say nothing
NEAR_AXIS = 0.9  # cosine from which an axis of the world is meant

Axis = Literal["y", "z"]
DIRECTION: dict[Axis, tuple[float, float, float]] = {"y": UP, "z": (0.0, 0.0, 1.0)}


def upright(capture: Any) -> np.ndarray:
    """Return the direction (3,) that is up in a capture, as ``up_of`` its cameras."""
    sensors = capture.used_sensors or capture.sensors
    return up_of(np.array([to_world(sensor) for sensor in sensors]))


def front_and_right(
    capture: Any, center: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (3,) to the front, where the first photograph is from, and to the right."""
    sensors = capture.used_sensors or capture.sensors
    right, _, front = facing(up, directions_of(sensors[:1], center)[0])
    return front, right


def facing(up: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the unit directions right, up and front (3, 3) of whoever is looked at from the front.

    Args:
        up: (3,), of any length but 0.
        ahead: (3,) unit vector, which is in front, or above or below that.
    """
    up = up / np.linalg.norm(up)
    for front in (ahead, np.eye(3)[2], np.eye(3)[0]):
        front = front - (front @ up) * up
        length = np.linalg.norm(front)
        if length > 1e-3:  # else it is up, or down
            break
    front = front / length
    return np.stack([np.cross(up, front), up, front])


def up_of(poses: np.ndarray) -> np.ndarray:
    """Return the direction (3,) that is up for poses (V, 4, 4), camera to world.

    It is their mean upward direction, or the world's axis next to it; +Y if they are turned
    in all ways, or if there are none.
    """
    mean = poses[:, :3, 1].mean(axis=0) if len(poses) else np.zeros(3)
    length = np.linalg.norm(mean)
    if length < STEEP:
        return np.array(UP)
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(mean)))
    axis[largest] = np.sign(mean[largest])
    return axis if mean @ axis > NEAR_AXIS * length else mean / length


def nearest_axis(up: np.ndarray) -> Axis:
    """Return ``z`` if that is what an upward direction means, else ``y``."""
    return "z" if up @ DIRECTION["z"] > NEAR_AXIS else "y"
