"""Who sees whom: traced once, kept as one bit per texel and view, used by every later pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.visibility.bits import Bits
from svu_mi.visibility.observe import Observation, Surface, asked, fold, look, over_views
from svu_mi.visibility.pixels import as_channels
from svu_mi.visibility.views import Views

GLARE = 1e3  # medians of all texels, beyond which one does not add to the mean radiance


@dataclass(frozen=True)
class Survey:
    """What V views together show of T texels.

    Attributes:
        coverage: (T,) UInt32, number of views that see each texel.
        total: (T,) Float64, grey (channel mean) radiance summed over those views; in double
            precision, so that sums of parts of the views are those of all.
        per_view: (V,) int64, number of texels that each view sees.
        bits: of V views and T texels: that of view v and texel t says whether v sees t.
        order: (N,) UInt32, the views that a pass goes through.
        count: N, an opaque UInt32.
        clipped: of V views and T texels: the view would see the texel, were it not for clipped
            pixels; None where nothing is clipped.
        dense: whether passes work for every texel and view, seen or not.
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
        """Mean grey radiance over all visible (texel, view) samples; 0 without any."""
        return mean_radiance(self.coverage.numpy(), self.total.numpy())

    @cached_property
    def clipped_coverage(self) -> np.ndarray | int:
        """(T,) uint32, number of views that would see each texel, were it not for clipped pixels;
        0 where nothing is clipped."""
        return 0 if self.clipped is None else np.asarray(self.clipped.count(), np.uint32)

    def look(
        self, views: Views, surface: Surface, slot: Any, *, clipped: bool = False,
        among: Bits | None = None,
    ) -> Observation:  # fmt: skip
        """Observe every texel of a launch in the view ``order[slot]``, with clipped pixels or
        without; ``among`` some samples only, a bit per slot and lane."""
        view = dr.gather(mi.UInt32, self.order, slot)
        if among is not None:
            seen = among.test(slot, surface.lane)
        else:
            seen = self.bits.test(view, surface.index)
        if not clipped or self.clipped is None:
            return look(views, surface, view, seen, dense=self.dense)
        if among is None:
            seen |= self.clipped.test(view, surface.index)
        return look(views, surface, view, seen, dense=self.dense, clipped=True)

    def asked(self, seen: Any) -> Any:
        """Return the condition under which a consumer has work to do."""
        return asked(seen, self.dense)

    def over_views(
        self, views: Views, surface: Surface, consume: Callable[..., Any],
        state: tuple[Any, ...], *, clipped: bool = False, among: Bits | None = None,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Run a consumer over the views in ``order`` in one symbolic loop; return the last state.

        ``consume(observation, slot, *state)`` returns the new state; it is traced once. ``clipped``
        and ``among`` are those of ``look``.
        """

        def body(slot: Any, *state: Any) -> tuple[Any, ...]:
            seen = self.look(views, surface, slot, clipped=clipped, among=among)
            return (slot + 1, *consume(seen, slot, *state))

        return fold(mi.UInt32(0), self.count, body, *state)


def mean_radiance(coverage: np.ndarray, total: np.ndarray) -> float:
    """Return the mean grey radiance of all samples; 0 without any.

    Texels far above the median count as 1000 times that: a few pixels that the camera has got
    wrong, or that show the sun, say nothing about noise elsewhere.
    """
    samples, total = np.asarray(coverage, np.float64), np.asarray(total, np.float64)
    lit = total > 0
    if not lit.any():
        return 0.0
    most = GLARE * np.median(total[lit] / samples[lit])
    return float(np.minimum(total, most * samples).sum() / samples.sum())


def survey(
    views: Views, surface: Surface, *, skip_blind: bool = True, skip_pairs: bool = True
) -> Survey:
    """Find which views see which texels, and how bright: one pass over all views, the only
    one that traces rays to the cameras."""
    per_view = dr.zeros(mi.UInt32, max(views.number, 1))
    worth = dr.zeros(mi.UInt32, max(views.number, 1))  # of clipped pixels
    bits = Bits.clear(views.number, surface.count)
    clipped = None if views.clipped is None else Bits.clear(views.number, surface.count)

    def count(seen: Observation, view: Any, found: Any, total: Any) -> tuple[Any, Any]:
        one = dr.select(seen.seen, mi.UInt32(1), mi.UInt32(0))
        # The default mode bakes the number of views into the kernel; all lanes of a packet
        # add to one view, which this mode sums up first.
        dr.scatter_add(per_view, one, view, seen.seen, dr.ReduceMode.Local)
        bits.set(view, surface.lane, seen.seen)
        if clipped is not None:
            clipped.set(view, surface.lane, seen.clipped)
            also = dr.select(seen.clipped, mi.UInt32(1), 0)
            dr.scatter_add(worth, also, view, seen.clipped, dr.ReduceMode.Local)
        return found + one, total + mi.Float64(as_channels(seen.radiance, 1)[0])

    zeros = dr.zeros(mi.UInt32, surface.count), dr.zeros(mi.Float64, surface.count)
    found, total = over_views(views, surface, count, zeros, dense=not skip_pairs)
    dr.eval(found, total, per_view, worth, bits, clipped)
    counts = per_view.numpy()[: views.number].astype(np.int64)
    shown = counts + worth.numpy()[: views.number]
    order = np.flatnonzero(shown) if skip_blind else np.arange(views.number)
    return Survey(
        coverage=found,
        total=total,
        per_view=counts,
        bits=bits,
        order=owned(mi.UInt32, order.astype(np.uint32)),
        count=dr.opaque(mi.UInt32, len(order)),
        clipped=clipped,
        dense=not skip_pairs,
    )
