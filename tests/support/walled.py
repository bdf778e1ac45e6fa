"""A ball next to a wall in studio light, its photographs, and all samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from oracle import angular as oracle
from oracle.levels import place as place_of

import svu_mi as svu
from support.helpers import STUDIO, memory_capture, write_ball
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset
from svu_mi.statistics.gather_statistics import SMALLEST
from svu_mi.statistics.statistics import EDGES

ROUGHNESS = np.array([0.0, 0.3, 0.6, 1.0])
PAINT = {"type": "principled"}
GLOSSY = {"type": "principled", "base_color": {"type": "rgb", "value": [0.9, 0.7, 0.4]},
          "metallic": 1.0, "roughness": 0.25}  # fmt: skip
BLACK = {"type": "diffuse", "reflectance": 0.0}
SIZE = 12  # texels per side of the ball's chart


def angular(base="fixed", **switches):
    return preset(base, method="angular", **switches)


def walled_ball(folder):
    """A ball, and a black wall beside it that hides light from some of its texels."""
    wall = mi.ScalarTransform4f().translate([1.6, 0, 0]).rotate([0, 1, 0], -90).scale(1.5)
    return mi.load_dict(
        {
            "type": "scene",
            "light": STUDIO,
            "ball": {"type": "ply", "filename": str(write_ball(folder)), "bsdf": PAINT},
            "wall": {"type": "rectangle", "to_world": wall, "bsdf": BLACK},
        },
        optimize=False,
    )


def noise_capture(scene, chosen=range(14), seed=60221, size=24, bright=0, places=14):
    """Photographs of nothing but noise: no model fits them, every term of the error counts.

    From the chosen ones of some places around the ball; nobody sees it from behind the wall.
    """
    rng = np.random.default_rng(seed)
    ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
    sensors = sphere_sensors(ball, places, (size, size))
    images = rng.exponential(size=(places, size, size, 3)).astype(np.float32)
    if bright:
        images[rng.random(images.shape[:3]) < 0.1] *= bright
    return memory_capture(
        scene, [images[k] for k in chosen], [sensors[k] for k in chosen], shape=ball, mesh=ball
    )


def seen_in(capture, resolution=SIZE):
    return observe(capture, svu.texels(capture.mesh, resolution))


class Samples:
    """What ``gather`` sees of the texels of ``seen``, as float64 arrays.

    Attributes:
        seen: (V, S).
        w: (V, S) weights.
        b: (V, C, S).
        columns: e, p, q, d, (V, R, C, S) each.
    """

    def __init__(self, observed, switches, kappa=np.inf, current=None, roughness=ROUGHNESS):
        channels = switches.colors
        model = observed.model(roughness, switches, channels)
        mirrors = observed.mirrors if switches.traced and switches.occluded else None
        surface, rows = observed.surface, []
        for slot in range(int(observed.visibility.count[0])):
            place = dr.opaque(mi.UInt32, slot)
            seen = observed.visibility.sample(observed.views, surface, place)
            free = mi.Bool(True) if mirrors is None else mirrors.test(place, surface.index)
            cosine = dr.maximum(seen.cosine, 1e-3)
            columns = model.columns(seen.direction, cosine, free, bend=seen.bend)
            b = as_channels(seen.radiance, channels)
            dr.eval(seen, b, columns)
            fields = np.array([
                [[np.broadcast_to(x.numpy(), surface.count) for x in column] for column in level]
                for level in columns
            ])  # fmt: skip
            rows.append((
                seen.seen.numpy(), np.array([x.numpy() for x in b]), fields, seen.contrast.numpy()
            ))  # fmt: skip
        seen, b, columns, contrast = (np.array(x) for x in zip(*rows, strict=True))
        self.seen, self.b = seen, b.astype(np.float64)
        self.columns = list(np.moveaxis(columns.astype(np.float64), 3, 0))
        self.w = seen.astype(np.float64)
        if np.isfinite(kappa):
            self.w /= 1 + (self.b.mean(axis=1) ** 2 + EDGES * contrast.astype(float)) / kappa**2
        self.levels = len(roughness)
        if current is not None:
            self.w *= kappa / np.maximum(self._off(current), SMALLEST * kappa)

    def _off(self, current):
        """(V, S) mean absolute error of parameters (5, S), between levels."""
        place = place_of(current[3], self.levels)
        share = np.maximum(1 - np.abs(place - np.arange(self.levels)[:, None]), 0)  # (R, S)
        r = oracle.modelled(self.columns, current[:3], current[4])  # (V, R, C, S)
        return np.abs((share[:, None] * r).sum(axis=1) - self.b).mean(axis=1)

    def of(self, texel):
        """w, columns (R, C, n) and b (C, n) of the views that see a texel."""
        on = self.seen[:, texel]
        columns = [np.moveaxis(x[on, ..., texel], 0, -1) for x in self.columns]
        return self.w[on, texel], columns, self.b[on, :, texel].T
