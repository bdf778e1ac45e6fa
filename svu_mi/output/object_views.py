"""Views of the object: choice of sensors, crop windows."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.sensors import bounding_sphere, directions_of
from svu_mi.capture.tonemap import tone_mapped, with_bounds
from svu_mi.capture.up_direction import UP
from svu_mi.guidance.strategies import farthest

COARSE = 128  # pixels of the longer side, to measure brightness
GOOD = 0.8  # texels that a view sees, relative to the best view, from which it is shown first
MARGIN = 0.06  # around the object, relative to its size
Window = tuple[float, float, float, float]  # left, right, top, bottom, as fractions of the image

Axis = Literal["y", "z"]
Up = Axis | tuple[float, float, float]
DIRECTION: dict[Axis, tuple[float, float, float]] = {"y": UP, "z": (0.0, 0.0, 1.0)}


def distant_views(
    capture: Capture, seen_per_view: Sequence[int] | None = None, count: int = 2
) -> list[int]:
    """Return up to ``count`` used sensors that look from different directions.

    The first result is the brightest photograph among those that see almost the most texels or,
    without ``seen_per_view``, the first used one. Each further one has the largest angle to those
    already chosen. Sensors are returned as indices into ``capture.sensors``.
    """
    used = [index for index, used in enumerate(capture.used) if used]
    if len(used) < 2:
        return used
    center, _ = bounding_sphere(capture.mesh)
    first = 0
    if seen_per_view is not None:
        seen = np.asarray(seen_per_view)
        good = np.flatnonzero(seen >= GOOD * seen.max())
        first = int(max(good, key=lambda k: _brightness(capture, used[k])))
    chosen = farthest(
        directions_of((capture.sensors[index] for index in used), center), [first], count - 1
    )
    return [used[index] for index in chosen]


def _brightness(capture: Capture, view: int) -> float:
    """Return the mean screen value of a photograph, on the object if it has a mask."""
    image, mask = with_bounds(capture, view), capture.masks[view] if capture.masks else None
    step = -(-max(image.shape[:2]) // COARSE)
    mask = None if mask is None else mask[::step, ::step]
    shown = tone_mapped(image[::step, ::step], mask)
    return float(shown.mean() if mask is None or not mask.any() else shown[mask].mean())


def object_window(alpha: np.ndarray) -> Window:
    """Return the window around the object with a margin, from its opacity (H, W).

    Square in pixels if the image is large enough; the whole image if the object is not visible.
    """
    height, width = alpha.shape
    rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
    if len(rows) == 0:
        return 0.0, 1.0, 0.0, 1.0
    side = (1 + 2 * MARGIN) * (1 + max(float(np.ptp(rows)), float(np.ptp(columns))))
    left, right = _span((columns[0] + columns[-1] + 1) / 2, side, width)
    top, bottom = _span((rows[0] + rows[-1] + 1) / 2, side, height)
    return left, right, top, bottom


def crop(image: np.ndarray, window: Window) -> np.ndarray:
    """Crop an (H, W, ...) image to a window."""
    height, width = image.shape[:2]
    left, right = int(window[0] * width), int(np.ceil(window[1] * width))
    top, bottom = int(window[2] * height), int(np.ceil(window[3] * height))
    return image[top:bottom, left:right]


def _span(center: float, side: float, size: int) -> tuple[float, float]:
    side = min(side, size)
    first = min(max(center - side / 2, 0), size - side)
    return first / size, (first + side) / size


def front_and_right(
    capture: Capture, center: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return horizontal unit vectors (3,): front, to the first used camera; and right."""
    sensors = capture.used_sensors or capture.sensors
    right, _, front = viewing_frame(up, directions_of(sensors[:1], center)[0])
    return front, right


def viewing_frame(up: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the unit vectors right, up and front of an object, (3, 3).

    Args:
        up: (3,) upward direction, any length except 0.
        ahead: (3,) unit vector; its horizontal part is the front. If vertical, +Z or +X is used.
    """
    up = up / np.linalg.norm(up)
    for front in (ahead, np.eye(3)[2], np.eye(3)[0]):
        front = front - (front @ up) * up
        length = np.linalg.norm(front)
        if length > 1e-3:  # not vertical
            break
    front = front / length
    return np.stack([np.cross(up, front), up, front])


def named_up(up: np.ndarray) -> Up:
    """Return ``y`` or ``z`` for an upward direction along this axis, else the direction."""
    x, y, z = up.tolist()
    return next((axis for axis, own in DIRECTION.items() if own == (x, y, z)), (x, y, z))


def upward(up: Up) -> tuple[float, float, float]:
    """Return the upward direction of a name or direction."""
    return DIRECTION[up] if isinstance(up, str) else up
