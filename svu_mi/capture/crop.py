"""Crop photographs to the object and reduce them to what texels resolve.

A photograph of 24 megapixels says no more of a texel than one of six, if that has a pixel of it,
too; and most of its pixels show no object at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.mesh import MeshArrays, arrays, chart_areas, crosses_of
from svu_mi.capture.sensors import film_size, focal_length, projected, windowed_sensor
from svu_mi.core.memory import Size

LARGE = 2**22  # pixels of a photograph from which on it is worth it
ENOUGH = 0.9  # pixels across a texel: about one (notebooks/design/photographs.md)
MARGIN = 0.02  # of the object's size in a photograph, around it
BORDER = 8  # pixels around it besides
FACES = 20_000  # that say how large texels are
SMALL = 0.1  # part of the surface whose texels may have fewer pixels than enough


@dataclass(frozen=True)
class Window:
    """The part of a photograph that is kept, and how many of its pixels become one.

    Attributes:
        left, top: its first pixel.
        width, height: of what is kept, in pixels of the result.
        shrink: pixels per side that become one.
    """

    left: int
    top: int
    width: int
    height: int
    shrink: int = 1

    @staticmethod
    def whole(size: Size) -> Window:
        """Return the window that keeps a photograph of (width, height) as it is."""
        return Window(0, 0, *size)

    @property
    def size(self) -> Size:
        """(width, height) of the result."""
        return self.width, self.height

    def cut(self, plane: np.ndarray) -> np.ndarray:
        """Return the pixels (h shrink, w shrink, ...) that the result is made of, as a view."""
        bottom = self.top + self.height * self.shrink
        return plane[self.top : bottom, self.left : self.left + self.width * self.shrink]

    def joined(self, plane: np.ndarray, join: np.ufunc) -> np.ndarray:
        """Join all pixels of each block of what is cut out, (h shrink, w shrink), by a function
        such as ``np.add``: (h, w)."""
        k = self.shrink
        if k == 1:
            return plane
        rows = join.reduce(plane.reshape(self.height, k, -1), axis=1)
        result = rows[:, ::k].copy()
        for column in range(1, k):
            join(result, rows[:, column::k], out=result)
        return np.asarray(result)

    def averaged(self, plane: np.ndarray) -> np.ndarray:
        """Return the means (h, w) of the blocks of (h shrink, w shrink)."""
        if self.shrink == 1:
            return plane
        return self.joined(plane, np.add) / np.float32(self.shrink**2)

    def seen_by(self, sensor: Any) -> Any:
        """Return the sensor whose whole film is the result; the same one if that is the film."""
        if self == Window.whole(film_size(sensor)):
            return sensor
        return windowed_sensor(sensor, (self.left, self.top), self.size, 1 / self.shrink)


@dataclass(frozen=True, kw_only=True)
class Detail:
    """What is needed of photographs; all of it by default.

    Attributes:
        texels: (W, H) of the texture that is made of them; None if nothing is known of it, and
            photographs are kept whole.
        side: pixels per side that are needed at most; None for no limit.
        surroundings: whether pixels beside the object are needed, too.
    """

    texels: Size | None = None
    side: int | None = None
    surroundings: bool = False

    def windows(self, target: Any, sensors: Sequence[Any]) -> list[Window]:
        """Return what to keep of the photographs of sensors."""
        films = [film_size(sensor) for sensor in sensors]
        large = [width * height >= LARGE for width, height in films]
        if (self.texels is None and self.side is None) or not any(large):
            return [Window.whole(film) for film in films]
        surface = _ObjectExtent.of(target, self.texels) if target.is_mesh() else None
        return [
            self._window(film, sensor, surface) if is_large else Window.whole(film)
            for film, sensor, is_large in zip(films, sensors, large, strict=True)
        ]

    def _window(self, film: Size, sensor: Any, surface: _ObjectExtent | None) -> Window:
        shrink = 1
        if self.side is not None:
            shrink = -(-max(film) // self.side)
        elif surface is not None and (across := surface.pixels_across(sensor)) is not None:
            shrink = max(min(int(across / ENOUGH), *film), 1)
        low, high = np.zeros(2, np.int64), np.array(film)
        if surface is not None and not self.surroundings and self.side is None:
            low, high = surface.bounds_in(sensor, film)
        size = np.maximum(high - low, shrink) // shrink
        low = np.minimum(low, np.array(film) - size * shrink)
        return Window(int(low[0]), int(low[1]), int(size[0]), int(size[1]), shrink)


WHOLE = Detail()


@dataclass(frozen=True)
class _ObjectExtent:
    """What of an object says where it is in a photograph, and how large its texels are.

    Attributes:
        corners: (P, 3) float64, world positions of all vertices.
        middles: (F, 3), of some faces.
        sides: (F,) of their texels, in world units; empty where nothing is known of texels.
        areas: (F,) of the faces.
    """

    corners: np.ndarray
    middles: np.ndarray
    sides: np.ndarray
    areas: np.ndarray

    @staticmethod
    def of(mesh: mi.Mesh, texels: Size | None) -> _ObjectExtent:
        """Measure an ``mi.Mesh`` with a texture of (W, H)."""
        source = arrays(mesh)
        chosen = source.faces[:: max(len(source.faces) // FACES, 1)]
        areas = np.linalg.norm(crosses_of(source.positions, chosen), axis=1) / 2
        sides = np.zeros(0)
        if texels is not None:
            sides = _sides(source, chosen, areas, texels)
        return _ObjectExtent(source.positions, source.positions[chosen].mean(axis=1), sides, areas)

    def bounds_in(self, sensor: Any, film: Size) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and the last but one pixel (2,) int64 of the object, with a margin; the
        whole film if some of it is not in front of the camera."""
        whole = np.zeros(2, np.int64), np.array(film)
        points, depth = projected(sensor, self.corners)
        if not len(depth) or depth.min() <= float(sensor.near_clip()):
            return whole
        low, high = points.min(axis=0), points.max(axis=0)
        margin = MARGIN * (high - low).max() + BORDER
        low = np.clip(np.floor(low - margin), 0, film).astype(np.int64)
        high = np.clip(np.ceil(high + margin), 0, film).astype(np.int64)
        return (low, high) if (high > low).all() else whole

    def pixels_across(self, sensor: Any) -> float | None:
        """Return how many pixels all but the smallest texels have across, seen face on; None where
        that is not known."""
        _, depth = projected(sensor, self.middles)
        seen = depth > float(sensor.near_clip())
        if not len(self.sides) or not seen.any():
            return None
        across = focal_length(sensor) * self.sides[seen] / depth[seen]
        order = np.argsort(across)
        area = np.cumsum(self.areas[seen][order])
        return float(across[order][np.searchsorted(area, SMALL * area[-1])])


def _sides(mesh: MeshArrays, faces: np.ndarray, areas: np.ndarray, texels: Size) -> np.ndarray:
    """Return the side (F,) of a texel of each face, in world units."""
    number = texels[0] * texels[1]
    if mesh.uvs is None:  # unwrapping will make all alike
        return np.full(len(areas), np.sqrt(np.linalg.norm(mesh.crosses, axis=1).sum() / 2 / number))
    return np.sqrt(areas / np.maximum(chart_areas(mesh.uvs, faces) * number, 1e-30))
