"""Path-traced radiance along camera rays, in scenes whose object has one uniform material."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.replace_material import replace_material
from svu_mi.parameters import PARAMETERS

LANES = 1 << 20  # paths per launch


def trace(
    scene: Any, integrator: Any, rays: Any, samples: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return means of two independent halves of ``samples`` paths per ray: (P, 3) radiance each.

    Random numbers differ between lanes, not between materials: part of the noise cancels in the
    differences between materials, which determine the posterior.
    """
    count, half = dr.width(rays.o), samples // 2
    result = np.zeros((count, 2, 3))
    size = max(LANES // samples, 1)
    sampler = mi.load_dict({"type": "independent"})
    number = dr.opaque(mi.UInt32, samples)
    for slot, first in enumerate(range(0, count, size)):
        span = slice(first, min(first + size, count))
        lanes = (span.stop - first) * samples
        own = np.random.default_rng((seed, slot)).integers(2**32)
        sampler.seed(dr.opaque(mi.UInt32, int(own)), lanes)
        index = dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, lanes) // number
        ray = mi.RayDifferential3f(dr.gather(mi.Ray3f, rays, index))
        radiance, _, _ = integrator.sample(scene, sampler, ray)
        # Evaluate now: a lazy result would use the material of a later call.
        sums = [dr.block_sum(radiance[channel], half) for channel in range(3)]
        dr.eval(sums)
        result[span] = np.stack([x.numpy().reshape(-1, 2) for x in sums], axis=-1) / half
    return result[:, 0], result[:, 1]


@dataclass(frozen=True)
class UniformScene:
    """Copy of a capture's scene whose object has one material; other shapes are shared.

    Attributes:
        scene: ``mi.Scene``.
        shape: Object in ``scene``.
        params: ``mi.SceneParameters`` of the object's material.
    """

    scene: Any
    shape: Any
    params: Any

    @staticmethod
    def of(capture: Capture) -> "UniformScene":
        """Return a scene with a copy of the object; the capture is not modified."""
        # Mitsuba permanently omits lobes whose parameter is 0 when the material is created.
        middle = {
            p.name: 0.5 if p.channels == 1 else {"type": "rgb", "value": 0.5}
            for p in PARAMETERS.values()
        }
        material = mi.load_dict({"type": "principled", "specular": 0.5} | middle)
        made = replace_material(capture, material, capture.shape)
        return UniformScene(scene=made.scene, shape=made.shape, params=mi.traverse(material))

    def paint(self, psi: Mapping[str, float]) -> None:
        """Set the material of the object; missing parameters get their defaults."""
        for p in PARAMETERS.values():
            key = p.name if p.name in self.params else f"{p.name}.value"
            # Opaque: with literals, every psi would compile new kernels.
            kind = mi.Float if p.channels == 1 else mi.Color3f
            self.params[key] = dr.opaque(kind, psi.get(p.name, p.default))
        self.params.update()
