"""The part of what a sensor sees that a model is shown: the object, in pixels of another size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.capture.poses import film_size, windowed_sensor
from svu_mi.capture.shown import resized


@dataclass(frozen=True)
class Frame:
    """A part of a photograph, in pixels of another size.

    Attributes:
        sensor: whose film it is.
        corner: (x, y) of the part, in pixels of the photograph.
        part: (width, height) of it, in these.
    """

    sensor: Any
    corner: tuple[int, int]
    part: tuple[int, int]

    @staticmethod
    def around(
        sensor: Any, middle: np.ndarray, length: float, side: int, *, rendered: bool
    ) -> Frame:
        """Cut a square out of what a sensor sees.

        Args:
            sensor: the sensor.
            middle: (x, y) of the square, in its pixels.
            length: of the square.
            side: pixels of the picture's longer side.
            rendered: the picture may be larger than a photograph, and show what lies beside it.
        """
        low = np.floor(middle - length / 2).astype(int)
        high = low + int(np.ceil(length))
        if not rendered:
            low, high = np.maximum(low, 0), np.minimum(high, film_size(sensor))
        part = high - low
        scale = side / float(part.max())
        scale = scale if rendered else min(scale, 1.0)
        width, height = (max(int(round(scale * size)), 1) for size in part)
        corner = int(low[0]), int(low[1])
        sensor = windowed_sensor(sensor, corner, (width, height), scale)
        return Frame(sensor, corner, (int(part[0]), int(part[1])))

    def cut(self, photograph: np.ndarray) -> np.ndarray:
        """Return this part of a photograph (H, W, 3), in pixels of its sensor."""
        (x, y), (width, height) = self.corner, self.part
        return resized(photograph[y : y + height, x : x + width], film_size(self.sensor))
