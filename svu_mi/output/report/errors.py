"""How well textures explain the photographs: views rendered, and compared with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.output import relit, views
from svu_mi.output.chart import Plot
from svu_mi.output.page import NARROW_SPACE, Picture, drawing, photograph
from svu_mi.output.relit import Comparison
from svu_mi.output.report.pictures import spread
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.textures import Textures, lay_out

COMPARED = 30  # most views that are rendered
SIDE = 64  # pixels of renders that only errors are taken of
SAMPLES = 36  # per pixel: with fewer, their noise would be most of the error
SHOWN_SIDE, SHOWN_SAMPLES = 224, 16  # of renders that are shown, and no errors taken of
WIDTH = 900  # of the chart


@dataclass(frozen=True)
class Errors:
    """Mean differences of views, as sentences have them.

    Attributes:
        rows: name of each view that was rendered, and its error.
        mean: over views.
        chart: a bar per view.
        shown: the best, a typical and the worst: name, pictures of photograph, render and
            difference, and error.
        views: number of those that were used.
    """

    rows: list[tuple[str, str]]
    mean: str
    chart: Plot
    shown: list[tuple[str, list[Picture], str]]
    views: int


def errors(capture: Capture, textures: Textures, grey: bool) -> Errors | None:
    """Render views in some textures and compare them with the photographs.

    Args:
        capture: of which some views are taken, evenly through their order.
        textures: of its object.
        grey: whether brightness alone is to be compared.

    Returns:
        None if no photograph shows the object.
    """
    used = [view for view in range(capture.count) if capture.used[view]]
    compared = _compare(capture, textures, spread(used, COMPARED), grey, (SIDE, SAMPLES))
    found = {c.view: e for c in compared if (e := c.mean_difference) is not None}
    if not found:
        return None
    values = np.array(list(found.values()))
    rows = [(capture.names[view], _percent(error)) for view, error in found.items()]
    order = np.array(list(found))[np.argsort(values, kind="stable")].tolist()
    extremes = list(dict.fromkeys([order[0], order[len(order) // 2], order[-1]]))
    return Errors(
        rows, _percent(values.mean()), _chart(values, rows),
        [(capture.names[c.view], _pictures(c), _percent(found[c.view]))
         for c in _compare(capture, textures, extremes, grey, (SHOWN_SIDE, SHOWN_SAMPLES))],
        len(used),
    )  # fmt: skip


def most_probable(estimate: Any) -> Textures | None:
    """Return the most probable materials as textures, if they are Mitsuba's ``principled``."""
    best = {name: np.array(values) for name, values in estimate.posterior.map().items()}
    if set(best) != set(NAMES):
        return None
    color = best["base_color"].reshape(estimate.texels.count, -1)
    best["base_color"] = np.broadcast_to(color, (len(color), CHANNELS["base_color"]))
    return lay_out(estimate.texels, best)


def _chart(values: np.ndarray, rows: list[tuple[str, str]]) -> Plot:
    ends = [(0.5, rows[0][0]), (len(rows) - 0.5, rows[-1][0])]
    return Plot(
        words="Mean difference of each view.", edges=np.arange(len(values) + 1), heights=values,
        labels=[": ".join(row) for row in rows], top=1.1 * max(values.max(), 0.01),
        x_ticks=ends[: len(rows)], y_ticks=[(0, "0"), (values.max(), _percent(values.max()))],
        width=WIDTH,
    )  # fmt: skip


def _compare(
    capture: Capture, textures: Textures, chosen: list[int], grey: bool, size: tuple[int, int]
) -> list[Comparison]:
    """Compare views in pictures of some size: pixels of their longer side, and samples of each."""
    side, spp = size
    compared = relit.explain(capture, textures, chosen, spp, side)

    def brightness(image: np.ndarray) -> np.ndarray:
        return np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)

    return [
        replace(c, photograph=brightness(c.photograph), render=brightness(c.render)) if grey else c
        for c in compared
    ]


def _pictures(comparison: Comparison) -> list[Picture]:
    window = views.object_window(comparison.inside)
    usable = np.isfinite(comparison.difference)
    image, render, difference, inside, usable = (
        views.crop(i, window) for i in (*comparison.pictures, comparison.inside, usable)
    )
    return [
        photograph(image), drawing(np.dstack([render, inside])),
        drawing(np.dstack([difference, usable])),
    ]  # fmt: skip


def _percent(difference: float) -> str:
    return f"{100 * difference:.1f}{NARROW_SPACE}%"
