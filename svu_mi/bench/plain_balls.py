"""Balls of one material: dark dielectrics, which look like dark metals, and real metals."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product, repeat

import mitsuba as mi
import numpy as np

from svu_mi.bench.captures import capture_in_memory
from svu_mi.bench.experiment import CaseSubject, Measurement, Record
from svu_mi.bench.spoiled_captures import photographed
from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.scene import find_environment, load_scene
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.geometry.texels import texels
from svu_mi.pipeline import estimate
from svu_mi.scenes.meshes import revolve, sheet

VIEWS, FILM, SPP, TEXELS = 24, 80, 32, 48
QUICK_FILM = 32
DARK = [(0.0, (base,) * 3, roughness)
        for base, roughness in product((0.0, 0.03, 0.1), (0.1, 0.25, 0.4, 0.6))]  # fmt: skip
# Linear sRGB reflectance at normal incidence [Lagarde 2011].
GOLD, COPPER, IRON, ALUMINIUM, CHROMIUM = (
    (1.0, 0.766, 0.336), (0.955, 0.637, 0.538), (0.56, 0.57, 0.58), (0.913, 0.921, 0.925),
    (0.55, 0.556, 0.554),
)  # fmt: skip
BARE = [(1.0, color, roughness) for color, roughness in
        product((GOLD, COPPER, IRON, ALUMINIUM, CHROMIUM), (0.1, 0.3, 0.6))]  # fmt: skip

Material = tuple[float, tuple[float, float, float], float]


@dataclass(frozen=True)
class BallCase(CaseSubject):
    """Balls under the light of a case: metallic is compared with the truth."""

    rows = (
        Measurement("dark dielectrics", lambda self: self.mean_of(DARK)),
        Measurement("real metals", lambda self: self.mean_of(BARE)),
    )

    @property
    def name(self) -> str:
        return f"balls__{self.case.light}"

    @property
    def title(self) -> str:
        return f"balls / {self.case.light}"

    def mean_of(self, materials: list[Material]) -> Record:
        """Return the share of intervals of metallic with the truth, and the lowest of a ball."""
        of_balls = [self._held(one) for one in materials[:: 5 if self.bench.quick else 1]]
        held, squares = np.array(of_balls).T
        return {"interval m": float(held.mean()), "worst": float(held.min()),
                "psnr m": float(-10 * np.log10(squares.mean()))}  # fmt: skip

    def _held(self, material: Material) -> tuple[float, float]:
        metallic, color, roughness = material
        shape = make_mesh("ball", _ball())
        shape.set_bsdf(mi.load_dict({
            "type": "principled", "metallic": metallic, "roughness": roughness,
            "base_color": {"type": "rgb", "value": list(color)},
        }))  # fmt: skip
        light = find_environment(load_scene(self.case.scene, self.case.defines), "scene")
        scene = make_scene([shape, light])
        film = QUICK_FILM if self.bench.quick else FILM
        sensors = sphere_sensors(shape, VIEWS, (film, film))
        blank = [np.zeros((film, film, 3), np.float32)] * VIEWS
        capture = capture_in_memory(scene, shape, sensors, blank)
        capture = photographed(capture, repeat(scene), SPP)
        found = estimate(capture, texels(shape, TEXELS)).posterior
        seen = np.flatnonzero(found.observed)
        low, high = (np.array(end) for end in found.interval("metallic", 0.9, seen))
        error = np.array(found.mean("metallic"), np.float64)[seen] - metallic
        held = (low <= metallic + 1e-6) & (metallic - 1e-6 <= high)
        return float(held.mean()), float(np.square(error).mean())


def _ball() -> MeshArrays:
    """Return a ball of radius 1 with a lat-long chart."""
    theta = np.linspace(0, np.pi, 33)
    profile = np.stack([np.sin(theta), np.cos(theta)], axis=-1)
    points, faces, uvs = sheet(revolve(profile, 64), (0, 0), (1, 1))
    return MeshArrays(points, faces, points.copy(), uvs)
