"""What one view shows of one texel; called inside a symbolic loop over views.

``observe`` is the only place where texels meet photographs. A consumer (SH fit, coverage,
...) calls it once while tracing its loop, so that samples live in registers and no
(texel x view) array exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.radiance.views import CAMERA_FLOATS, Views
from svu_mi.surface import Texels

RAY_OFFSET = 2e-5  # of the scene's extent: leaves the surface at every scale of the mesh
RAY_END = 1e-4  # part of the way to the camera left out at its far end
MIN_COSINE = 1e-3  # more grazing than this, neither pixel nor ray means the texel


@dataclass(frozen=True)
class Surface:
    """The texels of a kernel launch, in lanes."""

    position: Any
    normal: Any
    geometric_normal: Any
    offset: float

    @staticmethod
    def of(texels: Texels, selection: Any | None = None) -> Surface:
        """Take all texels, or those of a UInt32 array of their indices."""

        def take(values: Any) -> Any:
            return values if selection is None else dr.gather(type(values), values, selection)

        return Surface(
            position=take(texels.position),
            normal=take(texels.normal),
            geometric_normal=take(texels.geometric_normal),
            offset=dr.opaque(mi.Float, RAY_OFFSET * texels.extent),
        )

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
        radiance: Color3f, outgoing radiance; 0 where not seen.
        seen: Bool.
    """

    direction: Any
    cosine: Any
    radiance: Any
    seen: Any


def observe(views: Views, surface: Surface, view: Any) -> Observation:
    """Observe every texel of a launch in one view.

    A texel is seen when it faces the camera (both normals), its pixel neighbourhood lies on
    the film and is usable, and nothing stands between. Rays are traced only for lanes that
    pass the cheaper tests.

    Args:
        views: the packed capture.
        surface: the texels.
        view: UInt32, index of the view (uniform over lanes in a loop over views).
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
        cond=seen,
        true_fn=partial(_look, views, surface.offset),
        false_fn=lambda *args: (dr.zeros(mi.Color3f), args[-1]),
    )  # fmt: skip
    return Observation(direction, dr.select(seen, cosine, 0), radiance, seen)


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


def _taps(camera: _Camera, position: Any) -> _Taps:
    point = mi.Vector4f(position.x, position.y, position.z, 1)
    depth = dr.dot(camera.w, point)
    in_front = depth > camera.near
    scale = dr.rcp(dr.select(in_front, depth, 1))
    # Pixel centres are at +0.5; a point between four centres has all of its taps on the film.
    x = dr.dot(camera.x, point) * scale - 0.5
    y = dr.dot(camera.y, point) * scale - 0.5
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


def _look(
    views: Views,
    offset: Any,
    position: Any,
    normal: Any,
    pixels: list[Any],
    weights: list[Any],
    direction: Any,
    distance: Any,
    seen: Any,
) -> tuple[Any, Any]:
    """Look the pixels up and trace visibility, for lanes that face the camera."""
    usable = mi.Bool(True)
    radiance = dr.zeros(mi.Color3f)
    for pixel, weight in zip(pixels, weights, strict=True):
        usable &= dr.gather(mi.Bool, views.usable, pixel, seen)
        radiance += weight * dr.gather(mi.Color3f, views.pixels, pixel, seen)
    # Mitsuba's own spawn_ray offset has an absolute part, which drowns small meshes.
    origin = position + offset * normal
    reach = distance * (1 - RAY_END)
    ray = mi.Ray3f(origin, direction, reach, 0.0, [])
    seen = seen & usable
    seen &= ~views.scene.ray_test(ray, seen)
    return dr.select(seen, radiance, 0), seen


def over_views(views: Views, surface: Surface, consume: Callable[..., Any], state: Any) -> Any:
    """Run a consumer over all views in one symbolic loop.

    Args:
        views: the packed capture.
        surface: the texels.
        consume: ``consume(observation, view, *state)`` returns the new state; traced once.
        state: tuple of Dr.Jit arrays, one value per texel.

    Returns:
        The state after the last view.
    """

    def body(view: Any, *state: Any) -> tuple[Any, ...]:
        return (view + 1, *consume(observe(views, surface, view), view, *state))

    return dr.while_loop(
        state=(mi.UInt32(0), *state),
        cond=lambda view, *_: view < views.count,
        body=body,
    )[1:]


@dataclass(frozen=True)
class Survey:
    """What all views together show of T texels.

    Attributes:
        coverage: (T,) UInt32, number of views that see each texel.
        total: (T,) Float, grey (channel mean) radiance summed over those views.
        per_view: (V,) UInt32, number of texels that each view sees.
    """

    coverage: Any
    total: Any
    per_view: Any

    @property
    def scale(self) -> float:
        """Mean grey radiance over all visible (texel, view) samples; 0 without any."""
        samples = int(self.coverage.numpy().sum(dtype=np.int64))
        return float(self.total.numpy().sum(dtype=np.float64) / max(samples, 1))


class Tally:
    """Counts who sees whom, within a loop over views.

    Attributes:
        per_view: (V,) UInt32, filled when the kernel runs.
    """

    def __init__(self, views: Views) -> None:
        self.per_view = dr.zeros(mi.UInt32, max(views.number, 1))

    @staticmethod
    def start(surface: Surface) -> tuple[Any, Any]:
        """Return the state before the first view."""
        return dr.zeros(mi.UInt32, surface.count), dr.zeros(mi.Float, surface.count)

    def add(self, seen: Observation, view: Any, state: tuple[Any, Any]) -> tuple[Any, Any]:
        """Return the state after one more view."""
        one = dr.select(seen.seen, mi.UInt32(1), mi.UInt32(0))
        # The default mode bakes the number of views into the kernel; all lanes of a packet
        # add to one view, which this mode sums up first.
        dr.scatter_add(self.per_view, one, view, seen.seen, dr.ReduceMode.Local)
        return state[0] + one, state[1] + dr.sum(seen.radiance) / 3

    def survey(self, state: tuple[Any, Any]) -> Survey:
        """Return the record of all views."""
        return Survey(coverage=state[0], total=state[1], per_view=self.per_view)


def survey(views: Views, surface: Surface) -> Survey:
    """Find who sees whom, and how bright it is: one pass over all views."""
    tally = Tally(views)

    def count(seen: Observation, view: Any, state: tuple[Any, Any]) -> tuple[Any]:
        return (tally.add(seen, view, state),)

    (state,) = over_views(views, surface, count, (tally.start(surface),))
    dr.eval(state, tally.per_view)
    return tally.survey(state)
