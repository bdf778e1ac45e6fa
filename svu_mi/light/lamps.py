"""Light of lamps: area, point, spot and directional emitters, as cells seen from each texel.

An area light is divided into cells of equal probability of Mitsuba's ``sample_direction``; other
lamps are single cells. Each cell has a direction, a radius, and an irradiance on a surface that
faces it; 0 where it is hidden.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.band_limited import MOMENTS, diffuse_moments

APART = 0.06  # angular distance of the cells of an area light, as seen from the object
FEWEST, MOST = 2, 8  # cells along each side of an area light
CELLS = 128  # cells of all area lights, at 32 bytes per texel
END = 1e-3  # fraction of the shadow ray that is cut off at the lamp


@dataclass(frozen=True)
class Lamps:
    """N cells of lamps, as seen from S texels.

    Attributes:
        toward: (4 N L,) Float, direction to a cell and its radius [rad], by cell and lane.
        flux: (4 N L,) Float, irradiance R, G, B and their mean, by cell and lane.
        moments: Diffuse moments (``LightVisibility.diffuse``), 8 (S,) Floats for R, G and B.
        number, lanes: Opaque UInt32, N and L.
        place: (S,) UInt32, lane of each texel.
    """

    toward: Any
    flux: Any
    moments: list[list[Any]]
    number: Any
    lanes: Any
    place: Any

    def subset(self, lanes: np.ndarray) -> "Lamps":
        """Return the cells as seen from selected texels."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        moments, place = dr.gather(list, [self.moments, self.place], chosen)
        return replace(self, moments=moments, place=place)

    def seen_from(self, lane: Any) -> "LampCells":
        """Return the cells as seen from one texel per lane."""
        return LampCells(self, dr.gather(mi.UInt32, self.place, lane))


class LampCells:
    """Cells of lamps, with the interface of ``LightCells``."""

    # Not a dataclass, because Dr.Jit would treat the fields as loop state.

    def __init__(self, lamps: Lamps, lane: Any) -> None:
        self._lamps, self._lane = lamps, lane

    def at(self, cell: Any) -> tuple[Any, Any]:
        """Return direction (Vector3f) and radius (Float) of a cell."""
        place = cell * self._lamps.lanes + self._lane
        x, y, z, radius = dr.gather(mi.Vector4f, self._lamps.toward, place)
        return mi.Vector3f(x, y, z), radius

    def light(self, cell: Any, channels: int) -> list[Any]:
        """Return the irradiance by a cell: R, G and B, or their mean if ``channels`` is 1."""
        place = cell * self._lamps.lanes + self._lane
        *rgb, grey = dr.gather(mi.Vector4f, self._lamps.flux, place)
        return [grey] if channels == 1 else rgb


def trace_lamps(scene: Any, lamps: Sequence[Any], surface: TexelLanes, *, occluded: bool) -> Lamps:
    """Sample the cells of lamps from texels, and trace their visibility if ``occluded``."""
    most = max(int((CELLS / len(lamps)) ** 0.5), 1)
    count, sides = surface.count, [min(_sides(lamp, surface), most) for lamp in lamps]
    lanes, total = dr.opaque(mi.UInt32, count), sum(side * side for side in sides)
    toward, flux = (dr.zeros(mi.Float, 4 * total * count) for _ in range(2))
    sums = [dr.zeros(mi.Float, count) for _ in range(3 * MOMENTS)]
    first = 0
    for lamp, side in zip(lamps, sides, strict=True):
        sample = partial(_sampled, scene, lamp, surface, side, occluded)
        start = dr.opaque(mi.UInt32, first)

        def add(cell: Any, *sums: Any, sample: Any = sample, start: Any = start) -> Any:
            direction, radius, light = sample(cell)
            place = (start + cell) * lanes + surface.lane
            dr.scatter(toward, mi.Vector4f(*direction, radius), place)
            dr.scatter(flux, mi.Vector4f(*light, dr.mean(light)), place)
            cosine = dr.maximum(dr.dot(surface.normal, direction), 0)
            added = [x for value in light for x in diffuse_moments(value, cosine, direction)]
            return (cell + 1, *(a + b for a, b in zip(sums, added, strict=True)))

        sums = list(fold(0, dr.opaque(mi.UInt32, side * side), add, *sums))
        dr.eval(toward, flux, sums)
        first += side * side
    moments = [sums[k : k + MOMENTS] for k in range(0, len(sums), MOMENTS)]
    return Lamps(toward, flux, moments, dr.opaque(mi.UInt32, total), lanes, surface.lane)


def _sides(lamp: Any, surface: TexelLanes) -> int:
    """Return the number of cells along each side of a lamp."""
    shape = lamp.get_shape()
    if shape is None:
        return 1
    center = np.array([x.numpy().mean() for x in surface.position])
    distance = float(np.linalg.norm(np.array(shape.bbox().center()) - center))
    radius = np.sqrt(float(np.ravel(shape.surface_area())[0]) / np.pi)
    return int(np.clip(np.ceil(2 * radius / (APART * (distance + 1e-9))), FEWEST, MOST))


def _sampled(
    scene: Any, lamp: Any, surface: TexelLanes, side: int, occluded: bool, cell: Any
) -> tuple[Any, Any, Any]:
    """Return direction, radius and irradiance (Color3f) of a cell of a lamp."""
    sides = dr.opaque(mi.UInt32, side)
    step = dr.rcp(mi.Float(sides))
    u = (mi.Float(cell % sides) + 0.5) * step
    v = (mi.Float(cell // sides) + 0.5) * step
    point = dr.zeros(mi.SurfaceInteraction3f, surface.count)
    point.p = surface.position
    found, light = lamp.sample_direction(point, mi.Point2f(u, v), mi.Bool(True))
    direction = mi.Vector3f(found.d)
    free = dr.dot(surface.normal, direction) > 0
    free &= dr.dot(surface.geometric_normal, direction) > 0
    if occluded:
        origin = surface.position + surface.offset * surface.geometric_normal
        ray = mi.Ray3f(origin, direction, found.dist * (1 - END), 0.0, [])
        free &= ~scene.ray_test(ray, coherent=True, active=free)
    part = step * step
    solid = dr.select(found.delta, 0, part * dr.rcp(dr.maximum(found.pdf, 1e-12)))
    radius = dr.minimum(dr.sqrt(solid / np.pi), np.pi / 2)
    return direction, radius, dr.select(free, light * part, 0)
