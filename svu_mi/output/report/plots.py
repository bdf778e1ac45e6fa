"""Plots of a report: entropies, marginals of all texels and of single ones, errors of views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.output import views
from svu_mi.output.chart import Plot, plot
from svu_mi.output.figures import bar_edges
from svu_mi.output.knowledge import Intervals
from svu_mi.output.page import NARROW_SPACE, Picture, drawing, grouped
from svu_mi.output.page import photograph as embedded
from svu_mi.output.relit import SIDE as LARGE
from svu_mi.output.relit import Comparison, explain
from svu_mi.output.report.pictures import spread
from svu_mi.output.report.turntable import Turntable
from svu_mi.output.result import (
    Result,
    mean_marginals,
    open_axes,
    place_of,
    prior_marginal,
    words,
)
from svu_mi.output.style import css_colors
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.textures import Textures, lay_out

BINS = 25  # of the histogram
TOPS = (0.2, 0.3, 0.5, 1.0)  # of axes of probability
CHANNEL_STYLES = ("red", "green", "blue")
# Texels to look at: names, and the part of all seen texels that have a lower entropy.
EXAMPLES = (("Low entropy", 0.01), ("Median entropy", 0.5), ("High entropy", 0.99))
ALIKE = 200  # texels of about that entropy, of which the one that is shown best is taken
COMPARED = 48  # most views that are rendered
SIDE = 96  # pixels of renders that only errors are taken of
SAMPLES = 96  # per pixel: with fewer, their noise would be most of the error
ZEROS_AND_ONE = ((0, "0"), (0.5, "0.5"), (1, "1"))


@dataclass(frozen=True)
class Example:
    """One texel.

    Attributes:
        name: what it stands for.
        sentence: what is known of it.
        picture: the object; None if no frame shows the texel.
        x: where it is in the picture, in percent from the left.
        y: the same from the top.
        plots: of each open parameter its name, its marginal, and its interval in words.
    """

    name: str
    sentence: str
    picture: Picture | None
    x: float
    y: float
    plots: tuple[tuple[str, Plot, str], ...]


@dataclass(frozen=True)
class Shown:
    """A view beside what textures say of it: three pictures and a percentage."""

    name: str
    pictures: tuple[Picture, Picture, Picture]
    error: str


@dataclass(frozen=True)
class Errors:
    """How well textures explain the photographs.

    Attributes:
        rows: name of each view that was rendered, and its error.
        mean: over views.
        chart: a bar per view.
        shown: the best, a typical and the worst.
        views: number of those that were used.
    """

    rows: tuple[tuple[str, str], ...]
    mean: str
    chart: Plot
    shown: tuple[Shown, ...]
    views: int


def histogram(result: Result) -> Plot | None:
    """Return how often which entropy occurs, None if nothing is seen."""
    values = result.entropy[result.seen]
    if len(values) == 0:
        return None
    edges = np.linspace(0, 1, BINS + 1)
    parts = np.histogram(values, edges)[0] / len(values)
    top = 1.08 * parts.max()
    centers = (edges[1:] + edges[:-1]) / 2
    labels = [f"{a:.2f} to {b:.2f}: {100 * p:.1f} %"
              for a, b, p in zip(edges, edges[1:], parts, strict=False)]  # fmt: skip
    return plot(
        edges, parts, f"Histogram of entropy; the median is {np.median(values):.2f}.",
        top=top, y_ticks=[(0, "0"), (parts.max(), f"{100 * parts.max():.0f} %")],
        x_ticks=ZEROS_AND_ONE, colors=css_colors(centers), labels=labels,
    )  # fmt: skip


def marginals(estimate: Any, result: Result) -> list[tuple[str, Plot]]:
    """Return the mean marginal of each open parameter, over all texels seen."""
    if not result.seen.any():
        return []
    found = []
    for name, nodes in open_axes(estimate).items():
        means = mean_marginals(estimate, result, name)
        prior = prior_marginal(estimate.posterior, name)
        found.append((words(name), _marginal(name, nodes, prior, means[False], means[True])))
    return found


def examples(
    table: Turntable, estimate: Any, result: Result, intervals: Intervals, frames: list[Picture]
) -> list[Example]:
    """Return a texel of low, one of median and one of high entropy, if any is seen."""
    seen = np.flatnonzero(result.seen)
    order = seen[np.argsort(result.entropy[seen], kind="stable")]
    found: list[Example] = []
    for name, part in EXAMPLES if len(order) else ():
        rank = int(part * (len(order) - 1))
        alike = order[max(rank - ALIKE // 2, 0) : rank + ALIKE // 2 + 1]
        place = table.find(estimate.texels, alike)
        texel, number, x, y = place or (int(order[rank]), -1, 0.0, 0.0)
        count = int(result.coverage[texel])
        column, row = place_of(estimate, texel)
        found.append(Example(
            name,
            f"Entropy {result.entropy[texel]:.2f}, in {grouped(count)} "
            f"photograph{'s' if count != 1 else ''}; column {column}, row {row} of the texture.",
            frames[number] if place else None, 100 * x, 100 * y,
            tuple((words(n), _texel_marginal(estimate, texel, n),
                   _interval_words(intervals, n, texel)) for n in open_axes(estimate)),
        ))  # fmt: skip
    return found


def errors(capture: Capture, textures: Textures, grey: bool) -> Errors | None:
    """Render views in some textures and compare them with the photographs.

    Args:
        capture: the ``Capture``.
        textures: of its object.
        grey: whether brightness alone is to be compared.

    Returns:
        None if no photograph shows the object.
    """
    used = [view for view in range(capture.count) if capture.used[view]]
    compared = _compare(capture, textures, spread(used, COMPARED), grey, SIDE)
    found = {c.view: e for c in compared if (e := c.mean_difference) is not None}
    if not found:
        return None
    values = np.array(list(found.values()))
    names = [capture.names[view] for view in found]
    top = 1.1 * max(values.max(), 0.01)
    chart = plot(
        np.arange(len(values) + 1), values, "Mean difference of each view.", top=top,
        y_ticks=[(0, "0"), (values.max(), _percent(values.max()))],
        x_ticks=[(0.5, names[0]), (len(values) - 0.5, names[-1])][: len(values)],
        labels=[f"{name}: {_percent(value)}" for name, value in zip(names, values, strict=True)],
        width=900,
    )  # fmt: skip
    order = list(np.array(list(found))[np.argsort(values, kind="stable")])
    extremes = dict.fromkeys([order[0], order[len(order) // 2], order[-1]])
    larger = _compare(capture, textures, [int(view) for view in extremes], grey, LARGE)
    return Errors(
        tuple((name, _percent(value)) for name, value in zip(names, values, strict=True)),
        _percent(values.mean()), chart,
        tuple(_shown(capture.names[c.view], c, found[c.view]) for c in larger), len(used),
    )  # fmt: skip


def most_probable(estimate: Any) -> Textures | None:
    """Return the most probable materials as textures, if they are Mitsuba's ``principled``."""
    best = {name: np.array(values) for name, values in estimate.posterior.map().items()}
    if set(best) != set(NAMES):
        return None
    color = best["base_color"].reshape(estimate.texels.count, -1)
    best["base_color"] = np.broadcast_to(color, (len(color), CHANNELS["base_color"]))
    return lay_out(estimate.texels, best)


def _compare(
    capture: Any, textures: Textures, chosen: list[int], grey: bool, side: int
) -> list[Comparison]:
    compared = explain(capture, textures, chosen, SAMPLES, side)
    if not grey:
        return compared

    def brightness(image: np.ndarray) -> np.ndarray:
        return np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)

    return [
        replace(c, photograph=brightness(c.photograph), render=brightness(c.render))
        for c in compared
    ]


def _shown(name: str, comparison: Comparison, error: float) -> Shown:
    window = views.object_window(comparison.inside)
    photograph, render, difference = (views.crop(i, window) for i in comparison.pictures())
    inside = views.crop(comparison.inside, window)
    usable = views.crop(np.isfinite(comparison.difference()), window)
    pictures = (
        embedded(photograph),
        drawing(np.dstack([render, inside])),
        drawing(np.dstack([difference, usable])),
    )
    return Shown(name, pictures, _percent(error))


def _interval_words(intervals: Intervals, name: str, texel: int) -> str:
    """Word a texel's interval: "0.12 to 0.31", or "R 0.12 to 0.31, G ..."."""
    low, high = (end[texel] for end in intervals.ends(name))
    told = [f"{a:.2f} to {b:.2f}" for a, b in zip(low, high, strict=True)]
    return told[0] if len(told) == 1 else ", ".join(map(" ".join, zip("RGB", told, strict=True)))


def _texel_marginal(estimate: Any, texel: int, name: str) -> Plot:
    nodes = estimate.posterior.axes[name]
    p = np.array(estimate.posterior.marginal(name, [texel]), np.float64)
    prior = prior_marginal(estimate.posterior, name)
    return _marginal(name, nodes, prior, p.reshape(len(nodes), -1), None)


def _marginal(
    name: str, nodes: np.ndarray, prior: np.ndarray, p: np.ndarray, lowest: np.ndarray | None
) -> Plot:  # fmt: skip
    """Bars, or lines for three channels; dashed: of lowest entropy; dotted: knowing nothing."""
    several = p.shape[1] == 3
    edges = bar_edges(nodes)
    lines = [("prior", nodes, prior)]
    if several:
        lines += [(style, nodes, p[:, k]) for k, style in enumerate(CHANNEL_STYLES)]
    if lowest is not None:
        styles = [f"{style} lowest" for style in (CHANNEL_STYLES if several else ("ink",))]
        lines += [(style, nodes, lowest[:, k]) for k, style in enumerate(styles)]
    highest = max(float(q.max()) for q in (p, prior, lowest) if q is not None)
    top = next((t for t in TOPS if t >= highest), TOPS[-1])
    return plot(
        edges, None if several else p[:, 0],
        f"Probability of {words(name)}: most at {nodes[p.mean(axis=1).argmax()]:.2f}.",
        top=top, y_ticks=[(t, f"{100 * t:.0f} %") for t in (0, top / 2, top)],
        x_ticks=ZEROS_AND_ONE, lines=lines,
        labels=[f"{v:.2f}: {100 * q:.1f} %" for v, q in zip(nodes, p[:, 0], strict=True)],
    )  # fmt: skip


def _percent(difference: float) -> str:
    return f"{100 * difference:.1f}{NARROW_SPACE}%"
