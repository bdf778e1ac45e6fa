"""Samples of one view at one texel, within a symbolic loop over views.

``sample_view`` tests visibility; ``sample_visible`` reads the pixels of a visible texel. Consumers
(SH fit, statistics) trace them once: samples stay in registers, without a (texel x view) array.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.pixel_footprint import (
    black,
    interpolate,
    mean_over_texel,
    read_camera,
    taps_at,
)
from svu_mi.geometry.texels import Texels

RAY_OFFSET = 2e-5  # of the scene's extent: leaves the surface at every scale of the mesh
RAY_END = 1e-4  # part of the way to the camera left out at its far end
MIN_COSINE = 1e-3  # more grazing than this, neither pixel nor ray means the texel


@dataclass(frozen=True)
class TexelLanes:
    """Texels of a kernel launch, in lanes.

    Attributes:
        offset: Float, opaque: distance of ray origins from the surface.
        texel: UInt32, number among all texels; None for all, in order.
        sides: two Vector3f, world space; None for points.
    """

    position: Any
    normal: Any
    geometric_normal: Any
    offset: Any
    texel: Any | None = None
    sides: tuple[Any, Any] | None = None

    @staticmethod
    def of(texels: Texels, selection: Any | None = None) -> TexelLanes:
        """Take all texels, or those of a UInt32 array of their indices."""

        def take(values: Any) -> Any:
            return values if selection is None else dr.gather(type(values), values, selection)

        return TexelLanes(
            position=take(texels.position),
            normal=take(texels.normal),
            geometric_normal=take(texels.geometric_normal),
            # Far from the origin, less than the step between coordinates is not an offset at all.
            offset=dr.opaque(mi.Float, max(RAY_OFFSET * texels.extent, 2 * texels.step)),
            texel=selection,
            sides=(take(texels.sides[0]), take(texels.sides[1])),
        )

    def at(self, lane: Any) -> TexelLanes:
        """Take the texels of lanes (UInt32), any number of times."""

        def take(values: Any) -> Any:
            return dr.gather(type(values), values, lane)

        return TexelLanes(
            take(self.position),
            take(self.normal),
            take(self.geometric_normal),
            self.offset,
            texel=dr.gather(mi.UInt32, self.index, lane),
            sides=None if self.sides is None else (take(self.sides[0]), take(self.sides[1])),
        )

    @property
    def index(self) -> Any:
        """UInt32, number of each lane among all texels."""
        return dr.arange(mi.UInt32, self.count) if self.texel is None else self.texel

    @property
    def lane(self) -> Any:
        """UInt32, number of each lane in the launch."""
        return dr.arange(mi.UInt32, self.count)

    @property
    def count(self) -> int:
        """Number of texels in the launch."""
        return int(dr.width(self.position))


@dataclass(frozen=True)
class ViewSample:
    """One sample per lane.

    Attributes:
        direction: unit Vector3f to the camera, world space.
        cosine: Float, of direction and shading normal; 0 where not seen.
        radiance: Color3f; 0 where not seen.
        contrast: Float, variance of the averaged pixels, squared radiance; 0 where not seen.
        clipped: in the visibility pass Bool, seen only through saturated pixels; in the gather pass
            Color3f, saturated fraction. None if nothing is saturated, or not requested.
    """

    direction: Any
    cosine: Any
    radiance: Any
    seen: Any
    contrast: Any
    clipped: Any | None = None


def sample_view(views: Views, surface: TexelLanes, view: Any, *, dense: bool = False) -> ViewSample:
    """Sample one view at every texel; rays are traced after the cheaper tests.

    A texel is seen if it faces the camera (both normals), its pixels are usable, and no geometry
    occludes it.
    """
    camera = read_camera(views, view)
    to_camera = camera.position - surface.position
    distance = dr.norm(to_camera)
    direction = to_camera / distance
    cosine = dr.dot(surface.normal, direction)
    taps = taps_at(camera, surface.position)
    seen = (
        (cosine > MIN_COSINE)
        & (dr.dot(surface.geometric_normal, direction) > MIN_COSINE)
        & taps.on_film
    )

    def reach(
        start: Any, way: tuple[Any, Any], pixels: list[Any], weights: list[Any], seen: Any
    ) -> tuple[Any, ...]:
        """Look the pixels up and trace visibility, for lanes that face the camera."""
        shown = seen  # clipped or not; never changed in place, which would change both
        for pixel in pixels if views.outline is None else ():
            usable = dr.gather(mi.Bool, views.usable, pixel, shown)
            seen = seen & usable
            if views.clipped is None:
                shown = seen
            else:
                channels = views.clipped.channels
                usable = usable | (dr.gather(type(channels), channels, pixel, shown) > 0)
                shown = shown & usable
        # Neighbouring texels look at one camera: packets stay together, which is 10 % faster.
        ray = mi.Ray3f(start, *way, 0.0, [])
        free = ~views.scene.ray_test(ray, coherent=True, active=needs_work(shown, dense))
        seen = seen & free
        if views.outline is not None:
            seen = views.outline.encloses(views.scene, view, pixels[0], seen)
        radiance = dr.select(seen, interpolate(views, pixels, weights, seen), 0)
        return radiance, seen, *([] if views.clipped is None else [shown & free & ~seen])

    # Mitsuba's own spawn_ray offset has an absolute part, which drowns small meshes.
    start = surface.position + surface.offset * surface.geometric_normal
    radiance, seen, *clipped = dr.if_stmt(
        args=(start, (direction, distance * (1 - RAY_END)), taps.pixels, taps.weights, seen),
        cond=needs_work(seen, dense),
        true_fn=reach,
        false_fn=lambda *args: (
            black(), args[-1], *([] if views.clipped is None else [mi.Bool(False)])
        ),
    )  # fmt: skip
    cosine = dr.select(seen, cosine, 0)
    return ViewSample(direction, cosine, radiance, seen, mi.Float(0), *clipped)


def mirror_direction(normal: Any, direction: Any) -> Any:
    """Reflect a unit direction to the camera at unit normals: Vector3f."""
    return mi.reflect(mi.Vector3f(direction), mi.Normal3f(normal))


def needs_work(seen: Any, dense: bool) -> Any:
    """Return which lanes have work to do: all, if dense."""
    return mi.Bool(True) if dense else seen


def sample_visible(
    views: Views, surface: TexelLanes, view: Any, seen: Any, *, dense: bool = False,
    clipped: bool = False,
) -> ViewSample:  # fmt: skip
    """Sample visible texels, without rays; ``clipped``: saturated pixels as lower bounds."""

    def read(position: Any, normal: Any, sides: Any) -> tuple[Any, ...]:
        camera = read_camera(views, view)
        direction = mi.Vector3f(dr.normalize(camera.position - position))
        cosine = dr.select(seen, dr.dot(normal, direction), 0)
        mean = mean_over_texel(views, camera, position, sides, seen, clipped=clipped)
        return direction, cosine, *mean

    none = [black()] if clipped else []
    direction, cosine, radiance, contrast, *parts = dr.if_stmt(
        args=(surface.position, mi.Vector3f(surface.normal), surface.sides),
        cond=needs_work(seen, dense),
        true_fn=read,
        false_fn=lambda _, normal, *__: (normal, mi.Float(0), black(), mi.Float(0), *none),
    )
    return ViewSample(direction, cosine, radiance, seen, contrast, *parts)


def over_views(
    views: Views,
    surface: TexelLanes,
    consume: Callable[..., Any],
    state: Any,
    *,
    dense: bool = False,
) -> Any:
    """Fold ``consume(observation, view, *state)`` over all views in one symbolic loop."""

    def body(view: Any, *state: Any) -> tuple[Any, ...]:
        return (view + 1, *consume(sample_view(views, surface, view, dense=dense), view, *state))

    return fold(mi.UInt32(0), views.count, body, *state)


def fold(start: Any, end: Any, body: Callable[..., Any], *state: Any) -> tuple[Any, ...]:
    """Fold ``body``, which returns the next number and state, over [start, end) symbolically."""
    return dr.while_loop(
        state=(mi.UInt32(start), *state), cond=lambda number, *_: number < end, body=body
    )[1:]
