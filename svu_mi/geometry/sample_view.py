"""Samples of a view at texels, inside a symbolic loop over views.

``sample_view`` traces visibility; ``sample_visible`` reads the pixels of visible texels. Samples
stay in registers: no array has an entry per texel and view.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.core.arrays import fold
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.pixel_footprint import (
    black,
    interpolate,
    mean_over_texel,
    normal_deviations,
    read_camera,
    taps_at,
)
from svu_mi.geometry.texels import Texels

RAY_OFFSET = 2e-5  # distance of ray origins from the surface, relative to the mesh's extent
RAY_END = 1e-4  # fraction of the ray that is cut off at the camera
MIN_COSINE = 1e-3  # smallest cosine of a visible texel; below, pixels and rays are unreliable


@dataclass(frozen=True)
class TexelLanes:
    """Texels of a kernel launch, one per lane.

    Attributes:
        offset: Opaque Float, distance of ray origins from the surface.
        texel: UInt32, index among all texels; None if lanes are all texels in order.
        sides: Sides of the texel, two Vector3f in world space; None for points.
        turns: Changes of the normal along the sides, two Vector3f; None for points.
    """

    position: Any
    normal: Any
    geometric_normal: Any
    offset: Any
    texel: Any | None = None
    sides: tuple[Any, Any] | None = None
    turns: tuple[Any, Any] | None = None

    @staticmethod
    def of(texels: Texels, selection: Any | None = None) -> "TexelLanes":
        """Make lanes of all texels, or of a selection (UInt32 indices)."""

        def take(values: Any) -> Any:
            return values if selection is None else dr.gather(type(values), values, selection)

        return TexelLanes(
            position=take(texels.position),
            normal=take(texels.normal),
            geometric_normal=take(texels.geometric_normal),
            # Far from the origin, an offset below the rounding step would have no effect.
            offset=dr.opaque(mi.Float, max(RAY_OFFSET * texels.extent, 2 * texels.step)),
            texel=selection,
            sides=take(texels.sides),
            turns=take(texels.turns),
        )

    def at(self, lane: Any) -> "TexelLanes":
        """Gather lanes by their indices (UInt32), which may repeat."""
        names = ("position", "normal", "geometric_normal", "sides", "turns")
        values = {name: x for name in names if (x := getattr(self, name)) is not None}
        taken = dr.gather(dict, values, lane)
        return replace(self, texel=dr.gather(mi.UInt32, self.index, lane), **taken)

    @property
    def index(self) -> Any:
        """Index of each lane's texel among all texels, UInt32."""
        return dr.arange(mi.UInt32, self.count) if self.texel is None else self.texel

    @property
    def lane(self) -> Any:
        """Index of each lane in the launch, UInt32."""
        return dr.arange(mi.UInt32, self.count)

    @property
    def count(self) -> int:
        """Number of texels in the launch."""
        return int(dr.width(self.position))


@dataclass(frozen=True)
class ViewSample:
    """One sample per lane.

    Attributes:
        direction: Unit Vector3f to the camera, world space.
        cosine: Float, cosine between direction and shading normal; 0 if not visible.
        radiance: Color3f; 0 if not visible.
        contrast: Float, variance of the averaged pixels in squared radiance; 0 if not visible.
        clipped: From ``sample_view``: Bool, True if a texel is visible only through saturated
            pixels. From ``sample_visible``: Color3f, saturated fraction per channel. None without
            saturated pixels or if not requested.
        bend: From ``sample_visible``: standard deviations of the normal (``normal_deviations``).
    """

    direction: Any
    cosine: Any
    radiance: Any
    seen: Any
    contrast: Any
    clipped: Any | None = None
    bend: tuple[Any, Any] | None = None


def sample_view(views: Views, surface: TexelLanes, view: Any, *, dense: bool = False) -> ViewSample:
    """Sample one view at each texel; test visibility by a ray.

    A texel is visible if its shading and geometric normals face the camera, its pixels are usable,
    and no geometry occludes it. Rays are traced only if the other tests pass, or in all lanes if
    ``dense``.
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
        """Test the pixels and trace a ray, for lanes that face the camera."""
        shown = seen  # also through clipped pixels; in-place changes would affect both
        for pixel in pixels if views.outline is None else ():
            usable = dr.gather(mi.Bool, views.usable, pixel, shown)
            seen = seen & usable
            if views.clipped is None:
                shown = seen
            else:
                channels = views.clipped.channels
                usable = usable | (dr.gather(type(channels), channels, pixel, shown) > 0)
                shown = shown & usable
        # Rays of neighbouring texels converge at one camera: coherent packets are 10 % faster.
        ray = mi.Ray3f(start, *way, 0.0, [])
        free = ~views.scene.ray_test(ray, coherent=True, active=needs_work(shown, dense))
        seen = seen & free
        if views.outline is not None:
            seen = views.outline.encloses(views.scene, view, pixels[0], seen)
        radiance = dr.select(seen, interpolate(views, pixels, weights, seen), 0)
        return radiance, seen, *([] if views.clipped is None else [shown & free & ~seen])

    # The offset of Mitsuba's spawn_ray has an absolute part, which is too large for small meshes.
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
    """Return the direction (Vector3f) that mirrors a unit direction about a unit normal."""
    return mi.reflect(mi.Vector3f(direction), mi.Normal3f(normal))


def needs_work(seen: Any, dense: bool) -> Any:
    """Return the lanes (Bool) to process: visible ones, or all if ``dense``."""
    return mi.Bool(True) if dense else seen


def sample_visible(
    views: Views, surface: TexelLanes, view: Any, seen: Any, *, dense: bool = False,
    clipped: bool = False,
) -> ViewSample:  # fmt: skip
    """Sample one view at the ``seen`` texels; ``clipped=True`` includes saturated pixels."""

    def read(position: Any, normal: Any, sides: Any, turns: Any) -> tuple[Any, ...]:
        camera = read_camera(views, view)
        direction = mi.Vector3f(dr.normalize(camera.position - position))
        cosine = dr.select(seen, dr.dot(normal, direction), 0)
        mean = mean_over_texel(views, camera, position, sides, seen, clipped=clipped)
        return direction, cosine, normal_deviations(camera, position, sides, turns), *mean

    none, flat = [black()] if clipped else [], dr.zeros(mi.Vector3f)
    direction, cosine, bend, radiance, contrast, *parts = dr.if_stmt(
        args=(surface.position, mi.Vector3f(surface.normal), surface.sides, surface.turns),
        cond=needs_work(seen, dense),
        true_fn=read,
        false_fn=lambda _, normal, *__: (
            normal, mi.Float(0), (flat, flat), black(), mi.Float(0), *none
        ),
    )  # fmt: skip
    shares = parts[0] if parts else None
    return ViewSample(direction, cosine, radiance, seen, contrast, shares, bend)


def over_views(
    views: Views,
    surface: TexelLanes,
    consume: Callable[..., Any],
    state: Any,
    *,
    dense: bool = False,
) -> Any:
    """Fold ``consume(sample, view, *state)`` over all views in one symbolic loop."""

    def body(view: Any, *state: Any) -> tuple[Any, ...]:
        return (view + 1, *consume(sample_view(views, surface, view, dense=dense), view, *state))

    return fold(0, views.count, body, *state)
