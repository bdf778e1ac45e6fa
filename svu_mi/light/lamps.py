"""Light of lamps: area, point, spot and directional emitters, as cells seen from each texel.

An area light is divided into cells of equal probability of Mitsuba's ``sample_direction``, of its
shape if it is textured; other lamps are single cells. Each cell has a direction, a radius, and an
irradiance on a surface that faces it; 0 where it is hidden.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.band_limited import MOMENTS, diffuse_moments
from svu_mi.light.light_tree import LightCells
from svu_mi.light.light_visibility import is_unoccluded

APART = 0.06  # angular distance of the cells of an area light, as seen from the object
FEWEST, MOST = 2, 64  # fewest cells along each side of an area light, and most in all
CELLS = 128  # cells of all area lights, at 32 bytes per texel
POINTS = 8  # points of each middle line of an area light
END = 1e-3  # fraction of the shadow ray that is cut off at the lamp


@dataclass(frozen=True)
class Lamps:
    """N cells of lamps, as seen from S texels.

    Attributes:
        cells: N L cells, with irradiance in place of flux; cell c of lane l is at c L + l.
        moments: Diffuse moments (``LightVisibility.diffuse``), 8 (S,) Floats for R, G and B.
        lanes: Opaque UInt32, L.
        place: (S,) UInt32, lane l of each texel.
    """

    cells: LightCells
    moments: list[list[Any]]
    lanes: Any
    place: Any

    def subset(self, lanes: np.ndarray) -> "Lamps":
        """Return the cells as seen from selected texels."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        moments, place = dr.gather(list, [self.moments, self.place], chosen)
        return replace(self, moments=moments, place=place)


def trace_lamps(scene: Any, lamps: Sequence[Any], surface: TexelLanes, *, occluded: bool) -> Lamps:
    """Sample the cells of lamps from texels, and trace their visibility if ``occluded``."""
    center = [float(x.numpy().mean()) for x in surface.position]
    most = min(MOST, CELLS / len(lamps))
    count, grids = surface.count, [_grid(lamp, center, most) for lamp in lamps]
    lanes, total = dr.opaque(mi.UInt32, count), count * sum(u * v for u, v in grids)
    toward, flux = (dr.zeros(mi.Float, 4 * total) for _ in range(2))
    sums = [dr.zeros(mi.Float, count) for _ in range(3 * MOMENTS)]
    first = 0
    for lamp, grid in zip(lamps, grids, strict=True):
        sample = partial(_sampled, scene, lamp, surface, grid, occluded)
        start = dr.opaque(mi.UInt32, first)

        def add(cell: Any, *sums: Any, sample: Any = sample, start: Any = start) -> Any:
            direction, radius, light = sample(cell)
            place = (start + cell) * lanes + surface.lane
            dr.scatter(toward, mi.Vector4f(*direction, radius), place)
            dr.scatter(flux, mi.Vector4f(*light, dr.mean(light)), place)
            cosine = dr.maximum(dr.dot(surface.normal, direction), 0)
            added = [x for value in light for x in diffuse_moments(value, cosine, direction)]
            return (cell + 1, *(a + b for a, b in zip(sums, added, strict=True)))

        sums = list(fold(0, dr.opaque(mi.UInt32, grid[0] * grid[1]), add, *sums))
        dr.eval(toward, flux, sums)
        first += grid[0] * grid[1]
    moments = [sums[k : k + MOMENTS] for k in range(0, len(sums), MOMENTS)]
    cells = LightCells(toward, flux, total, dr.opaque(mi.UInt32, total))
    return Lamps(cells, moments, lanes, surface.lane)


def _grid(lamp: Any, center: list[float], most: float) -> list[int]:
    """Return the numbers of cells along u and v, by the lamp's size as seen from a point."""
    if lamp.get_shape() is None:
        return [1, 1]
    point = dr.zeros(mi.SurfaceInteraction3f, POINTS)
    point.p, t = mi.Point3f(*center), (dr.arange(mi.Float, POINTS) + 0.5) / POINTS
    sides = []
    for line in ((t, 0.5 + 0 * t), (0.5 + 0 * t, t)):
        found, _ = _of_cell(lamp, point, mi.Point2f(*line), mi.Vector2f(0))
        steps = np.diff(np.stack([x.numpy() for x in found.d]), axis=1)
        length = np.linalg.norm(steps, axis=0).sum() * POINTS / (POINTS - 1)
        sides.append(max(np.ceil(length / APART), FEWEST))
    scale = min(1, (most / np.prod(sides)) ** 0.5)
    return [max(int(side * scale), 1) for side in sides]


def _sampled(
    scene: Any, lamp: Any, surface: TexelLanes, grid: list[int], occluded: bool, cell: Any
) -> tuple[Any, Any, Any]:
    """Return direction, radius and irradiance (Color3f) of a cell of a lamp."""
    along_u = dr.opaque(mi.UInt32, grid[0])
    step = dr.rcp(dr.opaque(mi.Vector2f, grid))
    place = (mi.Point2f(cell % along_u, cell // along_u) + 0.5) * step
    part = step.x * step.y
    point = dr.zeros(mi.SurfaceInteraction3f, surface.count)
    point.p = surface.position
    found, light = _of_cell(lamp, point, place, step)
    direction = mi.Vector3f(found.d)
    free = dr.dot(surface.normal, direction) > 0
    free &= dr.dot(surface.geometric_normal, direction) > 0
    if occluded:
        near = found.dist * (1 - END)
        free = is_unoccluded(scene, surface, direction, free, coherent=True, distance=near)
    solid = dr.select(found.delta, 0, part * dr.rcp(dr.maximum(found.pdf, 1e-12)))
    radius = dr.minimum(dr.sqrt(solid / np.pi), np.pi / 2)
    return direction, radius, dr.select(free, light * part, 0)


def _of_cell(lamp: Any, point: Any, place: Any, step: Any) -> tuple[Any, Any]:
    """Return a direction to the middle of a cell, and mean radiance over its density, Color3f."""
    shape, textured = lamp.get_shape(), mi.has_flag(lamp.flags(), mi.EmitterFlags.SpatiallyVarying)
    if not textured or shape.class_name() == "Sphere":  # UVs of its samples are unknown
        return tuple(lamp.sample_direction(point, place, mi.Bool(True)))
    total = mi.Color3f(0)
    for x, y in product((-0.25, 0.25), repeat=2):
        found = shape.sample_direction(point, place + mi.Vector2f(x, y) * step, mi.Bool(True))
        lit = dr.zeros(mi.SurfaceInteraction3f, dr.width(found))
        lit.uv, lit.wi = found.uv, mi.Vector3f(0, 0, -dr.dot(found.d, found.n))
        total += dr.select(found.pdf > 0, lamp.eval(lit) / found.pdf, 0)
    return shape.sample_direction(point, place, mi.Bool(True)), total / 4
