"""SVBRDF textures: base colour, roughness and metallic over a UV map."""

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError, ShapeError
from svu_mi.geometry.dilate import dilate
from svu_mi.geometry.texel_materials import parameters_at
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import CHANNELS, NAMES, PARAMETERS, ByParameter


class Textures(ByParameter):
    """Parameters of Mitsuba's ``principled`` BSDF over a UV map, all in [0, 1].

    Each parameter is a TensorXf, read as an item or an attribute: ``base_color`` is (H, W, 3),
    linear RGB; roughness and metallic are (H, W, 1). Row 0 is v = 0.

    Raises:
        ShapeError: A tensor has another shape.
    """

    def __init__(self, **tensors: Any) -> None:
        super().__init__(**tensors)
        height, width = tuple(self.base_color.shape)[:2]
        for name, tensor in self.items():
            wanted = (height, width, CHANNELS[name])
            if tuple(tensor.shape) != wanted:
                raise ShapeError(
                    f"Textures: {name} must have shape {wanted}, got {tuple(tensor.shape)}."
                )

    @classmethod
    def of(cls, images: Mapping[str, np.ndarray]) -> "Textures":
        """Create textures from copies of NumPy images (H, W, C), by name."""
        return cls(**{
            name: mi.TensorXf(to_drjit(mi.Float, images[name].ravel()), shape=images[name].shape)
            for name in NAMES
        })  # fmt: skip

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height in texels."""
        height, width = tuple(self.base_color.shape)[:2]
        return width, height

    def with_constant(self, values: Mapping[str, float]) -> "Textures":
        """Return the textures with some parameters replaced by constants, by name."""
        return self.but(**{n: dr.full(type(self[n]), x, self[n].shape) for n, x in values.items()})

    def require_resolution(self, texels: Texels) -> None:
        """Raise a ShapeError if the resolution differs from the texels'."""
        if self.resolution != texels.resolution:
            raise ShapeError(
                f"The textures have {self.resolution} texels, but {texels.resolution} were "
                "requested; create texels at the textures' resolution, or resample the textures."
            )

    def at(self, texels: Texels, name: str) -> np.ndarray:
        """Return the values of a parameter at the texels: (T, 3), or (T,) for one channel."""
        values = np.array(self[name]).reshape(-1, CHANNELS[name])[texels.index.numpy()]
        return values if CHANNELS[name] > 1 else values[:, 0]


def lay_out(texels: Texels, values: Mapping[str, Any]) -> Textures:
    """Create textures from values of texels; gutters copy the nearest texel.

    Args:
        texels: T texels.
        values: Finite values by name: base_color (T, 3), others (T,) or (T, 1); clipped to [0, 1].

    Raises:
        OptionError: A value is NaN or infinite.
    """
    return Textures.of({name: _texture(texels, values, name) for name in NAMES})


def uniform_textures(texels: Texels, value: float | None = None) -> Textures:
    """Return constant textures: ``value``, or the default of each parameter."""
    width, height = texels.resolution
    return Textures.of({
        p.name: np.full((height, width, p.channels), p.default if value is None else value, "f4")
        for p in PARAMETERS.values()
    })  # fmt: skip


def scene_textures(capture: Capture, texels: Texels) -> Textures:
    """Evaluate the material of the scene at every texel.

    Args:
        capture: Capture whose shape has a ``principled`` BSDF, and UVs if the BSDF has bitmaps.
        texels: Texels of ``capture.mesh``.
    """
    return lay_out(texels, parameters_at(capture, texels))


def _texture(texels: Texels, values: Mapping[str, Any], name: str) -> np.ndarray:
    flat = np.array(values[name], np.float32).reshape(texels.count, CHANNELS[name])
    if not np.isfinite(flat).all():
        raise OptionError(f"lay_out(): {name} is NaN or infinite at some texels.")
    image = texels.to_image(np.clip(flat, PARAMETERS[name].low, PARAMETERS[name].high))
    return dilate(image, texels.inside(), float(np.hypot(*image.shape[:2])))
