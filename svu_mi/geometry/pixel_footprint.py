"""From a point to its pixels: projection, interpolation, and the mean over a texel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.geometry.packed_views import CAMERA_FLOATS, Views

SPACING = 1.5  # pixels between look-ups, each of which averages about as many
MOST_TAPS = 8  # per side of a texel


def as_channels(color: Any, channels: int) -> list[Any]:
    """Return a colour of 3 channels, or of 1, as that many: one is the mean of three."""
    values = list(color)
    return values if len(values) == channels else [sum(values) / len(values)]


@dataclass(frozen=True)
class Camera:
    """One view in registers: see ``Views``.

    Attributes:
        x, y, w: Vector4f, rows of the projection.
        offset: UInt32, index of the photograph's first pixel.
        least: Color3f, lower bound of saturated channels; None if nothing is saturated.
    """

    x: Any
    y: Any
    w: Any
    position: Any
    near: Any
    width: Any
    height: Any
    offset: Any
    least: Any | None = None


def read_camera(views: Views, view: Any) -> Camera:
    """Read a view by its number, UInt32."""
    floats = [
        dr.gather(mi.Float, views.cameras, view * CAMERA_FLOATS + k) for k in range(CAMERA_FLOATS)
    ]
    return Camera(
        x=mi.Vector4f(*floats[0:4]),
        y=mi.Vector4f(*floats[4:8]),
        w=mi.Vector4f(*floats[8:12]),
        position=mi.Point3f(*floats[12:15]),
        near=floats[15],
        width=dr.gather(mi.UInt32, views.width, view),
        height=dr.gather(mi.UInt32, views.height, view),
        offset=dr.gather(mi.UInt32, views.offset, view),
        least=None if views.clipped is None else dr.gather(mi.Color3f, views.clipped.least, view),
    )


@dataclass(frozen=True)
class Taps:
    """The four pixels around a projected point, their bilinear weights, and film bounds."""

    pixels: list[Any]
    weights: list[Any]
    on_film: Any


def _project(camera: Camera, position: Any) -> tuple[Any, Any, Any, Any]:
    """Pixel coordinates, 0 at the first centre; 1 / depth; whether in front of the camera."""
    point = mi.Vector4f(position.x, position.y, position.z, 1)
    depth = dr.dot(camera.w, point)
    in_front = depth > camera.near
    scale = dr.rcp(dr.select(in_front, depth, 1))
    x = dr.dot(camera.x, point) * scale - 0.5
    y = dr.dot(camera.y, point) * scale - 0.5
    return x, y, scale, in_front


def taps_at(camera: Camera, position: Any) -> Taps:
    """Return the pixels around a point of the surface."""
    x, y, _, in_front = _project(camera, position)
    return Taps(*_bilinear(camera, x, y), in_front & on_film(camera, x, y))


def on_film(camera: Camera, x: Any, y: Any) -> Any:
    """Return whether a point of the film lies between the centres of four pixels."""
    left, top = dr.floor(x), dr.floor(y)
    return (
        (left >= 0)
        & (top >= 0)
        & (left < mi.Float(camera.width) - 1)
        & (top < mi.Float(camera.height) - 1)
    )


def black() -> Any:
    """No radiance: Color3f."""
    return dr.zeros(mi.Color3f)


def interpolate(views: Views, pixels: list[Any], weights: list[Any], active: Any = True) -> Any:
    """Interpolate between four pixels; without any photograph there is no light."""
    total = black()
    if views.pixels is None:
        return total
    for pixel, weight in zip(pixels, weights, strict=True):
        value = dr.gather(mi.Color3f, views.pixels, pixel, active)
        # A kernel that rounds a position differently may touch a pixel that is not usable.
        total += weight * dr.select(dr.isfinite(value), value, 0)
    return total


def mean_over_texel(
    views: Views, camera: Camera, position: Any, sides: tuple[Any, Any] | None, seen: Any, *,
    clipped: bool = False,
) -> tuple[Any, ...]:  # fmt: skip
    """Return mean radiance (Color3f) and grey variance of the pixels under a texel.

    ``clipped`` adds their saturated fraction, Color3f. Unusable pixels do not count; if all are
    unusable, the centre is read. A texel smaller than a pixel is one bilinear look-up.
    """
    if views.pixels is None:
        return black(), mi.Float(0), *([black()] if clipped else [])
    x, y, spans, steps = _cover(camera, position, sides)
    columns, number = mi.UInt32(steps[1]), mi.UInt32(steps[0] * steps[1])
    number = dr.select(seen, number, 0)

    def add(tap: Any, weight: Any, total: Any, squares: Any, *parts: Any) -> tuple[Any, ...]:
        row = tap // columns
        u = (mi.Float(row) + 0.5) / steps[0] - 0.5
        v = (mi.Float(tap - row * columns) + 0.5) / steps[1] - 0.5
        px = x + u * spans[0][0] + v * spans[1][0]
        py = y + u * spans[0][1] + v * spans[1][1]
        # Beyond the film there is nothing to read; alone in the middle there is.
        inside = (number == 1) | on_film(camera, px, py)
        pixels, weights = _bilinear(camera, px, py)
        for pixel, w in zip(pixels, weights, strict=True):
            color = dr.gather(mi.Color3f, views.pixels, pixel)
            usable = dr.gather(mi.Bool, views.usable, pixel)
            if clipped:
                color, over = _at_least(views, camera, pixel, color)
                usable |= dr.max(over) > 0
            w = dr.select(inside & usable, w, 0)
            # Not usable is also what holds no radiance, and NaN times 0 is NaN.
            color = dr.select(w > 0, color, 0)
            weight += w
            total += w * color
            squares += w * dr.square(as_channels(color, 1)[0])
            if clipped:
                parts = (parts[0] + w * over,)
        return tap + 1, weight, total, squares, *parts

    zeros = (mi.UInt32(0), mi.Float(0), black(), mi.Float(0), *([black()] if clipped else []))
    _, weight, total, squares, *parts = dr.while_loop(zeros, lambda tap, *_: tap < number, add)
    alone = interpolate(views, *_bilinear(camera, x, y), seen & (weight == 0))
    total, inverse = dr.select(weight > 0, total, alone), dr.rcp(dr.select(weight > 0, weight, 1))
    mean = inverse * total
    variance = dr.maximum(inverse * squares - dr.square(as_channels(mean, 1)[0]), 0)
    return mean, variance, *(inverse * part for part in parts)


def _cover(
    camera: Camera, position: Any, sides: tuple[Any, Any] | None
) -> tuple[Any, Any, list[Any], list[Any]]:
    """Return a texel's middle on the film, its two sides there, and the look-ups along each."""
    x, y, scale, _ = _project(camera, position)
    spans = [(mi.Float(0), mi.Float(0))] * 2
    if sides is not None:
        spans = [_span(camera, side, x, y, scale) for side in sides]
    steps = [dr.clip(dr.ceil(dr.sqrt(a * a + b * b) / SPACING), 1, MOST_TAPS) for a, b in spans]
    return x, y, spans, steps


def _at_least(views: Views, camera: Camera, pixel: Any, color: Any) -> tuple[Any, Any]:
    """Return a pixel whose clipped channels are as dark as they may be, and 1 for those."""
    assert views.clipped is not None and camera.least is not None
    bits = mi.UInt32(dr.gather(type(views.clipped.channels), views.clipped.channels, pixel))
    over = [(bits & (1 << c)) > 0 for c in range(3)]
    parts = zip(over, camera.least, color, strict=True)
    return (
        mi.Color3f(*(dr.select(is_over, least, x) for is_over, least, x in parts)),
        mi.Color3f(*(dr.select(is_over, mi.Float(1), 0) for is_over in over)),
    )


def _span(camera: Camera, side: Any, x: Any, y: Any, scale: Any) -> tuple[Any, Any]:
    """Project a vector at a point: pixels (Floats), to first order."""
    vector = mi.Vector4f(side.x, side.y, side.z, 0)
    depth = dr.dot(camera.w, vector)
    return (
        scale * (dr.dot(camera.x, vector) - (x + 0.5) * depth),
        scale * (dr.dot(camera.y, vector) - (y + 0.5) * depth),
    )


def _bilinear(camera: Camera, x: Any, y: Any) -> tuple[list[Any], list[Any]]:
    """Return the four pixels around a point and their weights, clamped to the film."""
    x = dr.clip(x, 0, mi.Float(camera.width) - 1)
    y = dr.clip(y, 0, mi.Float(camera.height) - 1)
    left = dr.minimum(mi.UInt32(x), dr.maximum(camera.width, 2) - 2)
    top = dr.minimum(mi.UInt32(y), dr.maximum(camera.height, 2) - 2)
    fx, fy = x - mi.Float(left), y - mi.Float(top)
    first = camera.offset + top * camera.width + left
    right = dr.select(camera.width > 1, mi.UInt32(1), 0)
    below = dr.select(camera.height > 1, camera.width, 0)
    return (
        [first, first + right, first + below, first + below + right],
        [(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy],
    )
