"""Losses whose gradient is known: a number, and its derivative by every value of a texture."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.errors import OptionError, ShapeError


class _Known(dr.CustomOp):  # type: ignore[misc]
    """A scalar function of a texture, of which everything has been computed."""

    def eval(self, texture: Any, value: Any, gradient: Any) -> Any:  # noqa: ARG002
        self.gradient = gradient
        return value + 0

    def forward(self) -> None:
        change = self.grad_in("texture").array
        self.set_grad_out(dr.sum(self.gradient * change))

    def backward(self) -> None:
        change = self.gradient * self.grad_out()
        self.set_grad_in("texture", mi.TensorXf(change, self.shape()))

    def shape(self) -> tuple[int, ...]:
        return tuple(self.grad_in("texture").shape)

    def name(self) -> str:
        return "svu_mi regularizer"


def known(texture: Any, value: Any, gradient: Any) -> Any:
    """Return a scalar that carries a gradient computed beforehand.

    Its backward pass is one multiplication per value and adds nothing up, so it is the same
    bit by bit in every run, with any number of threads.

    Args:
        texture: TensorXf, differentiable or not.
        value: the scalar, detached.
        gradient: (N,) Float, its derivative by the N values of the texture.
    """
    return dr.custom(_Known, texture, value, gradient)


def check_texture(name: str, texture: Any, resolution: tuple[int, int]) -> int:
    """Return the number of channels of a texture (H, W) or (H, W, C).

    Raises:
        OptionError: not a float tensor of the active variant.
        ShapeError: another resolution.
    """
    width, height = resolution
    if not isinstance(texture, mi.TensorXf):
        raise OptionError(
            f"{name}: expected a texture as mi.TensorXf, got {type(texture).__name__}; "
            "wrap it in mi.TensorXf."
        )
    shape = tuple(texture.shape)
    if len(shape) not in (2, 3) or shape[:2] != (height, width) or 0 in shape:
        raise ShapeError(
            f"{name}: expected a texture of shape ({height}, {width}) or ({height}, {width}, C), "
            f"got {shape}; lay out svu.texels at the resolution of the textures."
        )
    return int(shape[2]) if len(shape) == 3 else 1
