"""Pictures of the object from the sensors of a capture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from svu_mi.capture.poses import bounding_sphere, directions_of
from svu_mi.capture.shown import Look, alone
from svu_mi.guidance.strategies import farthest

MARGIN = 0.06  # around the object, in parts of its size
Window = tuple[float, float, float, float]  # left, right, top, bottom, in parts of a picture


def far_apart(
    capture: Any, seen_per_view: Sequence[int] | None = None, count: int = 2
) -> list[int]:
    """Return ``count`` used sensors: the one that sees most texels, and those farthest from it.

    Indices into ``capture.sensors``, fewer if there are fewer. Each is the farthest in direction
    from all before it.
    """
    used = [index for index, used in enumerate(capture.used) if used]
    if len(used) < 2:
        return used
    center, _ = bounding_sphere(capture.mesh)
    first = 0 if seen_per_view is None else int(np.argmax(seen_per_view))
    chosen = farthest(directions_of((capture.sensors[index] for index in used), center),
                      [first], count - 1)
    return [used[index] for index in chosen]


def picture(capture: Any, texture: np.ndarray, sensor: Any) -> np.ndarray:
    """Render a texture on the mesh of a capture alone, as ``Look.painted`` does.

    The picture is at most 512 pixels on its longer side.
    """
    return Look.at(alone(capture), sensor).painted(texture)


def object_window(alpha: np.ndarray) -> Window:
    """Return the window of an object with a margin, given where it is (H, W).

    Square in pixels where the image allows; the whole image if the object is not in it.
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
    """Cut a window out of an (H, W, ...) image."""
    height, width = image.shape[:2]
    left, right = int(window[0] * width), int(np.ceil(window[1] * width))
    top, bottom = int(window[2] * height), int(np.ceil(window[3] * height))
    return image[top:bottom, left:right]


def _span(center: float, side: float, size: int) -> tuple[float, float]:
    side = min(side, size)
    first = min(max(center - side / 2, 0), size - side)
    return first / size, (first + side) / size
