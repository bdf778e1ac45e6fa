"""Pixel look-ups: projection, interpolation, and mean over a texel."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.core.arrays import fold
from svu_mi.geometry.packed_views import CAMERA_FLOATS, Views

SPACING = 1.5  # pixels between look-ups; about the width of a bilinear filter
MOST_TAPS = 8  # look-ups per side of a texel
OF_PIXEL = 1 / 4  # variance of a pixel (1/12) and of bilinear weights (1/6), in pixels
STEEPEST = 0.08  # maximum deviation of the normal [rad]


def as_channels(color: Any, channels: int) -> list[Any]:
    """Return the channels of a colour as a list; [mean] if ``channels`` is 1."""
    values = list(color)
    return values if len(values) == channels else [sum(values) / len(values)]


@dataclass(frozen=True)
class Camera:
    """Parameters of one view in registers (see ``Views``).

    Attributes:
        x, y, w: Vector4f, rows of the projection.
        offset: UInt32, index of the photograph's first pixel.
        least: Color3f, lower bounds of saturated channels; None without saturated pixels.
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
    """Gather the parameters of a view by its index (UInt32)."""
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
    """Indices and bilinear weights of four pixels, and whether all four are on the film."""

    pixels: list[Any]
    weights: list[Any]
    on_film: Any


def _project(camera: Camera, position: Any) -> tuple[Any, Any, Any, Any]:
    """Return x, y in pixels from the first pixel's centre, 1 / depth, and True if in front."""
    point = mi.Vector4f(position.x, position.y, position.z, 1)
    depth = dr.dot(camera.w, point)
    in_front = depth > camera.near
    scale = dr.rcp(dr.select(in_front, depth, 1))
    x = dr.dot(camera.x, point) * scale - 0.5
    y = dr.dot(camera.y, point) * scale - 0.5
    return x, y, scale, in_front


def taps_at(camera: Camera, position: Any) -> Taps:
    """Return the four pixels around a projected surface point, and their weights."""
    x, y, _, in_front = _project(camera, position)
    return Taps(*_bilinear(camera, x, y), in_front & on_film(camera, x, y))


def on_film(camera: Camera, x: Any, y: Any) -> Any:
    """Return whether a film position is between the centres of four pixels."""
    left, top = dr.floor(x), dr.floor(y)
    return (
        (left >= 0)
        & (top >= 0)
        & (left < mi.Float(camera.width) - 1)
        & (top < mi.Float(camera.height) - 1)
    )


def black() -> Any:
    """Return zero radiance, Color3f."""
    return dr.zeros(mi.Color3f)


def interpolate(views: Views, pixels: list[Any], weights: list[Any], active: Any = True) -> Any:
    """Interpolate radiance between four pixels, Color3f; 0 without photographs."""
    total = black()
    if views.pixels is None:
        return total
    for pixel, weight in zip(pixels, weights, strict=True):
        value = dr.gather(mi.Color3f, views.pixels, pixel, active)
        # Unusable pixels (NaN) are possible, because kernels may round positions differently.
        total += weight * dr.select(dr.isfinite(value), value, 0)
    return total


def mean_over_texel(
    views: Views, camera: Camera, position: Any, sides: tuple[Any, Any] | None, seen: Any, *,
    clipped: bool = False, moved: tuple[Any, Any] | None = None,
) -> tuple[Any, ...]:  # fmt: skip
    """Return mean radiance and grey variance of the pixels under a texel.

    Unusable pixels are ignored; if all are unusable, the pixels at the centre of the texel are
    interpolated. A texel smaller than a pixel needs one bilinear look-up. ``clipped=True`` replaces
    saturated channels by their lower bounds, and also returns their fraction (Color3f). ``moved``
    are pixels to the right and down, by which the texel is moved.
    """
    if views.pixels is None:
        return black(), mi.Float(0), *([black()] if clipped else [])
    x, y, spans, steps = _cover(camera, position, sides)
    if moved is not None:
        x, y = x + moved[0], y + moved[1]
    columns, number = mi.UInt32(steps[1]), mi.UInt32(steps[0] * steps[1])
    number = dr.select(seen, number, 0)

    def add(tap: Any, weight: Any, total: Any, squares: Any, *parts: Any) -> tuple[Any, ...]:
        row = tap // columns
        u = (mi.Float(row) + 0.5) / steps[0] - 0.5
        v = (mi.Float(tap - row * columns) + 0.5) / steps[1] - 0.5
        px = x + u * spans[0][0] + v * spans[1][0]
        py = y + u * spans[0][1] + v * spans[1][1]
        # A single look-up is always on the film.
        inside = (number == 1) | on_film(camera, px, py)
        pixels, weights = _bilinear(camera, px, py)
        for pixel, w in zip(pixels, weights, strict=True):
            color = dr.gather(mi.Color3f, views.pixels, pixel)
            usable = dr.gather(mi.Bool, views.usable, pixel)
            if clipped:
                color, over = _at_least(views, camera, pixel, color)
                usable |= dr.max(over) > 0
            w = dr.select(inside & usable, w, 0)
            # Unusable pixels may be NaN, and NaN times 0 is NaN.
            color = dr.select(w > 0, color, 0)
            weight += w
            total += w * color
            squares += w * dr.square(as_channels(color, 1)[0])
            if clipped:
                parts = (parts[0] + w * over,)
        return tap + 1, weight, total, squares, *parts

    zeros = (mi.Float(0), black(), mi.Float(0), *([black()] if clipped else []))
    weight, total, squares, *parts = fold(0, number, add, *zeros)
    alone = interpolate(views, *_bilinear(camera, x, y), seen & (weight == 0))
    total, inverse = dr.select(weight > 0, total, alone), dr.rcp(dr.select(weight > 0, weight, 1))
    mean = inverse * total
    variance = dr.maximum(inverse * squares - dr.square(as_channels(mean, 1)[0]), 0)
    return mean, variance, *(inverse * part for part in parts)


def normal_deviations(
    camera: Camera, position: Any, sides: tuple[Any, Any] | None, turns: tuple[Any, Any] | None
) -> tuple[Any, Any]:
    """Return vectors a and b: the normal has the covariance a a^T + b b^T in the pixels of a texel.

    With sides S = (s_u s_v) of the texel in pixels and turns N = (n_u n_v) of the normal along
    them, it is N M N^T, with M = S^-1 S^-T / 4 + (1 - 1 / steps^2) / 12.
    """
    if sides is None or turns is None:
        return dr.zeros(mi.Vector3f), dr.zeros(mi.Vector3f)
    _, _, (u, v), steps = _cover(camera, position, sides)
    inverse = OF_PIXEL / dr.maximum(dr.square(u[0] * v[1] - u[1] * v[0]), 1e-12)
    uu, uv, vv = (inverse * (p[0] * q[0] + p[1] * q[1]) for p, q in ((u, u), (u, v), (v, v)))
    of_u, of_v = ((1 - dr.rcp(step * step)) / 12 for step in steps)
    first = dr.sqrt(vv + of_u)
    both = -uv * dr.rcp(first)
    second = dr.sqrt(dr.maximum(uu + of_v - both * both, 0))
    a, b = first * turns[0] + both * turns[1], second * turns[1]
    limit = dr.minimum(STEEPEST * dr.rsqrt(dr.squared_norm(a) + dr.squared_norm(b) + 1e-12), 1)
    return limit * a, limit * b


def _cover(
    camera: Camera, position: Any, sides: tuple[Any, Any] | None
) -> tuple[Any, Any, list[Any], list[Any]]:
    """Project a texel; return centre x and y, both sides in pixels, look-ups per side."""
    x, y, scale, _ = _project(camera, position)
    spans = [(mi.Float(0), mi.Float(0))] * 2
    if sides is not None:
        spans = [_span(camera, side, x, y, scale) for side in sides]
    steps = [dr.clip(dr.ceil(dr.sqrt(a * a + b * b) / SPACING), 1, MOST_TAPS) for a, b in spans]
    return x, y, spans, steps


def _at_least(views: Views, camera: Camera, pixel: Any, color: Any) -> tuple[Any, Any]:
    """Replace clipped channels by lower bounds; also return 1 for clipped ones, else 0."""
    assert views.clipped is not None and camera.least is not None
    bits = mi.UInt32(dr.gather(type(views.clipped.channels), views.clipped.channels, pixel))
    over = [(bits & (1 << c)) > 0 for c in range(3)]
    parts = zip(over, camera.least, color, strict=True)
    return (
        mi.Color3f(*(dr.select(is_over, least, x) for is_over, least, x in parts)),
        mi.Color3f(*(dr.select(is_over, mi.Float(1), 0) for is_over in over)),
    )


def _span(camera: Camera, side: Any, x: Any, y: Any, scale: Any) -> tuple[Any, Any]:
    """Return the projection of a short vector at pixel (x, y), to first order, in pixels."""
    vector = mi.Vector4f(side.x, side.y, side.z, 0)
    depth = dr.dot(camera.w, vector)
    return (
        scale * (dr.dot(camera.x, vector) - (x + 0.5) * depth),
        scale * (dr.dot(camera.y, vector) - (y + 0.5) * depth),
    )


def _bilinear(camera: Camera, x: Any, y: Any) -> tuple[list[Any], list[Any]]:
    """Clamp (x, y) to the film; return the four pixels around it, and their weights."""
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
