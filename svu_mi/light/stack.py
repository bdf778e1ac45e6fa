"""The filtered light of all roughness levels as one table, looked up between its levels.

Every level keeps the resolution that its lobe needs (``levels.py``), so that all of them
together take little more memory than the sharpest few.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.light.environment import lat_long
from svu_mi.light.levels import Levels

PADDED = {1: 1, 3: 4}  # floats per node by channels: four are read at once


@dataclass(frozen=True)
class LightStack:
    """R lat-long maps of different sizes, one behind the other.

    Attributes:
        values: Float, nodes of all maps, row by row, with a column of the other side on either
            side; 1 float per node, or 4 (R, G, B, 0).
        tables: (3 R,) UInt32: first node, rows and columns of every map.
        count: R, at least 2.
        channels: 1 or 3.
        to_local: Matrix3f, world to local.
    """

    values: Any
    tables: Any
    count: int
    channels: int
    to_local: Any

    def radiance(self, place: Any, direction: Any) -> list[Any]:
        """Look up light *from* a world direction between two levels, linearly in all of it.

        Derivatives with respect to ``place`` and ``direction`` are those of the interpolation.

        Args:
            place: Float in [0, R - 1]: 2.25 is a quarter of the way from level 2 to level 3.
            direction: unit vector.

        Returns:
            A Float per channel.
        """
        u, v = lat_long(self.to_local @ mi.Vector3f(direction))
        level = dr.clip(mi.Int32(dr.detach(place)), 0, self.count - 2)
        here, above = (self._at(mi.UInt32(level + step), u, v) for step in (0, 1))
        part = place - level
        return [dr.lerp(a, b, part) for a, b in zip(here, above, strict=True)]

    def _at(self, level: Any, u: Any, v: Any) -> list[Any]:
        """Interpolate in one map: columns are centred, rows stand on the poles."""
        first, rows, columns = (dr.gather(mi.UInt32, self.tables, 3 * level + k) for k in range(3))
        x = u * columns + 0.5  # the column of the other side comes first
        y = v * (rows - 1)
        left = dr.minimum(mi.UInt32(dr.detach(x)), columns)
        top = dr.minimum(mi.UInt32(dr.detach(y)), rows - 2)
        fx, fy = x - left, y - top
        width = columns + 2
        node = first + top * width + left
        corners = [self._node(node + step) for step in (0, 1, width, width + 1)]
        a, b, c, d = corners
        return [
            dr.lerp(dr.lerp(a[k], b[k], fx), dr.lerp(c[k], d[k], fx), fy)
            for k in range(self.channels)
        ]

    def _node(self, index: Any) -> list[Any]:
        if self.channels == 1:
            return [dr.gather(mi.Float, self.values, index)]
        value = dr.gather(mi.Vector4f, self.values, index)
        return [value.x, value.y, value.z]


def stack(levels: Levels) -> LightStack:
    """Put the maps of at least two levels into one table."""
    return _stacked([np.array(texture.tensor()) for texture in levels.textures], levels.to_local)


def _stacked(maps: Sequence[np.ndarray], to_local: Any) -> LightStack:
    """Pack maps (H, W, C), C = 1 or 3."""
    channels = maps[0].shape[2]
    tables, flat, first = [], [], 0
    for grid in maps:
        rows, columns = grid.shape[:2]
        around = np.concatenate([grid[:, -1:], grid, grid[:, :1]], axis=1)
        padded = np.zeros((rows, columns + 2, PADDED[channels]), np.float32)
        padded[..., :channels] = around
        tables += [first, rows, columns]
        flat.append(padded.ravel())
        first += rows * (columns + 2)
    return LightStack(
        values=owned(mi.Float, np.concatenate(flat)),
        tables=owned(mi.UInt32, np.array(tables, np.uint32)),
        count=len(maps),
        channels=channels,
        to_local=to_local,
    )
