"""Rasterisation of UV triangles, and dilation of textures beyond UV charts.

One lane per face loops over its bounding box. Edge functions are exactly antisymmetric, and with
the top-left rule a texel centre on a shared edge belongs to one face: counts above 1 are overlaps.
"""

from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError, ShapeError


def rasterize(uvs: np.ndarray, resolution: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the last face (-1: none) and the number of faces at each texel centre, (H * W,)."""
    width, height = resolution
    if len(uvs) == 0:
        empty = np.zeros(width * height, np.int64)
        return empty - 1, empty
    corners = [
        (to_drjit(mi.Float64, uvs[:, k, 0] * width), to_drjit(mi.Float64, uvs[:, k, 1] * height))
        for k in range(3)
    ]
    # Face index plus one; zero means no face.
    owner = dr.zeros(mi.UInt32, width * height)
    count = dr.zeros(mi.UInt32, width * height)
    _walk(corners, dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height), owner, count)
    return (owner.numpy().astype(np.int64) - 1, count.numpy().astype(np.int64))


@dr.syntax
def _walk(corners: list[Any], width: Any, height: Any, owner: Any, count: Any) -> None:
    face = dr.arange(mi.UInt32, dr.width(corners[0][0]))
    first_x, last_x = _span([c[0] for c in corners], width)
    first_y, last_y = _span([c[1] for c in corners], height)
    sign = dr.sign(_edge(corners[0], corners[1], *corners[2]))
    x, y = mi.Int32(first_x), mi.Int32(first_y)
    active = (sign != 0) & (first_x <= last_x) & (first_y <= last_y)
    while active:
        inside = _inside(corners, sign, mi.Float64(x) + 0.5, mi.Float64(y) + 0.5)
        texel = mi.UInt32(y) * width + mi.UInt32(x)
        dr.scatter_add(count, mi.UInt32(1), texel, inside)
        dr.scatter_reduce(dr.ReduceOp.Max, owner, face + 1, texel, inside)
        x += 1
        wrap = x > last_x
        x = dr.select(wrap, first_x, x)
        y = dr.select(wrap, y + 1, y)
        active &= y <= last_y


def _span(values: list[Any], size: Any) -> tuple[Any, Any]:
    """Return first and last texel whose centre may be in a triangle."""
    low = dr.minimum(dr.minimum(values[0], values[1]), values[2])
    high = dr.maximum(dr.maximum(values[0], values[1]), values[2])
    first = dr.maximum(mi.Int32(dr.ceil(low - 0.5)), 0)
    last = dr.minimum(mi.Int32(dr.floor(high - 0.5)), mi.Int32(size) - 1)
    return first, last


def _edge(a: Any, b: Any, x: Any, y: Any) -> Any:
    """Return twice the signed area of the triangle a, b, (x, y); antisymmetric in a and b."""
    swap = (b[0] < a[0]) | ((b[0] == a[0]) & (b[1] < a[1]))
    ax, ay = dr.select(swap, b[0], a[0]), dr.select(swap, b[1], a[1])
    bx, by = dr.select(swap, a[0], b[0]), dr.select(swap, a[1], b[1])
    area = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
    return dr.select(swap, -area, area)


def _inside(corners: list[Any], sign: Any, x: Any, y: Any) -> Any:
    inside = mi.Bool(True)
    for k in range(3):
        a, b = corners[k], corners[(k + 1) % 3]
        area = sign * _edge(a, b, x, y)
        dx, dy = sign * (b[0] - a[0]), sign * (b[1] - a[1])
        # Of the two directions of an edge, exactly one is "top or left".
        top_left = (dy > 0) | ((dy == 0) & (dx < 0))
        inside &= (area > 0) | ((area == 0) & top_left)
    return inside


NARROW = 8  # texels; wider gutters are not cached, because they may fill most of the image


def dilate(image: np.ndarray, valid: np.ndarray, texels: float) -> np.ndarray:
    """Copy an image; invalid texels within ``texels`` of valid ones get the nearest value."""
    image, valid = np.asarray(image), np.asarray(valid, bool)
    if image.ndim not in (2, 3) or valid.shape != image.shape[:2]:
        raise ShapeError(
            f"dilate(): expected an (H, W) or (H, W, C) image and an (H, W) mask, "
            f"got {image.shape} and {valid.shape}."
        )
    if texels < 0:
        raise OptionError(f"dilate(): the width must not be negative, got {texels}.")
    filled = image.copy()
    if texels <= NARROW:
        place, source = _of_mask(np.packbits(valid).tobytes(), valid.shape, texels)
    else:
        place, source = _gutter(valid, texels)
    flat = filled.reshape(valid.size, *image.shape[2:])  # a view, because the copy is contiguous
    flat[place] = flat[source]
    return filled


@lru_cache(maxsize=2)  # one layout for maps, one for images
def _of_mask(packed: bytes, shape: tuple[int, int], texels: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ``_gutter`` of a mask, given as packed bits; cached."""
    bits = np.unpackbits(np.frombuffer(packed, np.uint8), count=shape[0] * shape[1])
    return _gutter(bits.view(bool).reshape(shape), texels)


def _gutter(valid: np.ndarray, texels: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (G,) of texels to fill, and of the nearest valid texels (G,)."""
    if not valid.any() or valid.all():  # distances are undefined without a valid texel
        return np.empty(0, np.intp), np.empty(0, np.intp)
    distance, (row, column) = scipy.ndimage.distance_transform_edt(~valid, return_indices=True)
    place = np.flatnonzero(~valid & (distance <= texels))
    return place, (row.astype(np.intp) * valid.shape[1] + column).ravel()[place]
