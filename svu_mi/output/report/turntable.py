"""Renders of the object on a turntable, and projection of texels into them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.mesh import arrays
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import bounding_sphere, film_size, object_sensor, projected
from svu_mi.capture.tonemap import ObjectView, object_only_scene
from svu_mi.capture.up_direction import up_direction
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.dilate import dilate
from svu_mi.geometry.texels import Texels
from svu_mi.output import object_views
from svu_mi.output.object_views import front_and_right

ELEVATION = 20.0  # degrees
FOV, ROOM = 30.0, 1.02  # degrees; distance relative to a bounding sphere that just fits
BORDER = 0.01  # margin around the object, relative to the film
EMPTY = 0.02  # lower bound of opacity that colours are divided by
EDGE = 2  # pixels of the silhouette that take the colour of the interior
LIFT = 1e-3  # offset of rays from the surface, relative to the object's extent


@dataclass(frozen=True)
class Turntable:
    """Sensors on a ring around an object, slightly above it.

    The first one looks from the direction of the first photograph. All frames share a crop
    ``window``, so that the object does not move between frames. ``up`` is a (3,) unit vector.
    """

    scene: Any
    sensors: tuple[Any, ...]
    window: object_views.Window
    up: np.ndarray

    @classmethod
    def around(cls, capture: Capture, count: int, side: int) -> "Turntable":
        """Place ``count`` sensors around a capture's ``mesh``, with films of ``side`` pixels."""
        center, radius = bounding_sphere(capture.mesh)
        distance = ROOM * radius / np.sin(np.radians(FOV) / 2)
        up = up_direction(capture)
        front, right = front_and_right(capture, center, up)
        high = np.radians(ELEVATION)
        sensors = []
        for turn in 2 * np.pi * np.arange(count) / count:
            horizontal = np.cos(turn) * front + np.sin(turn) * right
            origin = center + distance * (np.cos(high) * horizontal + np.sin(high) * up)
            pose = mi.ScalarTransform4f().look_at(list(origin), list(center), list(up))
            matrix = np.array(pose.matrix, np.float64)
            sensors.append(object_sensor(matrix, FOV, distance, (side, side), "turntable"))
        points = arrays(capture.mesh).positions
        places = np.concatenate([_places(points, sensor) for sensor in sensors])
        (left, top), (right, bottom) = places.min(axis=0) - BORDER, places.max(axis=0) + BORDER
        window = max(left, 0.0), min(right, 1.0), max(top, 0.0), min(bottom, 1.0)
        return cls(object_only_scene(capture), tuple(sensors), window, up)

    def frame(self, texture: np.ndarray, number: int) -> np.ndarray:
        """Render a texture (H, W, 3) of screen colours on the object, from sensor ``number``.

        Returns (h, w, 4) screen colours and opacity, cropped to ``window``.
        """
        image = ObjectView.of(self.scene, self.sensors[number]).painted(texture)
        alpha = image[..., 3:]
        # Undo the white background, x = a c + 1 - a: the page may be dark.
        color = np.clip((image[..., :3] + alpha - 1) / np.maximum(alpha, EMPTY), 0, 1)
        # Replace silhouette colours: colour and opacity have different samples, so white remains.
        color = dilate(color, image[..., 3] == 1, EDGE)
        return object_views.crop(np.dstack([color, alpha]), self.window)

    def find(
        self, texels: Texels, chosen: np.ndarray, frames: Sequence[int] | None = None
    ) -> tuple[int, int, float, float] | None:
        """Return the texel of ``chosen`` (t,) that is seen most frontally: index, frame, x and y.

        Only ``frames`` are considered (default: all). x and y are fractions of the frame from the
        left and the top. None if no texel is visible.
        """
        points = np.array(texels.position).T[chosen]
        normals = np.array(texels.normal).T[chosen]
        best = (0.0, 0, 0)
        for number in range(len(self.sensors)) if frames is None else frames:
            offset = to_world(self.sensors[number])[:3, 3] - points
            cosine = (normals * offset).sum(axis=1) / np.linalg.norm(offset, axis=1)
            free = self._free(points + LIFT * texels.extent * normals, offset)
            shown = np.where(free, cosine, 0)
            k = int(np.argmax(shown))
            best = max(best, (float(shown[k]), number, k), key=lambda entry: entry[0])
        cosine, number, k = best
        if cosine <= 0:
            return None
        x, y = _places(points[k : k + 1], self.sensors[number])[0]
        left, right, top, bottom = self.window
        return int(chosen[k]), number, (x - left) / (right - left), (y - top) / (bottom - top)

    def frames_apart(self, frames: Sequence[int]) -> list[int]:
        """Return all frames that are at least a quarter turn from each of ``frames``."""
        count = len(self.sensors)
        return [
            k for k in range(count)
            if all(4 * min((k - f) % count, (f - k) % count) >= count for f in frames)
        ]  # fmt: skip

    def _free(self, points: np.ndarray, offset: np.ndarray) -> np.ndarray:
        # Copied by to_drjit: the alignment of NumPy's memory would be part of the kernel.
        ray = mi.Ray3f(to_drjit(mi.Point3f, points.T), to_drjit(mi.Vector3f, offset.T))
        ray.maxt = mi.Float(1.0)
        return ~np.array(self.scene.ray_test(ray))


def _places(points: np.ndarray, sensor: Any) -> np.ndarray:
    """Project points (N, 3) into a sensor: (N, 2) from left and top, as fractions of the film."""
    return projected(sensor, points)[0] / film_size(sensor)
