"""Pixels that show one continuous piece of the object, and nothing of what lies behind it.

A pixel on a silhouette mixes two radiances, and the mixture is no measurement of either. A
pixel is interior when rays through its four corners all hit the object, at distances that a
smooth surface through it explains.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.poses import film_size

SLOPE_MARGIN = 3.0  # how much steeper than its tangent plane a smooth surface may look
MIN_COSINE = 0.05  # grazing surfaces recede at most as fast as this cosine says


def interior(scene: Any, target: Any, sensor: Any) -> Any:
    """Find the interior pixels of one view: one ray per pixel corner.

    Args:
        scene: the ``mi.Scene``.
        target: the shape whose pixels are asked for.
        sensor: the view.

    Returns:
        (H * W,) Bool, row-major.
    """
    width, height = film_size(sensor)
    # Opaque: as literals, every size of film and every scene would get kernels of its own.
    columns, pixels = dr.opaque(mi.UInt32, width + 1), dr.opaque(mi.UInt32, width)
    index = dr.arange(mi.UInt32, (width + 1) * (height + 1))
    x = mi.Float(index % columns) / dr.opaque(mi.Float, width)
    y = mi.Float(index // columns) / dr.opaque(mi.Float, height)
    ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
    on_target = si.is_valid() & (si.shape == dr.opaque(mi.ShapePtr, target))
    cosine = dr.maximum(dr.abs(dr.dot(si.n, ray.d)), MIN_COSINE)
    slope = dr.sqrt(1 - dr.square(cosine)) / cosine
    # A corner off the object is infinitely far away: no slope explains it.
    distance = dr.select(on_target, si.t, dr.inf)
    dr.eval(distance, slope)
    pixel = dr.arange(mi.UInt32, width * height)
    row = pixel // pixels
    corner = row * columns + pixel - row * pixels
    corners = [corner, corner + 1, corner + columns, corner + columns + 1]
    near, far = _extremes([dr.gather(mi.Float, distance, c) for c in corners])
    shallowest, _ = _extremes([dr.gather(mi.Float, slope, c) for c in corners])
    angle = dr.opaque(mi.Float, SLOPE_MARGIN * _pixel_angle(sensor, width))
    return dr.isfinite(far) & (far - near <= angle * far * (0.5 + shallowest))


def _extremes(values: list[Any]) -> tuple[Any, Any]:
    low = dr.minimum(dr.minimum(values[0], values[1]), dr.minimum(values[2], values[3]))
    high = dr.maximum(dr.maximum(values[0], values[1]), dr.maximum(values[2], values[3]))
    return low, high


def _pixel_angle(sensor: Any, width: int) -> float:
    """Angle between neighbouring pixels at the centre of the film, in radians."""
    projection = np.array(sensor.projection_transform().matrix, np.float64).reshape(4, 4)
    return float(1 / abs(projection[0, 0] * width))
