"""Visibility of light cells from texels: one traced bit per texel and cell.

All coarse cells are traced. A fine cell inherits the bit of its coarse cell, with two
exceptions that are traced: its coarse cell is below the horizon, or the fine cell is bright and its
group of coarse cells is partly hidden, or other shapes, which may be small, are around.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.geometry.bitset import Bits
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import TexelLanes, ViewSample, mirror_direction
from svu_mi.geometry.visibility import Visibility
from svu_mi.light.band_limited import MOMENTS, Lighting, diffuse_moments
from svu_mi.light.light_tree import LightTree


@dataclass(frozen=True)
class LightVisibility:
    """Visibility of the light's cells from S texels.

    Attributes:
        fine: Visibility bits of fine cells from traced texels.
        place: (S,) UInt32, the traced texel whose bits each texel has.
    """

    tree: LightTree
    fine: Bits
    place: Any

    def subset(self, lanes: np.ndarray) -> "LightVisibility":
        """Return the visibility from selected texels."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        return replace(self, place=dr.gather(mi.UInt32, self.place, chosen))

    def diffuse(self, surface: TexelLanes, lighting: Lighting, channels: int) -> list[list[Any]]:
        """Return the diffuse moments of the visible light: 8 Floats (S,) per channel.

        c0 = sum L V cos, m0 (3) = sum L V cos w; c1 and m1 have the additional factor (1 - cos)^5
        of the incident direction w (Schlick). Values are scaled so that c0 without occlusion is the
        SH irradiance.
        """
        cells, place = self.tree.fine, self.place

        def add(cell: Any, *state: Any) -> tuple[Any, ...]:
            direction, flux = cells.at(cell)[0], cells.light(cell, channels)
            cosine = dr.maximum(dr.dot(surface.normal, direction), 0)
            free, added = self.fine.test(cell, place), []
            for value in flux:
                received = dr.select(free, value, 0)
                added += [*diffuse_moments(received, cosine, direction), value * cosine]
            return (cell + 1, *(old + new for old, new in zip(state, added, strict=True)))

        zero = dr.zeros(mi.Float, surface.count)
        sums = fold(0, cells.count, add, *[zero] * (channels * (MOMENTS + 1)))
        known, result = as_channels(lighting.irradiance(surface.normal), channels), []
        for channel, irradiance in enumerate(known):
            first = channel * (MOMENTS + 1)
            *moments, whole = sums[first : first + MOMENTS + 1]
            scale = dr.select(whole > 0, dr.maximum(irradiance, 0) / whole, 0)
            result.append([moment * scale for moment in moments])
        dr.eval(result)
        return result

    def hidden_share(self, surface: TexelLanes) -> np.ndarray:
        """Return the share of directions that are occluded, weighted by the cosine, (S,)."""

        def add(cell: Any, whole: Any, free: Any) -> tuple[Any, Any, Any]:
            start, end = (dr.gather(mi.UInt32, self.tree.first_leaf, cell + k) for k in (0, 1))
            direction = self.tree.fine.at(cell)[0]
            cosine = dr.maximum(dr.dot(surface.normal, direction), 0)
            above = dr.dot(surface.geometric_normal, direction) > 0
            own = dr.select(above, cosine * (end - start), 0)  # leaves have equal solid angles
            return cell + 1, whole + own, free + dr.select(self.fine.test(cell, self.place), own, 0)

        zero = dr.zeros(mi.Float, surface.count)
        whole, free = fold(0, self.tree.fine.count, add, zero, zero)
        return np.array(dr.select(whole > 0, 1 - free / whole, 0))


def trace_light_visibility(
    scene: Any, surface: TexelLanes, tree: LightTree, place: Any = None, *, occluded: bool = True
) -> LightVisibility:
    """Trace light cells from texels; with ``occluded=False``, only test the horizon.

    ``place`` is the lane whose visibility each texel has (default: its own).
    """
    lane, count, alone = surface.lane, surface.count, len(scene.shapes()) == 1
    fine = Bits.clear(tree.fine.number, count)

    def above(direction: Any) -> Any:
        shaded, true = surface.normal, surface.geometric_normal
        return (dr.dot(shaded, direction) > 0) & (dr.dot(true, direction) > 0)

    def trace_ray(toward: Any, active: Any) -> Any:
        # Rays of neighbouring texels have the same direction, so packets are coherent.
        return is_unoccluded(scene, surface, toward, active, coherent=True) if occluded else active

    def trace_group(group: Any, word: Any) -> tuple[Any, ...]:
        start, end = (dr.gather(mi.UInt32, tree.groups, group + k) for k in (0, 1))

        def trace(cell: Any, free: Any, high: Any) -> tuple[Any, ...]:
            direction = tree.coarse.at(cell)[0]
            up = above(direction)
            is_open = trace_ray(direction, up)
            own = mi.UInt32(1) << (cell - start)  # a group has at most 32 cells
            return cell + 1, free | dr.select(is_open, own, 0), high | dr.select(up, own, 0)

        none = dr.zeros(mi.UInt32, count)
        free, high = fold(start, end, trace, none, none)
        split = mi.Bool(not alone) | (free > 0) & (dr.popcnt(free) < end - start)

        def inherit(cell: Any, word: Any) -> tuple[Any, ...]:
            place = cell - start
            inherited, low = (free >> place) & 1 != 0, (high >> place) & 1 == 0
            first, last = (dr.gather(mi.UInt32, tree.first, cell + k) for k in (0, 1))

            def refine(below: Any, word: Any) -> tuple[Any, ...]:
                direction = tree.fine.at(below)[0]
                own = low | (split & (dr.gather(mi.UInt32, tree.bright, below) > 0))
                is_open = trace_ray(direction, own & above(direction))
                is_open = dr.select(own, is_open, inherited)
                return below + 1, fine.push(word, below, lane, is_open)

            return cell + 1, *fold(first, last, refine, word)

        return group + 1, *fold(start, end, inherit, word)

    fold(0, tree.group_count, trace_group, dr.zeros(mi.UInt32, count))
    dr.eval(fine)
    return LightVisibility(tree, fine, lane if place is None else place)


@dataclass(frozen=True)
class SampleBits:
    """Bits of samples by slot, and the lane of each texel."""

    bits: Bits
    lane: Any

    def subset(self, lanes: np.ndarray) -> "SampleBits":
        """Return the bits of selected lanes, as those of texels 0, 1, ..."""
        chosen = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        return SampleBits(self.bits.at(chosen), dr.arange(mi.UInt32, len(lanes)))

    def test(self, slot: Any, texel: Any) -> Any:
        """Return the bit of a slot at each texel, Bool."""
        return self.bits.test(slot, dr.gather(mi.UInt32, self.lane, texel))


def trace_samples(
    views: Views, surface: TexelLanes, visibility: Visibility, lane: Any,
    trace: Callable[[ViewSample, Any, Any], Any],
) -> SampleBits:  # fmt: skip
    """Return ``trace(sample, slot, active)`` (Bool) of each visible sample."""
    bits, place = Bits.clear(dr.width(visibility.order), surface.count), surface.lane

    def add(seen: ViewSample, slot: Any, word: Any) -> tuple[Any]:
        free = trace(seen, slot, visibility.needs_work(seen.seen))
        return (bits.push(word, slot, place, free),)

    start = dr.zeros(mi.UInt32, surface.count)
    visibility.over_views(views, surface, add, (start,), clipped=True)
    dr.eval(bits)
    return SampleBits(bits, lane)


def trace_mirror(scene: Any, surface: TexelLanes, seen: ViewSample, active: Any) -> Any:
    """Return whether mirror directions of visible samples are unoccluded."""
    mirror = mirror_direction(surface.normal, seen.direction)
    free = active & (dr.dot(surface.geometric_normal, mirror) > 0)
    return seen.seen & is_unoccluded(scene, surface, mirror, free, coherent=False)


def is_unoccluded(
    scene: Any, surface: TexelLanes, direction: Any, active: Any, *, coherent: bool,
    distance: Any = None,
) -> Any:  # fmt: skip
    """Trace one ray per active texel; return True (Bool) if it is free up to a distance."""
    origin = surface.position + surface.offset * surface.geometric_normal
    most = dr.largest(mi.Float) if distance is None else distance
    ray = mi.Ray3f(origin, direction, most, 0.0, [])
    return active & ~scene.ray_test(ray, coherent=coherent, active=active)
