"""Plots of a report: how often which entropy occurs, marginals of all texels and of single ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.output.chart import Plot
from svu_mi.output.figures import bar_edges
from svu_mi.output.knowledge import Intervals
from svu_mi.output.page import Picture, grouped
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

BINS = 25  # of the histogram
TOPS = (0.2, 0.3, 0.5, 1.0)  # of axes of probability
CHANNEL_STYLES = ("red", "green", "blue")
# Texels to look at: names, and the part of all seen texels that have a lower entropy.
EXAMPLES = (("Low entropy", 0.01), ("Median entropy", 0.5), ("High entropy", 0.99))
ALIKE = 200  # texels of about that entropy, of which the one that is shown best is taken


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


def histogram(result: Result) -> Plot | None:
    """Return how often which entropy occurs, None if nothing is seen."""
    values = result.entropy[result.seen]
    if len(values) == 0:
        return None
    edges = np.linspace(0, 1, BINS + 1)
    parts = np.histogram(values, edges)[0] / len(values)
    most = parts.max()
    return Plot(
        words=f"Histogram of entropy; the median is {np.median(values):.2f}.",
        edges=edges, heights=parts, colors=css_colors((edges[1:] + edges[:-1]) / 2),
        labels=[f"{a:.2f} to {b:.2f}: {100 * p:.1f} %"
                for a, b, p in zip(edges, edges[1:], parts, strict=False)],
        top=1.08 * most, y_ticks=[(0, "0"), (most, f"{100 * most:.0f} %")],
    )  # fmt: skip


def marginals(estimate: Any, result: Result) -> Iterator[tuple[str, Plot]]:
    """Yield the mean marginal of each open parameter, over all texels seen, if there are any."""
    if not result.seen.any():
        return
    of_all, of_lowest = mean_marginals(estimate, result)
    for name in open_axes(estimate):
        yield words(name), _marginal(estimate.posterior, name, of_all[name], of_lowest[name])


def examples(
    table: Turntable, estimate: Any, result: Result, level: float, frames: list[Picture]
) -> Iterator[Example]:
    """Yield a texel of low, one of median and one of high entropy, if any is seen; ``level`` is
    the probability that an interval holds."""
    seen = np.flatnonzero(result.seen)
    order = seen[np.argsort(result.entropy[seen], kind="stable")]
    for name, part in EXAMPLES if len(order) else ():
        rank = int(part * (len(order) - 1))
        alike = order[max(rank - ALIKE // 2, 0) : rank + ALIKE // 2 + 1]
        place = table.find(estimate.texels, alike)
        texel, number, x, y = place or (int(order[rank]), -1, 0.0, 0.0)
        intervals = Intervals(estimate.posterior, level, np.array([texel]))
        marginals = estimate.posterior.marginals([texel])
        count = int(result.coverage[texel])
        column, row = place_of(estimate, texel)
        yield Example(
            name,
            f"Entropy {result.entropy[texel]:.2f}, in {grouped(count)} "
            f"photograph{'s' if count != 1 else ''}; column {column}, row {row} of the texture.",
            frames[number] if place else None, 100 * x, 100 * y,
            tuple((words(n), _marginal_of(estimate.posterior, n, marginals[n]),
                   _interval_words(intervals, n)) for n in open_axes(estimate)),
        )  # fmt: skip


def _interval_words(intervals: Intervals, name: str) -> str:
    """Word the interval of a single texel: "0.12 to 0.31", or "R 0.12 to 0.31, G ..."."""
    low, high = (end[0] for end in intervals.ends(name))
    told = [f"{a:.2f} to {b:.2f}" for a, b in zip(low, high, strict=True)]
    return told[0] if len(told) == 1 else ", ".join(map(" ".join, zip("RGB", told, strict=True)))


def _marginal_of(posterior: Any, name: str, marginal: Any) -> Plot:
    p = np.array(marginal, np.float64)
    return _marginal(posterior, name, p.reshape(p.shape[1], -1))


def _marginal(
    posterior: Any, name: str, p: np.ndarray, lowest: np.ndarray | None = None
) -> Plot:  # fmt: skip
    """Bars, or lines for three channels; dashed: of lowest entropy; dotted: knowing nothing."""
    nodes, prior, several = posterior.axes[name], prior_marginal(posterior, name), p.shape[1] == 3
    lines = [("prior", nodes, prior)]
    if several:
        lines += [(style, nodes, p[:, k]) for k, style in enumerate(CHANNEL_STYLES)]
    if lowest is not None:
        styles = CHANNEL_STYLES if several else ("ink",)
        lines += [(f"{style} lowest", nodes, lowest[:, k]) for k, style in enumerate(styles)]
    highest = max(float(q.max()) for q in (p, prior, lowest) if q is not None)
    top = next((t for t in TOPS if t >= highest), TOPS[-1])
    bars = () if several else p[:, 0]
    return Plot(
        words=f"Probability of {words(name)}: most at {nodes[p.mean(axis=1).argmax()]:.2f}.",
        edges=bar_edges(nodes), heights=bars, lines=lines,
        labels=[f"{v:.2f}: {100 * q:.1f} %" for v, q in zip(nodes, bars, strict=False)],
        top=top, y_ticks=[(t, f"{100 * t:.0f} %") for t in (0, top / 2, top)],
    )  # fmt: skip
