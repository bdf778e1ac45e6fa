"""The capture's scene with its object in one uniform ``principled`` material."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.capture import Capture
from svu_mi.capture.repaint import repaint
from svu_mi.parameters import PARAMETERS


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
        made = repaint(capture, material, capture.shape)
        return UniformScene(scene=made.scene, shape=made.shape, params=mi.traverse(material))

    def paint(self, psi: Mapping[str, float]) -> None:
        """Change the material.

        Args:
            psi: values in [0, 1] by parameter, a colour's grey and linear; others are at their
                default.
        """
        for p in PARAMETERS.values():
            key = p.name if p.name in self.params else f"{p.name}.value"
            # Opaque: as literals, every psi would compile kernels of its own.
            kind = mi.Float if p.channels == 1 else mi.Color3f
            self.params[key] = dr.opaque(kind, psi.get(p.name, p.default))
        self.params.update()
