"""A copy of the scene whose object has texture tensors as its material."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.capture.capture import Capture
from svu_mi.capture.replace_material import replace_material
from svu_mi.errors import ShapeError
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.svbrdf_textures import Textures


@dataclass(frozen=True)
class PathScene:
    """The capture's scene with a ``principled`` object; the capture itself is not modified.

    Attributes:
        scene: the ``mi.Scene``.
        shape: the object in it.
        params: the ``mi.SceneParameters`` of its ``principled`` BSDF.
        resolution: (W, H) of its textures, in texels.
    """

    scene: Any
    shape: Any
    params: Any
    resolution: tuple[int, int]

    @staticmethod
    def of(capture: Capture, start: Textures) -> PathScene:
        """Copy the scene; parameters keep the values of ``start`` until they are painted."""
        material = mi.load_dict(
            {"type": "principled", "specular": 0.5}
            | {name: _bitmap(tensor) for name, tensor in start.items()}
        )
        made = replace_material(capture, material)
        params = mi.traverse(material)
        # update() evaluates whatever it holds.
        params.keep([key_of(name) for name in NAMES])
        painted = PathScene(made.scene, made.shape, params, start.resolution)
        painted.paint(dict(start.items()))
        return painted

    def paint(self, textures: Mapping[str, Any]) -> None:
        """Replace textures, differentiably: gradients of a render reach these tensors."""
        width, height = self.resolution
        for name, tensor in textures.items():
            wanted = (height, width, CHANNELS[name])
            if tuple(tensor.shape) != wanted:
                raise ShapeError(
                    f"The texture {name} must have shape {wanted}, got {tuple(tensor.shape)}."
                )
            self.params[key_of(name)] = tensor
        self.params.update()


def key_of(name: str) -> str:
    """Return what ``mi.traverse`` calls a texture of the material."""
    return f"{name}.data"


def _bitmap(tensor: Any) -> dict[str, Any]:
    # Made of 0.5: Mitsuba leaves lobes out for good whose parameter is 0 when a material is made.
    half = dr.full(mi.TensorXf, 0.5, shape=tuple(tensor.shape))
    # format: 8- and 16-bit textures would not be differentiable.
    return {"type": "bitmap", "data": half, "raw": True, "format": "variant",
            "filter_type": "bilinear", "wrap_mode": "repeat"}  # fmt: skip
