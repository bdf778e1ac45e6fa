"""Rays through the films of all views, without a call per sensor.

They are Mitsuba's own (``PerspectiveCamera::sample_ray``), step by step: equal to the last bit
on LLVM, so that it does not matter which of the two a pixel was judged by.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.poses import describe
from svu_mi.capture.scene import to_world
from svu_mi.interop import owned

RAY_FLOATS = 24  # per view, in groups of four: a kernel reads a group at once


def ray_floats(sensor: Any, principal_point: tuple[float, float]) -> np.ndarray:
    """Return (24,) float32, what the rays of one view are made of.

    Film to camera space (scale and shift of x, the same of y); depth and divisor there, shift
    of the principal point in crop windows; three rows of ``to_world``; near and far clip, width
    and height of the crop window in pixels.

    Args:
        sensor: a perspective sensor.
        principal_point: its offset, in units of the full film.
    """
    film = sensor.film()
    size = np.array(film.crop_size(), np.float32)
    # Mitsuba multiplies by the rounded reciprocal.
    shift = np.array(film.size(), np.float32) * np.array(principal_point, np.float32) * (1 / size)
    unproject = np.array(sensor.projection_transform().inverse().matrix, np.float32).reshape(4, 4)
    return np.concatenate(
        [
            unproject[[0, 0, 1, 1, 2, 3], [0, 3, 1, 3, 3, 3]],
            shift,
            to_world(sensor)[:3].ravel(),
            [sensor.near_clip(), sensor.far_clip(), *size],
        ],
        dtype=np.float32,
    )


def table_of(sensors: Sequence[Any]) -> Any:
    """Return (V * 24,) Float, what the rays of V perspective sensors are made of."""
    rows = [ray_floats(each, tuple(describe(each)["principal_point_offset"])) for each in sensors]
    return owned(mi.Float, np.array(rows, np.float32).ravel())


def film_ray(floats: Any, view: Any, x: Any, y: Any) -> Any:
    """Make the ``mi.Ray3f`` of a view through a point of its film, in pixels.

    Args:
        floats: (V * 24,) Float, see ``ray_floats``.
        view: UInt32, index of the view.
        x: Float, 0 to the width of the crop window.
        y: Float, 0 to its height.
    """
    scale, lens, right, up, forward, film = (
        dr.gather(mi.Vector4f, floats, view * (RAY_FLOATS // 4) + k) for k in range(6)
    )
    u, v = x / film.z + lens.z, y / film.w + lens.w
    divisor = dr.rcp(lens.y)
    local = dr.normalize(
        mi.Vector3f(
            dr.fma(scale.x, u, scale.y) * divisor,
            dr.fma(scale.z, v, scale.w) * divisor,
            lens.x * divisor,
        )
    )
    rows = (right, up, forward)
    direction = mi.Vector3f(
        *(dr.fma(r.z, local.z, dr.fma(r.y, local.y, r.x * local.x)) for r in rows)
    )
    per_depth = dr.rcp(local.z)
    near, far = film.x * per_depth, film.y * per_depth
    origin = mi.Point3f(*(row.w for row in rows)) + direction * near
    return mi.Ray3f(origin, direction, far - near, 0.0, [])


def pixel_rays(
    floats: Any, pixels: tuple[Any, Any, Any], count: int, place: Callable[[Any], Any]
) -> Any:
    """Make so many ``mi.Ray3f`` through each of N pixels, those of a pixel one after the other.

    Args:
        floats: (V * 24,) Float, see ``table_of``.
        pixels: (N,) UInt32 each: number of the view, row and column.
        count: rays of a pixel.
        place: where in its pixel ray k is, UInt32 -> two Floats in [0, 1]; such as ``evenly``.
    """
    index, number = dr.arange(mi.UInt32, dr.width(pixels[0]) * count), dr.opaque(mi.UInt32, count)
    of_pixel = index // number
    view, row, column = (dr.gather(mi.UInt32, part, of_pixel) for part in pixels)
    x, y = place(index - of_pixel * number)
    return film_ray(floats, view, mi.Float(column) + x, mi.Float(row) + y)


def evenly(side: int) -> Callable[[Any], Any]:
    """Return a ``place`` for ``side``^2 rays, on a grid in the pixel."""
    return lambda k: ((mi.Float(k % side) + 0.5) / side, (mi.Float(k // side) + 0.5) / side)
