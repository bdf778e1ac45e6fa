"""What every view would show of every texel, whatever the texel is made of.

A photograph of a candidate does not exist. What it would show follows from the geometry and the
known light alone, but for the reflectance, and that part is kept here: a few numbers per view and
texel (``angular.py``, ``spectral.py`` say which), 0 where the view does not see the texel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.visibility import Surface, Survey, Views, over_views
from svu_mi.visibility.observe import Observation

BLOCK = 16

Respond = Callable[[Observation], list[Any]]
"""One sample per lane -> its columns, Floats, of which the first is positive."""


@dataclass(frozen=True)
class Responses:
    """K numbers of V views per texel; memory: 4 K V bytes per texel.

    Attributes:
        values: (ceil(T / 16) V K 16,) Float: for every block of 16 texels, view and column, one
            value per texel. A packet of lanes finds all views in a few pages.
        views: V, an opaque UInt32.
        columns: K.
        count: T.
        lane: (L,) UInt32, which of the T texels a launch is about.
    """

    values: Any
    views: Any
    columns: int
    count: int
    lane: Any

    @property
    def seen(self) -> np.ndarray:
        """(V, T) bool, which view sees which texel."""
        views, count = int(self.views[0]), dr.opaque(mi.UInt32, self.count)
        place = dr.arange(mi.UInt32, views * self.count)
        first = self.at(place % count).read(place // count, 0) > 0
        return np.array(first).reshape(views, self.count)

    def table(self) -> np.ndarray:
        """Return (V, T, K) float32."""
        blocks = self.values.numpy().reshape(-1, int(self.views[0]), self.columns, BLOCK)
        rows = np.transpose(blocks, (1, 0, 3, 2)).reshape(blocks.shape[1], -1, self.columns)
        return rows[:, : self.count]

    def at(self, lane: Any) -> Responses:
        """Return the same, for launches about some of the texels."""
        return replace(self, lane=lane)

    def read(self, view: Any, column: Any) -> Any:
        """Read a column of a view, for the lanes of a launch: Float."""
        return dr.gather(mi.Float, self.values, self._place(view, column))

    def write(self, view: Any, columns: list[Any], active: Any) -> None:
        """Write all columns of a view, within the kernel that computes them."""
        for column, value in enumerate(columns):
            place = self._place(view, column)
            dr.scatter(self.values, value, place, active, dr.ReduceMode.NoConflicts)

    def _place(self, view: Any, column: Any) -> Any:
        block = (self.lane // BLOCK) * self.views + view
        return (block * self.columns + column) * BLOCK + self.lane % BLOCK


def collect(
    surface: Surface, photographed: tuple[Views, Survey], candidates: Views, respond: Respond,
    columns: int,
) -> Responses:  # fmt: skip
    """Evaluate all views of texels: those photographed first, then the candidates.

    Args:
        surface: the texels.
        photographed: views with photographs, and which texels they see.
        candidates: views without.
        respond: what a view shows.
        columns: K.

    Raises:
        OptionError: more numbers than 32-bit indices reach.
    """
    views, found = photographed
    number, count = views.number + candidates.number, surface.count
    room = -(-count // BLOCK) * BLOCK * number * columns
    if room >= 2**32:
        raise OptionError(
            f"next_best_view(): {count} texels are too many for {number} views; use "
            f"at most {count * 2**32 // room} (texels=...).",
            shell=f"{count} texels are too many for {number} views; give --texels "
            f"{count * 2**32 // room}, or fewer.",
        )
    responses = Responses(
        values=dr.zeros(mi.Float, room), views=dr.opaque(mi.UInt32, number), columns=columns,
        count=count, lane=surface.lane,
    )  # fmt: skip
    dr.eval(responses.values)

    def record(seen: Observation, view: Any) -> tuple[()]:
        def write() -> tuple[()]:
            responses.write(view, respond(seen), seen.seen)
            return ()

        return dr.if_stmt(args=(), cond=seen.seen, true_fn=write, false_fn=lambda: ())

    first = dr.opaque(mi.UInt32, views.number)
    found.over_views(
        views, surface, lambda seen, slot: record(seen, dr.gather(mi.UInt32, found.order, slot)), ()
    )
    dr.eval(responses.values)
    over_views(candidates, surface, lambda seen, view: record(seen, first + view), ())
    dr.eval(responses.values)
    return responses
