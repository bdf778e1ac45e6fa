"""Path-traced radiance along camera rays, of scenes with one material all over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.replace_material import replace_material
from svu_mi.parameters import PARAMETERS

LANES = 1 << 20  # paths in memory at a time


def trace(
    scene: Any, integrator: Any, rays: Any, samples: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Average two independent halves of ``samples`` paths per ray: (P, 3) radiance each.

    Every lane has random numbers of its own, the same for every material: part of the noise
    cancels in the differences between materials, which are all that a posterior depends on.
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
        # Read now: a lazy result would be computed with the material of a later call.
        sums = [dr.block_sum(radiance[channel], half) for channel in range(3)]
        dr.eval(sums)
        result[span] = np.stack([x.numpy().reshape(-1, 2) for x in sums], axis=-1) / half
    return result[:, 0], result[:, 1]


@dataclass(frozen=True)
class UniformScene:
    """A scene of its own; it shares the emitters and the other shapes with the capture's.

    Attributes:
        scene: the ``mi.Scene``.
        shape: the object in it.
        params: the ``mi.SceneParameters`` of its material.
    """

    scene: Any
    shape: Any
    params: Any

    @staticmethod
    def of(capture: Capture) -> UniformScene:
        """Copy the object and give it a material; nothing of the capture is modified."""
        # Mitsuba leaves lobes out for good whose parameter is 0 when the material is made.
        middle = {
            p.name: 0.5 if p.channels == 1 else {"type": "rgb", "value": 0.5}
            for p in PARAMETERS.values()
        }
        material = mi.load_dict({"type": "principled", "specular": 0.5} | middle)
        made = replace_material(capture, material, capture.shape)
        return UniformScene(scene=made.scene, shape=made.shape, params=mi.traverse(material))

    def paint(self, psi: Mapping[str, float]) -> None:
        """Change the material."""
        for p in PARAMETERS.values():
            key = p.name if p.name in self.params else f"{p.name}.value"
            # Opaque: as literals, every psi would compile kernels of its own.
            kind = mi.Float if p.channels == 1 else mi.Color3f
            self.params[key] = dr.opaque(kind, psi.get(p.name, p.default))
        self.params.update()
