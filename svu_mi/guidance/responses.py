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
    """K numbers of V views per texel; memory: up to 4 K V bytes per texel.

    Attributes:
        first: (ceil(T / 16) V 16,) Float: for every block of 16 texels and view, one value of the
            first column per texel, 0 where the view does not see it. A packet of lanes finds all
            views in a few pages.
        rest: (ceil(T / 16) V (K - 1) 16,) Float, the same of all others; whatever there was in
            memory where the view does not see the texel, which most do not: fresh memory that
            nobody touches costs nothing.
        views: V, an opaque UInt32.
        columns: K.
        count: T.
        lane: (L,) UInt32, which of the T texels a launch is about.
    """

    first: Any
    rest: Any
    views: Any
    columns: int
    count: int
    lane: Any

    @property
    def seen(self) -> np.ndarray:
        """(V, T) bool, which view sees which texel."""
        views, count = int(self.views[0]), dr.opaque(mi.UInt32, self.count)
        place = dr.arange(mi.UInt32, views * self.count)
        found = self.at(place % count).sees(place // count) > 0
        return np.array(found).reshape(views, self.count)

    def table(self) -> np.ndarray:
        """Return (V, T, K) float32."""
        views = int(self.views[0])
        first, rest = (
            np.transpose(x.numpy().reshape(-1, views, k, BLOCK), (1, 0, 3, 2)).reshape(views, -1, k)
            for x, k in ((self.first, 1), (self.rest, self.columns - 1))
        )
        return np.concatenate([first, np.where(first > 0, rest, 0)], axis=2)[:, : self.count]

    def at(self, lane: Any) -> Responses:
        """Return the same, for launches about some of the texels."""
        return replace(self, lane=lane)

    def sees(self, view: Any) -> Any:
        """Read the first column of a view, for the lanes of a launch: Float."""
        return dr.gather(mi.Float, self.first, self._block(view) * BLOCK + self.lane % BLOCK)

    def read(self, view: Any, column: Any) -> Any:
        """Read another column of a view, from 1 on: Float, 0 where it does not see the texel."""
        return dr.gather(mi.Float, self.rest, self._place(view, column), self.sees(view) > 0)

    def write(self, view: Any, columns: list[Any], active: Any) -> None:
        """Write all columns of a view, within the kernel that computes them."""
        place = self._block(view) * BLOCK + self.lane % BLOCK
        dr.scatter(self.first, columns[0], place, active, dr.ReduceMode.NoConflicts)
        for column, value in enumerate(columns[1:], 1):
            place = self._place(view, column)
            dr.scatter(self.rest, value, place, active, dr.ReduceMode.NoConflicts)

    def _place(self, view: Any, column: Any) -> Any:
        row = self._block(view) * (self.columns - 1) + (column - 1)
        return row * BLOCK + self.lane % BLOCK

    def _block(self, view: Any) -> Any:
        return (self.lane // BLOCK) * self.views + view


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
    pairs = -(-count // BLOCK) * BLOCK * number
    room = pairs * columns
    if room >= 2**32:
        raise OptionError(
            f"next_best_view(): {count} texels are too many for {number} views; use "
            f"at most {count * 2**32 // room} (texels=...).",
            shell=f"{count} texels are too many for {number} views; give --texels "
            f"{count * 2**32 // room}, or fewer.",
        )
    responses = Responses(
        first=dr.zeros(mi.Float, pairs), rest=dr.empty(mi.Float, room - pairs),
        views=dr.opaque(mi.UInt32, number), columns=columns, count=count, lane=surface.lane,
    )  # fmt: skip
    dr.eval(responses.first)

    def record(seen: Observation, view: Any) -> tuple[()]:
        def write() -> tuple[()]:
            responses.write(view, respond(seen), seen.seen)
            return ()

        return dr.if_stmt(args=(), cond=seen.seen, true_fn=write, false_fn=lambda: ())

    first = dr.opaque(mi.UInt32, views.number)
    found.over_views(
        views, surface, lambda seen, slot: record(seen, dr.gather(mi.UInt32, found.order, slot)), ()
    )
    dr.eval(responses.first, responses.rest)
    over_views(candidates, surface, lambda seen, view: record(seen, first + view), ())
    dr.eval(responses.first, responses.rest)
    return responses
