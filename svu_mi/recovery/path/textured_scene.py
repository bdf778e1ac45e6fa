"""Copy of a scene in which the object's material is made of texture tensors."""

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
    """Copy of a capture's scene with an exchangeable ``principled`` material.

    Attributes:
        scene: ``mi.Scene``.
        shape: Object in the scene.
        params: ``mi.SceneParameters`` of the object's BSDF.
        resolution: Width and height of the textures, in texels.
    """

    scene: Any
    shape: Any
    params: Any
    resolution: tuple[int, int]

    @staticmethod
    def of(capture: Capture, start: Textures) -> "PathScene":
        """Copy the scene of a capture and set all textures to ``start``."""
        material = mi.load_dict(
            {"type": "principled", "specular": 0.5}
            | {name: _bitmap(tensor) for name, tensor in start.items()}
        )
        made = replace_material(capture, material)
        params = mi.traverse(material)
        # Keep only textures: update() evaluates all entries.
        params.keep([key_of(name) for name in NAMES])
        painted = PathScene(made.scene, made.shape, params, start.resolution)
        painted.paint(dict(start.items()))
        return painted

    def paint(self, textures: Mapping[str, Any]) -> None:
        """Replace textures; renders are differentiable in the given tensors."""
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
    """Return the ``mi.traverse`` key of a texture of the material."""
    return f"{name}.data"


def _bitmap(tensor: Any) -> dict[str, Any]:
    # Initial value 0.5: Mitsuba permanently disables lobes whose parameter is 0 at creation.
    half = dr.full(mi.TensorXf, 0.5, shape=tuple(tensor.shape))
    # "variant" stores float32; 8- and 16-bit textures are not differentiable.
    return {"type": "bitmap", "data": half, "raw": True, "format": "variant",
            "filter_type": "bilinear", "wrap_mode": "repeat"}  # fmt: skip
