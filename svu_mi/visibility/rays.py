"""Rays through the films of all views, without a call per sensor.

They are Mitsuba's own (``PerspectiveCamera::sample_ray``), step by step: equal to the last bit
on LLVM, so that it does not matter which of the two a pixel was judged by.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.scene import to_world

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
