"""Predicted responses: reflectance columns of every texel in every view.

The radiance of a candidate photograph is unknown. Its reflectance columns follow from the geometry
and the light; only the material parameters, which mix them, are missing. ``angular_forecast.py``
and ``spectral_forecast.py`` define the columns. A texel that a view does not see has zeros.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold
from svu_mi.core.local_memory import QUAD, padded_to_quads, quad_count
from svu_mi.errors import OptionError
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.sample_view import TexelLanes, ViewSample, over_views, sample_visible
from svu_mi.geometry.visibility import Visibility

ResponseFunction = Callable[[ViewSample, Any], list[Any]]
"""Sample per lane, index of the view -> columns (Floats) after the first, the view's cosine."""


@dataclass(frozen=True)
class Responses:
    """K columns per texel and view. Memory: 8 bytes per pair, and 4 K if it is visible.

    Attributes:
        first: (V T,) Float, first column of every view and texel; 0 if not seen.
        slot: (V T,) UInt32, index among the visible pairs.
        rest: (pairs Q 4,) Float, columns 1 to K - 1 of visible pairs, in Q groups of four.
    """

    first: Any
    slot: Any
    rest: Any
    columns: int
    count: Any
    lane: Any

    @staticmethod
    def of(first: Any, columns: int, count: int) -> "Responses":
        """Create responses from their first column; allocate the memory of columns 1 to K - 1."""
        seen = dr.select(first > 0, mi.UInt32(1), 0)
        slot, pairs = dr.prefix_sum(seen), int(dr.sum(seen)[0])  # exclusive sum
        rest = dr.empty(mi.Float, max(pairs, 1) * padded_to_quads(columns - 1))  # never size 0
        dr.eval(slot)
        lane = dr.arange(mi.UInt32, count)
        return Responses(first, slot, rest, columns, dr.opaque(mi.UInt32, count), lane)

    @property
    def seen(self) -> np.ndarray:
        """Visibility of texels in views, (V, T) bool."""
        return np.asarray(self.first.numpy() > 0).reshape(-1, int(self.count[0]))

    @property
    def groups(self) -> int:
        """Number of column groups, Q."""
        return quad_count(self.columns - 1)

    def table(self) -> np.ndarray:
        """Return all columns as (V, T, K) float32."""
        seen = self.seen
        table = np.zeros((*seen.shape, self.columns), np.float32)
        table[..., 0] = self.first.numpy().reshape(seen.shape)
        rest = self.rest.numpy().reshape(-1, QUAD * self.groups)[: int(seen.sum())]
        table[seen, 1:] = rest[:, : self.columns - 1]
        return table

    def at(self, lane: Any) -> "Responses":
        """Return the responses for a kernel whose lanes are the texels ``lane``."""
        return replace(self, lane=lane)

    def sees(self, view: Any) -> Any:
        """Return the first column of a view for each lane: Float, 0 if not seen."""
        return dr.gather(mi.Float, self.first, view * self.count + self.lane)

    def read(self, view: Any, group: Any) -> Any:
        """Return columns 1 + 4 ``group`` ... 4 + 4 ``group`` of a view: Vector4f, 0 if not seen."""
        place = self._slot(view) * self.groups + group
        return dr.gather(mi.Vector4f, self.rest, place, self.sees(view) > 0)

    def write(self, view: Any, columns: list[Any], active: Any) -> None:
        """Write columns 1 to K - 1 of a view, inside the kernel that computes them."""
        slot, mode = self._slot(view) * self.groups, dr.ReduceMode.NoConflicts
        rest = columns + [mi.Float(0)] * (QUAD * self.groups - len(columns))
        for group in range(self.groups):
            four = mi.Vector4f(*rest[QUAD * group : QUAD * (group + 1)])
            dr.scatter(self.rest, four, slot + group, active, mode)

    def _slot(self, view: Any) -> Any:
        return dr.gather(mi.UInt32, self.slot, view * self.count + self.lane)


def collect_responses(
    surface: TexelLanes, photographed: tuple[Views, Visibility], candidates: Views,
    respond: ResponseFunction, columns: int,
) -> Responses:  # fmt: skip
    """Evaluate the columns of all views: the photographs first, then the candidates."""
    _require_room(surface.count, photographed[0].number + candidates.number, columns)
    first = cosines(surface, photographed, candidates)
    responses = Responses.of(first, columns, surface.count)
    views, visibility = photographed
    before = dr.opaque(mi.UInt32, views.number)

    def record(seen: ViewSample, view: Any) -> tuple[()]:
        def write() -> tuple[()]:
            responses.write(view, respond(seen, view), seen.seen)
            return ()

        return dr.if_stmt(args=(), cond=seen.seen, true_fn=write, false_fn=lambda: ())

    def of_candidate(view: Any) -> tuple[Any]:
        known = responses.sees(before + view) > 0
        record(sample_visible(candidates, surface, view, known), before + view)
        return (view + 1,)

    visibility.over_views(
        views, surface,
        lambda seen, slot: record(seen, dr.gather(mi.UInt32, visibility.order, slot)), (),
    )  # fmt: skip
    dr.eval(responses.rest)
    fold(0, candidates.count, of_candidate)
    dr.eval(responses.rest)
    return responses


def cosines(
    surface: TexelLanes, photographed: tuple[Views, Visibility] | None, candidates: Views
) -> Any:
    """Return cosines of all views and texels, (V T,) Float, evaluated; 0 if not seen."""
    photographs = photographed[0].number if photographed else 0
    _require_room(surface.count, photographs + candidates.number, 1)
    count, before = dr.opaque(mi.UInt32, surface.count), dr.opaque(mi.UInt32, photographs)
    result = dr.zeros(mi.Float, surface.count * (photographs + candidates.number))
    dr.eval(result)

    def record(seen: ViewSample, view: Any) -> tuple[()]:
        place, mode = view * count + surface.lane, dr.ReduceMode.NoConflicts
        dr.scatter(result, seen.cosine, place, seen.seen, mode)
        return ()

    if photographed:
        views, visibility = photographed
        visibility.over_views(
            views, surface,
            lambda seen, slot: record(seen, dr.gather(mi.UInt32, visibility.order, slot)), (),
        )  # fmt: skip
        dr.eval(result)
    over_views(candidates, surface, lambda seen, view: record(seen, before + view), ())
    dr.eval(result)
    return result


def _require_room(count: int, number: int, columns: int) -> None:
    """Raise an error if the columns exceed 32-bit indices."""
    room = count * number * max(padded_to_quads(columns - 1), 1)
    if room >= 2**32:
        most = count * 2**32 // room
        raise OptionError(
            f"next_best_view(): {count} texels are too many for {number} views; set texels to "
            f"{most} or less.",
            shell=f"{count} texels are too many for {number} views; give --texels {most} or less.",
        )
