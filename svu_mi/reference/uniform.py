"""The capture's scene with its object in one uniform ``principled`` material."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.mesh import arrays, make


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
        shape = make(capture.shape.id(), arrays(capture.shape))
        shape.set_bsdf(_as_sided_as(capture.shape.bsdf(), material))
        parts: dict[str, Any] = {"type": "scene", "object": shape}
        # An area light belongs to its shape and comes with it.
        lights = [e for e in capture.scene.emitters() if e.is_environment()]
        others = [s for s in capture.scene.shapes() if not is_same(s, capture.shape)]
        parts |= {f"light_{index}": light for index, light in enumerate(lights)}
        parts |= {f"other_{index}": other for index, other in enumerate(others)}
        return UniformScene(
            scene=mi.load_dict(parts, optimize=False), shape=shape, params=mi.traverse(material)
        )

    def paint(self, roughness: float, metallic: float, base_color: float) -> None:
        """Change the material; all values in [0, 1], ``base_color`` grey and linear."""
        # Opaque: as literals, every psi would compile kernels of its own.
        self.params["roughness.value"] = dr.opaque(mi.Float, roughness)
        self.params["metallic.value"] = dr.opaque(mi.Float, metallic)
        self.params["base_color.value"] = dr.opaque(mi.Color3f, base_color)
        self.params.update()


def is_same(a: Any, b: Any) -> bool:
    """Return whether two Python objects stand for one Mitsuba shape."""
    return bool(np.array(mi.ShapePtr(a) == mi.ShapePtr(b)).all())


def is_two_sided(bsdf: Any) -> bool:
    """Return whether a BSDF reflects on the back of its surface, too."""
    return bsdf is not None and "TwoSided" in bsdf.class_name()


def _as_sided_as(bsdf: Any, material: Any) -> Any:
    """Light that enters an open object meets its inside, at least in paths of several bounces."""
    if not is_two_sided(bsdf):
        return material
    return mi.load_dict({"type": "twosided", "material": material})
