"""Visibility of texels in views, by rays: one bit per texel and view."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.geometry.bitset import Bits
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import (
    TexelLanes,
    ViewSample,
    needs_work,
    over_views,
    sample_visible,
)

MEAN_LIMIT = 1e3  # upper limit of a texel's radiance in the mean, in medians of all texels


@dataclass(frozen=True)
class Visibility:
    """Visibility of T texels in V views.

    Attributes:
        coverage: (T,) UInt32, number of views in which each texel is visible.
        total: (T,) Float64, sum of grey (channel mean) radiance over these views.
        per_view: (V,) int64, number of visible texels in each view.
        bits: Visibility bits of V views and T texels.
        order: (N,) UInt32, views that passes loop over; a ``slot`` is an index into this array.
        dense: True processes all pairs of texel and view, False only visible ones.
        clipped: Bits of texels visible only through saturated pixels; None without any.
    """

    coverage: Any
    total: Any
    per_view: np.ndarray
    bits: Bits
    order: Any
    count: Any
    dense: bool = False
    clipped: Bits | None = None

    @cached_property
    def scale(self) -> float:
        """Mean grey radiance over all visible pairs of texel and view; 0 without any."""
        return mean_radiance(self.coverage.numpy(), self.total.numpy())

    @cached_property
    def clipped_coverage(self) -> np.ndarray | int:
        """Views that show a texel only by saturated pixels: counts (T,) uint32; 0 without any."""
        return 0 if self.clipped is None else np.asarray(self.clipped.count(), np.uint32)

    def without(self, texels: np.ndarray, groups: Sequence[np.ndarray]) -> "Visibility":
        """Return the visibility of (t,) texels once for each group of views, without these views.

        Texel g t + k is ``texels[k]`` without the views in ``groups[g]``. Sums of radiance and
        numbers of texels still contain all views.
        """
        chosen = to_drjit(mi.UInt32, texels.astype(np.uint32))
        bits = self.bits.at(chosen).without(groups)
        return replace(
            self, bits=bits, coverage=to_drjit(mi.UInt32, bits.count().astype(np.uint32)),
            total=to_drjit(mi.Float64, np.tile(self.total.numpy()[texels], len(groups))),
            clipped=None if self.clipped is None else self.clipped.at(chosen).without(groups),
        )  # fmt: skip

    def sample(
        self, views: Views, surface: TexelLanes, slot: Any, *, clipped: bool = False,
        among: Bits | None = None,
    ) -> ViewSample:  # fmt: skip
        """Sample the view ``order[slot]`` at its visible texels.

        ``among`` contains bits by slot and lane to use instead of the visibility.
        """
        view = dr.gather(mi.UInt32, self.order, slot)
        if among is not None:
            seen = among.test(slot, surface.lane)
        else:
            seen = self.bits.test(view, surface.index)
        if not clipped or self.clipped is None:
            return sample_visible(views, surface, view, seen, dense=self.dense)
        if among is None:
            seen |= self.clipped.test(view, surface.index)
        return sample_visible(views, surface, view, seen, dense=self.dense, clipped=True)

    def mean_color(self, views: Views, surface: TexelLanes) -> np.ndarray:
        """Return the mean radiance of each lane over its views, (S, 3); NaN where unseen."""

        def add(seen: ViewSample, _: Any, color: Any, number: Any) -> tuple[Any, Any]:
            return color + seen.radiance, number + dr.select(seen.seen, mi.Float(1), 0)

        zero = dr.zeros(mi.Color3f, surface.count), dr.zeros(mi.Float, surface.count)
        color, number = self.over_views(views, surface, add, zero)
        with np.errstate(invalid="ignore"):
            return color.numpy().T / number.numpy()[:, None]

    def needs_work(self, seen: Any) -> Any:
        """Return the lanes (Bool) to process: visible ones, or all if ``dense``."""
        return needs_work(seen, self.dense)

    def over_views(
        self, views: Views, surface: TexelLanes, consume: Callable[..., Any],
        state: tuple[Any, ...], *, clipped: bool = False, among: Bits | None = None,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Fold ``consume(sample, slot, *state)`` over all slots of ``order``."""

        def body(slot: Any, *state: Any) -> tuple[Any, ...]:
            seen = self.sample(views, surface, slot, clipped=clipped, among=among)
            return (slot + 1, *consume(seen, slot, *state))

        return fold(0, self.count, body, *state)


def mean_radiance(coverage: np.ndarray, total: np.ndarray) -> float:
    """Return the mean radiance of samples; limit texels to 1000 times their median."""
    samples, total = np.asarray(coverage, np.float64), np.asarray(total, np.float64)
    lit = total > 0
    if not lit.any():
        return 0.0
    most = MEAN_LIMIT * np.median(total[lit] / samples[lit])
    return float(np.minimum(total, most * samples).sum() / samples.sum())


def trace_visibility(
    views: Views, surface: TexelLanes, *, skip_blind: bool = True, skip_pairs: bool = True
) -> Visibility:
    """Trace visibility of all texels in all views, and sum radiance.

    ``skip_blind`` omits views without visible texels from later passes, and ``skip_pairs`` omits
    pairs of texel and view that are not visible.
    """
    per_view = dr.zeros(mi.UInt32, max(views.number, 1))
    clipped_per_view = dr.zeros(mi.UInt32, max(views.number, 1))
    bits = Bits.clear(views.number, surface.count)
    clipped = None if views.clipped is None else Bits.clear(views.number, surface.count)

    def count(seen: ViewSample, view: Any, coverage: Any, total: Any) -> tuple[Any, Any]:
        seen_here = dr.select(seen.seen, mi.UInt32(1), mi.UInt32(0))
        # The default mode compiles the number of views into the kernel. In this mode, the lanes
        # of a packet, which add to one view, are summed first.
        dr.scatter_add(per_view, seen_here, view, seen.seen, dr.ReduceMode.Local)
        bits.set(view, surface.lane, seen.seen)
        if clipped is not None:
            clipped.set(view, surface.lane, seen.clipped)
            also = dr.select(seen.clipped, mi.UInt32(1), 0)
            dr.scatter_add(clipped_per_view, also, view, seen.clipped, dr.ReduceMode.Local)
        return coverage + seen_here, total + mi.Float64(as_channels(seen.radiance, 1)[0])

    zeros = dr.zeros(mi.UInt32, surface.count), dr.zeros(mi.Float64, surface.count)
    coverage, total = over_views(views, surface, count, zeros, dense=not skip_pairs)
    dr.eval(coverage, total, per_view, clipped_per_view, bits, clipped)
    counts = per_view.numpy()[: views.number].astype(np.int64)
    shown = counts + clipped_per_view.numpy()[: views.number]
    order = np.flatnonzero(shown) if skip_blind else np.arange(views.number)
    return Visibility(
        coverage=coverage,
        total=total,
        per_view=counts,
        bits=bits,
        order=to_drjit(mi.UInt32, order.astype(np.uint32)),
        count=dr.opaque(mi.UInt32, len(order)),
        clipped=clipped,
        dense=not skip_pairs,
    )
