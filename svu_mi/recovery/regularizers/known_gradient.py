"""Differentiable scalars with a known gradient, and regularisers made of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.errors import OptionError, ShapeError
from svu_mi.geometry.neighbors import Neighbors, neighbors
from svu_mi.geometry.texels import Texels


def with_known_gradient(value: Any, slopes: Sequence[Any], values: Sequence[Any]) -> Any:
    """Return a detached scalar with derivatives ``slopes`` for ``values``, Floats of equal widths.

    The backward pass is one multiplication per value and adds nothing up, so it is the same
    bit by bit in every run, with any number of threads.
    """
    inner = [slope * dr.replace_grad(dr.zeros(mi.Float, dr.width(x)), x)
             for slope, x in zip(slopes, values, strict=True)]  # fmt: skip
    return dr.replace_grad(value, dr.sum(sum(inner)))


def sign(value: Any) -> Any:
    """Return the derivative of an absolute value: -1, 1, or 0 at 0, where ``dr.sign`` is 1."""
    return dr.select(value == 0, 0, dr.sign(value))


class Regularizer:
    """A loss of one texture, whose value and gradient are computed together by ``_of``."""

    def __call__(self, texture: Any) -> Any:
        """Return the loss of a texture.

        Args:
            texture: (H, W) or (H, W, C) TensorXf, at the resolution of the texels.

        Returns:
            A Float of one value, differentiable in the texture.
        """
        name, (width, height) = type(self).__name__, self._texels().resolution
        if not isinstance(texture, mi.TensorXf):
            raise OptionError(
                f"{name}: expected a texture as mi.TensorXf, got {type(texture).__name__}; "
                "wrap it in mi.TensorXf."
            )
        shape = tuple(texture.shape)
        if len(shape) not in (2, 3) or shape[:2] != (height, width) or 0 in shape:
            raise ShapeError(
                f"{name}: expected a texture of shape ({height}, {width}) or ({height}, {width}, "
                f"C), got {shape}; lay out svu.texels at the resolution of the textures."
            )
        channels = int(shape[2]) if len(shape) == 3 else 1
        value, gradient = self._of(dr.detach(texture.array), channels)
        dr.make_opaque(gradient)  # a literal 0 would cut the dependence on the texture
        return with_known_gradient(value, [gradient], [texture.array])

    def _texels(self) -> Texels:
        raise NotImplementedError

    def _of(self, values: Any, channels: int) -> tuple[Any, Any]:
        """Return the value, and the gradient by all values."""
        raise NotImplementedError

    def _neighbors(self, mesh: Any) -> Neighbors:
        """Return the neighbours of the texels on a mesh, which may be given instead of it."""
        texels = self._texels()
        around = mesh if isinstance(mesh, Neighbors) else neighbors(texels, mesh)
        if around.count != texels.count:
            raise ShapeError(
                f"{type(self).__name__}: expected the neighbours of {texels.count} texels, got "
                f"those of {around.count}."
            )
        return around
