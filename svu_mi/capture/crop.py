"""Cropping and downsampling of photographs to about one pixel per texel.

More pixels per texel need memory but do not improve the estimates.
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

LARGE = 2**22  # pixels; smaller photographs are kept as they are
ENOUGH = 0.9  # pixels across a texel (notebooks/design/photographs.md)
MARGIN = 0.02  # margin around the object, as a fraction of its size in the photograph
BORDER = 8  # additional margin, in pixels
FACES = 20_000  # faces in the sample that measures texel sizes
SMALL = 0.1  # fraction of the surface on which texels may have less than ENOUGH pixels


@dataclass(frozen=True)
class Window:
    """Crop window of a photograph, and its downsampling factor.

    Attributes:
        left, top: First column and row of the crop, in pixels of the photograph.
        width, height: Size of the result in its own pixels.
        shrink: Side of the block of pixels that is averaged into one.
    """

    left: int
    top: int
    width: int
    height: int
    shrink: int = 1

    @staticmethod
    def whole(size: Size) -> Window:
        """Return the window that keeps a photograph of (width, height) unchanged."""
        return Window(0, 0, *size)

    @property
    def size(self) -> Size:
        """Size of the result: (width, height)."""
        return self.width, self.height

    def cut(self, plane: np.ndarray) -> np.ndarray:
        """Return a view of the cropped pixels, (h * shrink, w * shrink, ...)."""
        bottom = self.top + self.height * self.shrink
        return plane[self.top : bottom, self.left : self.left + self.width * self.shrink]

    def joined(self, plane: np.ndarray, join: np.ufunc) -> np.ndarray:
        """Reduce the blocks of a cropped plane by ``join``, such as ``np.add``."""
        k = self.shrink
        if k == 1:
            return plane
        rows = join.reduce(plane.reshape(self.height, k, -1), axis=1)
        result = rows[:, ::k].copy()
        for column in range(1, k):
            join(result, rows[:, column::k], out=result)
        return np.asarray(result)

    def averaged(self, plane: np.ndarray) -> np.ndarray:
        """Return the means (h, w) of the blocks of a cropped plane."""
        if self.shrink == 1:
            return plane
        return self.joined(plane, np.add) / np.float32(self.shrink**2)

    def seen_by(self, sensor: Any) -> Any:
        """Return the sensor that sees the crop; ``sensor`` itself if nothing is cropped."""
        if self == Window.whole(film_size(sensor)):
            return sensor
        return windowed_sensor(sensor, (self.left, self.top), self.size, 1 / self.shrink)


@dataclass(frozen=True, kw_only=True)
class Detail:
    """Required resolution and area of photographs; by default, photographs are unchanged.

    Attributes:
        texels: Size (W, H) of the texture; None if unknown.
        side: Largest useful width or height in pixels; None for no limit. A limit disables
            cropping.
        surroundings: True keeps the background of the object.
    """

    texels: Size | None = None
    side: int | None = None
    surroundings: bool = False

    def windows(self, target: Any, sensors: Sequence[Any]) -> list[Window]:
        """Return the window of each sensor's photograph."""
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
    """Geometry from which the bounds of an object and its pixels per texel are computed.

    Attributes:
        corners: (P, 3) float64, world positions of all vertices.
        middles: (F, 3), centres of F sampled faces.
        sides: (F,), side of a texel on each face in world units; empty if unknown.
        areas: (F,), area of each face.
    """

    corners: np.ndarray
    middles: np.ndarray
    sides: np.ndarray
    areas: np.ndarray

    @staticmethod
    def of(mesh: mi.Mesh, texels: Size | None) -> _ObjectExtent:
        """Measure an ``mi.Mesh`` that has a texture of (W, H) texels."""
        source = arrays(mesh)
        chosen = source.faces[:: max(len(source.faces) // FACES, 1)]
        areas = np.linalg.norm(crosses_of(source.positions, chosen), axis=1) / 2
        sides = np.zeros(0)
        if texels is not None:
            sides = _sides(source, chosen, areas, texels)
        return _ObjectExtent(source.positions, source.positions[chosen].mean(axis=1), sides, areas)

    def bounds_in(self, sensor: Any, film: Size) -> tuple[np.ndarray, np.ndarray]:
        """Return first pixel and end, each (x, y), of the object's bounds with a margin.

        Return the whole film if a part of the object is not in front of the camera.
        """
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
        """Return a typical small width of texels in pixels, seen face on; None if unknown.

        Texels on a fraction ``SMALL`` of the surface are smaller than this width.
        """
        _, depth = projected(sensor, self.middles)
        seen = depth > float(sensor.near_clip())
        if not len(self.sides) or not seen.any():
            return None
        across = focal_length(sensor) * self.sides[seen] / depth[seen]
        order = np.argsort(across)
        area = np.cumsum(self.areas[seen][order])
        return float(across[order][np.searchsorted(area, SMALL * area[-1])])


def _sides(mesh: MeshArrays, faces: np.ndarray, areas: np.ndarray, texels: Size) -> np.ndarray:
    """Return the side length of a texel on each face, (F,), in world units."""
    number = texels[0] * texels[1]
    if mesh.uvs is None:  # unwrapping makes all texels equally large
        return np.full(len(areas), np.sqrt(np.linalg.norm(mesh.crosses, axis=1).sum() / 2 / number))
    return np.sqrt(areas / np.maximum(chart_areas(mesh.uvs, faces) * number, 1e-30))
