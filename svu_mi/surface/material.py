"""What a scene's own material says of every texel."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.material import is_principled
from svu_mi.errors import SceneError
from svu_mi.surface.layout import Texels


def parameters_at(capture: Capture, texels: Texels) -> dict[str, np.ndarray]:
    """Evaluate the target's BSDF parameters at every texel's centre.

    Args:
        capture: its ``shape`` must have a ``principled`` BSDF, and its own UVs.
        texels: T texels of ``capture.mesh``.

    Returns:
        base_color (T, 3), linear, roughness (T,) and metallic (T,), float64.

    Raises:
        SceneError: another BSDF, or a mesh that was unwrapped anew.
    """
    label = f"Shape '{capture.shape.id()}'"
    if capture.mesh is not capture.shape:
        raise SceneError(
            f"{label} was unwrapped anew, so its texels have no place in its textures; give it "
            "UVs of its own."
        )
    bsdf = capture.shape.bsdf()
    if not is_principled(bsdf):
        raise SceneError(f"{label} has no principled BSDF, so its parameters are unknown.")
    si = dr.zeros(mi.SurfaceInteraction3f, texels.count)
    si.uv = texels.uv
    return {
        "base_color": _columns(bsdf.eval_attribute("base_color", si), texels.count),
        "roughness": _column(bsdf.eval_attribute_1("roughness", si), texels.count),
        "metallic": _column(bsdf.eval_attribute_1("metallic", si), texels.count),
    }


def _column(value: Any, count: int) -> np.ndarray:
    """Copy to (T,) float64; a uniform texture gives one value for all."""
    return np.broadcast_to(np.array(value, np.float64).ravel(), (count,)).copy()


def _columns(color: Any, count: int) -> np.ndarray:
    return np.stack([_column(channel, count) for channel in color], axis=-1)
