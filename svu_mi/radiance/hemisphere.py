"""What of the light reaches every texel: visibility rays, traced once for all views.

A texel looks along the directions of the light's cells (``cells.py``). What it finds is kept
as a few moments, so that memory does not depend on the number of rays:

* four moments of the visible light under the cosine, which hold the irradiance and what
  Disney's diffuse model makes of it for *any* direction of view and roughness
  (brdf/diffuse.py);
* harmonics of the visible, and of all light above the horizon, whose ratio says how much of a
  wide specular lobe is lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.radiance.cells import LightCells
from svu_mi.radiance.lighting import Lighting
from svu_mi.radiance.observe import Observation, Surface

MOMENTS = 8  # per channel: two scalars, two vectors


@dataclass(frozen=True)
class Hemisphere:
    """Light that reaches T texels.

    Attributes:
        diffuse: per channel 8 Floats (T,): c0, m0 (3), c1, m1 (3), with
            c0 = sum L V cos, m0 = sum L V cos w, and the same with Schlick's
            (1 - cos)^5 of the incident direction w as c1, m1.
        visible, unoccluded: (degree + 1)^2 Floats (T,), harmonics of the (channel mean)
            light of visible, and of all directions above the horizon; empty if not traced.
    """

    diffuse: list[list[Any]]
    visible: list[Any]
    unoccluded: list[Any]


def hemisphere(
    scene: Any, surface: Surface, lighting: Lighting, cells: LightCells, *,
    channels: int, occluded: bool, lobes: int | None,
) -> Hemisphere:
    """Trace every texel's hemisphere, or assume that all of it is visible.

    The sum over cells only says which part is lost: the irradiance of an unoccluded surface
    comes from the light's harmonics, which know it better.

    Args:
        scene: what occludes.
        surface: the texels.
        lighting: the capture's light.
        cells: its cells.
        channels: 3, or 1 for the mean of the colour channels.
        occluded: trace for the diffuse moments.
        lobes: trace for ``visible``, harmonics up to this degree; None for none.

    Returns:
        Evaluated arrays.
    """
    harmonics = 0 if lobes is None else (lobes + 1) ** 2
    traced = occluded or harmonics > 0

    def body(cell: Any, *state: Any) -> tuple[Any, ...]:
        direction = mi.Vector3f(dr.gather(mi.Vector3f, cells.directions, cell))
        cosine = dr.dot(surface.normal, direction)
        above = cosine > 0
        free = above & (dr.dot(surface.geometric_normal, direction) > 0)
        if traced:
            # Neighbouring texels look in one direction: packets stay together.
            free = is_open(scene, surface, direction, free, coherent=True)
        flux = as_channels(dr.gather(mi.Color3f, cells.flux, cell), channels)
        cosine = dr.maximum(cosine, 0)
        lit = free if occluded else above
        grazing = (1 - cosine) ** 5
        added = []
        for value in flux:
            received = dr.select(lit, value * cosine, 0)
            for part in (received, received * grazing):
                added += [part, *(part * direction)]
            added.append(value * cosine)
        if lobes is not None:
            # Evaluated anew: reading (degree + 1)^2 numbers per lane takes longer.
            basis = dr.sh_eval(dr.gather(mi.Vector3f, cells.centers, cell), lobes)
            for seen in (free, above):
                visible = dr.select(seen, sum(flux), 0)
                added += [visible * value for value in basis]
        return (cell + 1, *(old + new for old, new in zip(state, added, strict=True)))

    size = channels * (MOMENTS + 1) + 2 * harmonics
    state = dr.while_loop(
        state=(mi.UInt32(0), *(dr.zeros(mi.Float, surface.count) for _ in range(size))),
        cond=lambda cell, *_: cell < cells.count,
        body=body,
    )[1:]
    known = as_channels(lighting.irradiance(surface.normal), channels)
    diffuse = []
    for channel in range(channels):
        first = channel * (MOMENTS + 1)
        *moments, unoccluded = state[first : first + MOMENTS + 1]
        scale = dr.select(unoccluded > 0, dr.maximum(known[channel], 0) / unoccluded, 0)
        diffuse.append([moment * scale for moment in moments])
    rest = list(state[channels * (MOMENTS + 1) :])
    result = Hemisphere(diffuse, rest[:harmonics], rest[harmonics:])
    dr.eval(result.diffuse, result.visible, result.unoccluded)
    return result


def mirror_free(scene: Any, surface: Surface, seen: Observation, asked: Any) -> Any:
    """Trace the mirror direction of visible samples; below the horizon nothing is free.

    Args:
        scene: what occludes.
        surface: the texels.
        seen: the samples.
        asked: Bool, for which to trace at all (``Survey.asked``).
    """
    mirror = 2 * seen.cosine * mi.Vector3f(surface.normal) - seen.direction
    free = asked & (dr.dot(surface.geometric_normal, mirror) > 0)
    return seen.seen & is_open(scene, surface, mirror, free, coherent=False)


def is_open(
    scene: Any, surface: Surface, direction: Any, active: Any, *, coherent: bool
) -> Any:
    """Return which active texels see the sky in a direction."""
    origin = surface.position + surface.offset * surface.geometric_normal
    ray = mi.Ray3f(origin, direction, dr.largest(mi.Float), 0.0, [])
    return active & ~scene.ray_test(ray, coherent=coherent, active=active)


def as_channels(color: Any, channels: int) -> list[Any]:
    """Return a colour of 3 channels, or of 1, as that many: one is the mean of three."""
    found = list(color)
    return found if len(found) == channels else [sum(found) / len(found)]
