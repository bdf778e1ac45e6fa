"""What one view shows of one texel; called inside a symbolic loop over views.

Texels meet photographs here and nowhere else: ``observe`` finds out whether a view sees a
texel, ``look`` reads the pixels of one that does. A consumer (SH fit, statistics, ...) calls
them once while tracing its loop, so that samples live in registers and no (texel x view)
array of them exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.surface import Texels
from svu_mi.visibility.views import CAMERA_FLOATS, Views

RAY_OFFSET = 2e-5  # of the scene's extent: leaves the surface at every scale of the mesh
RAY_END = 1e-4  # part of the way to the camera left out at its far end
SPACING = 1.5  # pixels between look-ups, each of which averages about as many
MOST_TAPS = 8  # per side of a texel
MIN_COSINE = 1e-3  # more grazing than this, neither pixel nor ray means the texel


@dataclass(frozen=True)
class Surface:
    """The texels of a kernel launch, in lanes.

    Attributes:
        position, normal, geometric_normal: of each, world space.
        offset: Float, opaque: how far from the surface rays start.
        texel: UInt32, which of all texels each is; None for all, in order.
        sides: two Vector3f, what each spans in world space; None for points.
    """

    position: Any
    normal: Any
    geometric_normal: Any
    offset: Any
    texel: Any | None = None
    sides: tuple[Any, Any] | None = None

    @staticmethod
    def of(texels: Texels, selection: Any | None = None) -> Surface:
        """Take all texels, or those of a UInt32 array of their indices."""

        def take(values: Any) -> Any:
            return values if selection is None else dr.gather(type(values), values, selection)

        return Surface(
            position=take(texels.position),
            normal=take(texels.normal),
            geometric_normal=take(texels.geometric_normal),
            # Far from the origin, less than the step between coordinates is no offset at all.
            offset=dr.opaque(mi.Float, max(RAY_OFFSET * texels.extent, 2 * texels.step)),
            texel=selection,
            sides=(take(texels.sides[0]), take(texels.sides[1])),
        )

    @property
    def index(self) -> Any:
        """UInt32, which of all texels each lane is."""
        return dr.arange(mi.UInt32, self.count) if self.texel is None else self.texel

    @property
    def lane(self) -> Any:
        """UInt32, the place of each in the launch."""
        return dr.arange(mi.UInt32, self.count)

    @property
    def count(self) -> int:
        """Number of texels in the launch."""
        return int(dr.width(self.position))


@dataclass(frozen=True)
class Observation:
    """One sample per lane.

    Attributes:
        direction: unit Vector3f from the texel to the camera, world space.
        cosine: Float, between direction and shading normal; 0 where not seen.
        radiance: outgoing radiance, Color3f; 0 where not seen.
        seen: Bool.
        contrast: Float, variance of the pixels that radiance is the mean of, squared radiance;
            0 where not seen.
    """

    direction: Any
    cosine: Any
    radiance: Any
    seen: Any
    contrast: Any


def observe(views: Views, surface: Surface, view: Any, *, dense: bool = False) -> Observation:
    """Observe every texel of a launch in one view.

    A texel is seen when it faces the camera (both normals), its pixel neighbourhood lies on
    the film and is usable, and nothing stands between. Rays are traced only for lanes that
    pass the cheaper tests.

    Args:
        views: the packed capture.
        surface: the texels.
        view: UInt32, index of the view (uniform over lanes in a loop over views).
        dense: trace for every lane all the same, to see what that costs.
    """
    camera = _read_camera(views, view)
    to_camera = camera.position - surface.position
    distance = dr.norm(to_camera)
    direction = to_camera / distance
    cosine = dr.dot(surface.normal, direction)
    taps = _taps(camera, surface.position)
    seen = (
        (cosine > MIN_COSINE)
        & (dr.dot(surface.geometric_normal, direction) > MIN_COSINE)
        & taps.on_film
    )
    radiance, seen = dr.if_stmt(
        args=(surface.position, surface.geometric_normal, taps.pixels, taps.weights,
              direction, distance, seen),
        cond=asked(seen, dense),
        true_fn=partial(_reach, views, surface.offset, dense),
        false_fn=lambda *args: (_black(), args[-1]),
    )  # fmt: skip
    return Observation(direction, dr.select(seen, cosine, 0), radiance, seen, mi.Float(0))


def as_channels(color: Any, channels: int) -> list[Any]:
    """Return a colour of 3 channels, or of 1, as that many: one is the mean of three."""
    found = list(color)
    return found if len(found) == channels else [sum(found) / len(found)]


def mirror_direction(normal: Any, direction: Any) -> Any:
    """Reflect a unit direction to the camera at unit normals: Vector3f."""
    return mi.reflect(mi.Vector3f(direction), mi.Normal3f(normal))


def asked(seen: Any, dense: bool) -> Any:
    """Return the condition under which there is work to do: always, if dense."""
    return mi.Bool(True) if dense else seen


def look(
    views: Views, surface: Surface, view: Any, seen: Any, *, dense: bool = False
) -> Observation:
    """Observe texels that a view is known to see: no test, no ray, and no work for others.

    Args:
        views: the packed capture.
        surface: the texels.
        view: UInt32, index of the view.
        seen: Bool, which of the texels it sees.
        dense: work for every lane all the same, to see what that costs.
    """

    def read(position: Any, normal: Any, sides: Any) -> tuple[Any, Any, Any, Any]:
        camera = _read_camera(views, view)
        direction = mi.Vector3f(dr.normalize(camera.position - position))
        cosine = dr.select(seen, dr.dot(normal, direction), 0)
        return direction, cosine, *mean_over_texel(views, camera, position, sides, seen)

    direction, cosine, radiance, contrast = dr.if_stmt(
        args=(surface.position, mi.Vector3f(surface.normal), surface.sides),
        cond=asked(seen, dense),
        true_fn=read,
        false_fn=lambda _, normal, *__: (normal, mi.Float(0), _black(), mi.Float(0)),
    )
    return Observation(direction, cosine, radiance, seen, contrast)


@dataclass(frozen=True)
class _Camera:
    x: Any
    y: Any
    w: Any
    position: Any
    near: Any
    width: Any
    height: Any
    offset: Any


def _read_camera(views: Views, view: Any) -> _Camera:
    floats = [
        dr.gather(mi.Float, views.cameras, view * CAMERA_FLOATS + k) for k in range(CAMERA_FLOATS)
    ]
    return _Camera(
        x=mi.Vector4f(*floats[0:4]),
        y=mi.Vector4f(*floats[4:8]),
        w=mi.Vector4f(*floats[8:12]),
        position=mi.Point3f(*floats[12:15]),
        near=floats[15],
        width=dr.gather(mi.UInt32, views.width, view),
        height=dr.gather(mi.UInt32, views.height, view),
        offset=dr.gather(mi.UInt32, views.offset, view),
    )


@dataclass(frozen=True)
class _Taps:
    """The four pixels around a projected point, their bilinear weights, and film bounds."""

    pixels: list[Any]
    weights: list[Any]
    on_film: Any


def _project(camera: _Camera, position: Any) -> tuple[Any, Any, Any, Any]:
    """Return pixel coordinates, 0 at the first pixel's centre; 1 / depth; and whether the point
    is in front of the camera."""
    point = mi.Vector4f(position.x, position.y, position.z, 1)
    depth = dr.dot(camera.w, point)
    in_front = depth > camera.near
    scale = dr.rcp(dr.select(in_front, depth, 1))
    x = dr.dot(camera.x, point) * scale - 0.5
    y = dr.dot(camera.y, point) * scale - 0.5
    return x, y, scale, in_front


def _taps(camera: _Camera, position: Any) -> _Taps:
    x, y, _, in_front = _project(camera, position)
    # A point between four pixels' centres has all of its taps on the film.
    left, top = dr.floor(x), dr.floor(y)
    on_film = (
        in_front
        & (left >= 0)
        & (top >= 0)
        & (left < mi.Float(camera.width) - 1)
        & (top < mi.Float(camera.height) - 1)
    )
    fx, fy = x - left, y - top
    first = mi.UInt32(dr.select(on_film, top, 0)) * camera.width
    first += mi.UInt32(dr.select(on_film, left, 0)) + camera.offset
    return _Taps(
        pixels=[first, first + 1, first + camera.width, first + camera.width + 1],
        weights=[(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy],
        on_film=on_film,
    )


def _reach(
    views: Views,
    offset: Any,
    dense: bool,
    position: Any,
    normal: Any,
    pixels: list[Any],
    weights: list[Any],
    direction: Any,
    distance: Any,
    seen: Any,
) -> tuple[Any, Any]:
    """Look the pixels up and trace visibility, for lanes that face the camera."""
    for pixel in pixels:
        seen &= dr.gather(mi.Bool, views.usable, pixel, seen)
    # Mitsuba's own spawn_ray offset has an absolute part, which drowns small meshes.
    origin = position + offset * normal
    reach = distance * (1 - RAY_END)
    ray = mi.Ray3f(origin, direction, reach, 0.0, [])
    # Neighbouring texels look at one camera: packets stay together, which is 10 % faster.
    seen &= ~views.scene.ray_test(ray, coherent=True, active=asked(seen, dense))
    return dr.select(seen, _radiance(views, pixels, weights, seen), 0), seen


def _black() -> Any:
    return dr.zeros(mi.Color3f)


def _radiance(views: Views, pixels: list[Any], weights: list[Any], active: Any = True) -> Any:
    """Interpolate between four pixels; without any photograph there is no light."""
    total = _black()
    if views.pixels is None:
        return total
    for pixel, weight in zip(pixels, weights, strict=True):
        value = dr.gather(mi.Color3f, views.pixels, pixel, active)
        # A kernel that rounds a position differently may touch a pixel that is not usable.
        total += weight * dr.select(dr.isfinite(value), value, 0)
    return total


def mean_over_texel(
    views: Views, camera: _Camera, position: Any, sides: tuple[Any, Any] | None, seen: Any
) -> tuple[Any, Any]:
    """Average the pixels that a texel covers in a view: bilinear look-ups all over the
    parallelogram that it is there, so close that they overlap.

    A texel smaller than a pixel is one look-up, and shares its pixels with its neighbours.

    Returns:
        radiance (Color3f), and the variance of grey over the pixels that were read.
    """
    if views.pixels is None:
        return _black(), mi.Float(0)
    x, y, scale, _ = _project(camera, position)
    spans = [] if sides is None else [_span(camera, side, x, y, scale) for side in sides]
    spans = spans or [(mi.Float(0), mi.Float(0))] * 2
    steps = [
        dr.clip(dr.ceil(dr.sqrt(a * a + b * b) / SPACING), 1, MOST_TAPS) for a, b in spans
    ]
    columns, number = mi.UInt32(steps[1]), mi.UInt32(steps[0] * steps[1])
    number = dr.select(seen, number, 0)

    def add(tap: Any, weight: Any, total: Any, squares: Any) -> tuple[Any, ...]:
        row = tap // columns
        u, v = (mi.Float(row) + 0.5) / steps[0] - 0.5, (
            mi.Float(tap - row * columns) + 0.5) / steps[1] - 0.5
        pixels, weights = _bilinear(
            camera, x + u * spans[0][0] + v * spans[1][0], y + u * spans[0][1] + v * spans[1][1]
        )
        for pixel, w in zip(pixels, weights, strict=True):
            color = dr.gather(mi.Color3f, views.pixels, pixel)
            w = dr.select(dr.gather(mi.Bool, views.usable, pixel), w, 0)
            # Not usable is also what holds no radiance, and NaN times 0 is NaN.
            color = dr.select(w > 0, color, 0)
            weight += w
            total += w * color
            squares += w * dr.square(as_channels(color, 1)[0])
        return tap + 1, weight, total, squares

    _, weight, total, squares = dr.while_loop(
        (mi.UInt32(0), mi.Float(0), _black(), mi.Float(0)), lambda tap, *_: tap < number, add
    )
    inverse = dr.select(weight > 0, dr.rcp(dr.select(weight > 0, weight, 1)), 0)
    mean = inverse * total
    grey = as_channels(mean, 1)[0]
    return mean, dr.maximum(inverse * squares - dr.square(grey), 0)


def _span(camera: _Camera, side: Any, x: Any, y: Any, scale: Any) -> tuple[Any, Any]:
    """Project a vector at a point: pixels (Floats), to first order."""
    vector = mi.Vector4f(side.x, side.y, side.z, 0)
    depth = dr.dot(camera.w, vector)
    return (
        scale * (dr.dot(camera.x, vector) - (x + 0.5) * depth),
        scale * (dr.dot(camera.y, vector) - (y + 0.5) * depth),
    )


def _bilinear(camera: _Camera, x: Any, y: Any) -> tuple[list[Any], list[Any]]:
    """Return the four pixels around a point and their weights; beyond the film, those at its
    edge."""
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


def over_views(
    views: Views,
    surface: Surface,
    consume: Callable[..., Any],
    state: Any,
    *,
    dense: bool = False,
) -> Any:
    """Run a consumer over all views in one symbolic loop.

    Args:
        views: the packed capture.
        surface: the texels.
        consume: ``consume(observation, view, *state)`` returns the new state; traced once.
        state: tuple of Dr.Jit arrays, one value per texel.
        dense: see ``observe``.

    Returns:
        The state after the last view.
    """

    def body(view: Any, *state: Any) -> tuple[Any, ...]:
        return (view + 1, *consume(observe(views, surface, view, dense=dense), view, *state))

    return dr.while_loop(
        state=(mi.UInt32(0), *state),
        cond=lambda view, *_: view < views.count,
        body=body,
    )[1:]
