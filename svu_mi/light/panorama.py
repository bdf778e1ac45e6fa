"""Light of shapes around the object, as they reflect it towards the object's centre.

They have the same radiance in directions to the object [Lagarde and Zanuttini 2012], which is exact
for diffuse surfaces. Of surfaces behind each other, seen from the centre without the object, all
have the radiance of the nearest.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.replace_material import make_scene, other_shapes
from svu_mi.core.arrays import fold, to_drjit
from svu_mi.light.band_limited import lat_long_texture, look_up
from svu_mi.light.latlong import directions

ROWS, PATHS = 65, 128  # rows of the map, about as fine as lobes of alpha .05; paths of each node
BEFORE = 1e-3  # start of paths before a surface, relative to its distance from the centre
LEAST = 1e-3  # minimum coverage of a node that is read


@dataclass(frozen=True)
class Panorama:
    """Radiance of shapes around a centre.

    Attributes:
        center: Point3f.
        texture: lat-long Texture2f of R, G, B and coverage, which are 0 where no shape is.
    """

    center: Any
    texture: Any

    def radiance(self, point: Any, active: Any) -> Any:
        """Return the radiance of points of other shapes towards the object, Color3f."""
        *color, covered = look_up(self.texture, dr.normalize(point - self.center))
        shown = active & (covered > LEAST)
        return dr.select(shown, mi.Color3f(*color) / covered, 0)


def trace_panorama(capture: Capture, scene: Any, integrator: Any) -> Panorama:
    """Trace paths to the shapes around the object, except lamps.

    ``scene`` and ``integrator`` are those of ``surroundings``.
    """
    rest = make_scene([x for x in other_shapes(capture.scene, capture.shape) if not x.is_emitter()])
    center = mi.Point3f(capture.mesh.bbox().center())
    dr.make_opaque(center)
    toward = directions(2 * (ROWS - 1), ROWS)
    world = to_drjit(mi.Vector3f, toward.reshape(-1, 3).T.astype(np.float32))
    met = rest.ray_intersect_preliminary(mi.Ray3f(center, world))
    ray = mi.RayDifferential3f(center + (1 - BEFORE) * met.t * world, world)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, 0), dr.width(world))

    def add(path: Any, sampler: Any, total: Any) -> tuple[Any, ...]:
        color, _, _ = integrator.sample(scene, sampler, ray, None, met.is_valid())
        return path + 1, sampler, total + dr.select(dr.all(dr.isfinite(color)), color, 0)

    number = dr.opaque(mi.UInt32, PATHS)
    _, total = fold(0, number, add, sampler, dr.zeros(mi.Color3f, dr.width(world)))
    values = [*(total / mi.Float(number)), mi.Float(met.is_valid())]
    dr.eval(values)  # together, so that paths are traced once
    pixels = np.stack([x.numpy() for x in values], axis=1)
    return Panorama(center, lat_long_texture(pixels.reshape(*toward.shape[:2], 4)))
