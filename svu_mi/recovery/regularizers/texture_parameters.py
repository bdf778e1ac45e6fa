"""Textures of a scene as parameters of an optimiser."""

from collections.abc import Iterable, Mapping
from typing import Any, cast

import drjit as dr
import mitsuba as mi

from svu_mi.errors import OptionError, SceneError, excerpt

TEXTURE = ".data"  # end of the keys of bitmaps


def texture_parameters(params: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Return copies of a scene's textures for an optimiser; refuse any without a gradient.

    Mitsuba stores 8-bit bitmaps as bytes, through which no gradient passes. An optimiser accepts
    them, and then changes nothing. Scenes of ``svu.load_capture`` and ``svu.render_capture`` have
    float32 textures instead.

    Args:
        params: ``mi.traverse(scene)``.
        keys: Keys of bitmaps in it.

    Returns:
        Copy of each texture, (H, W, C) TensorXf, by key.

    Raises:
        OptionError: The scene has no texture with this key.
        SceneError: A texture has no gradient.

    Example:
        >>> params = mi.traverse(capture.scene)
        >>> textures = svu.texture_parameters(params, ["vase.bsdf.roughness.data"])
        >>> optimizer = mi.ad.Adam(lr=0.03, params=textures)
        >>> textures["vase.bsdf.roughness.data"].shape
        (256, 256, 1)
    """
    keys = list(keys)
    for key in keys:
        if key not in params or not dr.is_tensor_v(params[key]):
            known = ", ".join(each for each in params.keys() if each.endswith(TEXTURE))  # noqa: SIM118
            raise OptionError(
                f"texture_parameters(): the scene has no texture {excerpt(key)!r}; its textures "
                f"are {known or 'none'}."
            )
        if cast(Any, params).flags(key) & mi.ParamFlags.NonDifferentiable:
            raise SceneError(
                f"texture_parameters(): {key} is stored as {type(params[key]).__name__}, through "
                'which no gradient passes; add <string name="format" value="variant"/> to this '
                "bitmap, or load the scene with svu.load_capture."
            )
    return {key: mi.TensorXf(params[key]) for key in keys}
