"""The capture's scene with its object in one uniform ``principled`` material."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.capture import Capture
from svu_mi.capture.repaint import repaint


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
        material = mi.load_dict(
            {
                "type": "principled",
                "base_color": {"type": "rgb", "value": 0.5},
                "roughness": 0.5,
                "metallic": 0.5,
                "specular": 0.5,
            }
        )
        made = repaint(capture, material, capture.shape)
        return UniformScene(scene=made.scene, shape=made.shape, params=mi.traverse(material))

    def paint(self, roughness: float, metallic: float, base_color: float) -> None:
        """Change the material; all values in [0, 1], ``base_color`` grey and linear."""
        # Opaque: as literals, every psi would compile kernels of its own.
        self.params["roughness.value"] = dr.opaque(mi.Float, roughness)
        self.params["metallic.value"] = dr.opaque(mi.Float, metallic)
        self.params["base_color.value"] = dr.opaque(mi.Color3f, base_color)
        self.params.update()
