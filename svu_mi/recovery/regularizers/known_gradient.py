"""Differentiable scalars with an explicit gradient; base class of regularisers."""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.errors import OptionError, ShapeError
from svu_mi.geometry.neighbors import Neighbors, neighbors
from svu_mi.geometry.texels import Texels


def with_known_gradient(value: Any, slopes: Sequence[Any], values: Sequence[Any]) -> Any:
    """Return scalar ``value`` with derivatives ``slopes`` with respect to ``values``.

    The backward pass is one multiplication per value, without sums. Its result is bitwise
    reproducible with any number of threads.
    """
    inner = [slope * dr.replace_grad(dr.zeros(mi.Float, dr.width(x)), x)
             for slope, x in zip(slopes, values, strict=True)]  # fmt: skip
    return dr.replace_grad(value, sum(map(dr.sum, inner)))


def sign(value: Any) -> Any:
    """Return -1, 0 or 1, the derivative of abs; ``dr.sign`` returns 1 at 0."""
    return dr.select(value == 0, 0, dr.sign(value))


class Regularizer:
    """Loss of one texture. Subclasses compute value and gradient together in ``_of``."""

    texels: Texels

    def __call__(self, texture: Any) -> Any:
        """Return the loss of a texture, a differentiable Float of width 1.

        Args:
            texture: (H, W) or (H, W, C) TensorXf, at the resolution of the texels.

        Raises:
            OptionError: The texture is not a TensorXf, such as an 8-bit one without gradient.
            ShapeError: The texture has another resolution.
        """
        name, (width, height) = type(self).__name__, self.texels.resolution
        if not isinstance(texture, mi.TensorXf):
            remedy = "wrap it in mi.TensorXf."
            if dr.is_tensor_v(type(texture)) and not dr.is_float_v(type(texture)):
                remedy = 'no gradient passes; set format="variant" on its bitmap.'
            raise OptionError(
                f"{name}: expected a texture as mi.TensorXf, got {type(texture).__name__}; {remedy}"
            )
        shape = tuple(texture.shape)
        if len(shape) not in (2, 3) or shape[:2] != (height, width) or 0 in shape:
            raise ShapeError(
                f"{name}: expected a texture of shape ({height}, {width}) or ({height}, {width}, "
                f"C), got {shape}; create svu.texels at the resolution of the textures."
            )
        channels = int(shape[2]) if len(shape) == 3 else 1
        value, gradient = self._of(dr.detach(texture.array), channels)
        dr.make_opaque(gradient)  # a literal 0 would cut the dependence on the texture
        return with_known_gradient(value, [gradient], [texture.array])

    def _of(self, values: Any, channels: int) -> tuple[Any, Any]:
        """Return the loss, and its derivatives in all values."""
        raise NotImplementedError

    def _neighbors(self, mesh: Any) -> Neighbors:
        """Return the neighbours of the texels; a ``Neighbors`` is returned unchanged."""
        around = mesh if isinstance(mesh, Neighbors) else neighbors(self.texels, mesh)
        if around.count != self.texels.count:
            raise ShapeError(
                f"{type(self).__name__}: expected neighbours of {self.texels.count} texels, got "
                f"neighbours of {around.count}."
            )
        return around
