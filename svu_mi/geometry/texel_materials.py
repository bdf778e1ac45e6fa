"""Parameters of a scene's principled BSDF at texels."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.normal_map import layers
from svu_mi.capture.replace_material import is_principled
from svu_mi.errors import SceneError
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import CHANNELS


def parameters_at(capture: Capture, texels: Texels) -> dict[str, np.ndarray]:
    """Return BSDF parameters at texels by name, (T, 3) or (T,) float64."""
    label = f"Shape '{capture.shape.id()}'"
    if capture.mesh is not capture.shape:
        raise SceneError(
            f"{label} was unwrapped, so its texels do not match its textures; give the mesh "
            "the UVs of the textures."
        )
    bsdf = layers(capture.shape.bsdf())[-1]
    if not is_principled(bsdf):
        raise SceneError(f"{label} has no principled BSDF; its parameters are unknown.")
    si = dr.zeros(mi.SurfaceInteraction3f, texels.count)
    si.uv = texels.uv
    parameters = {}
    for name, values in principled_attributes(bsdf, si).items():
        # A constant texture returns a single value.
        columns = [
            np.broadcast_to(np.array(x, np.float64).ravel(), (texels.count,)) for x in values
        ]
        parameters[name] = np.stack(columns, axis=-1) if len(columns) > 1 else columns[0].copy()
    return parameters


def principled_attributes(bsdf: Any, si: Any, active: Any = True) -> dict[str, list[Any]]:
    """Return ``principled`` parameters at ``si`` by name, one Float per channel."""
    return {
        name: list(bsdf.eval_attribute(name, si, active)) if channels > 1
        else [bsdf.eval_attribute_1(name, si, active)]
        for name, channels in CHANNELS.items()
    }  # fmt: skip
