"""Plots of a report: entropy histogram, mean marginals, marginals of single texels."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.output.estimate_arrays import (
    column_and_row,
    coverages,
    entropies,
    is_seen,
    label_of,
    mean_marginals,
    open_axes,
    prior_marginal,
)
from svu_mi.output.html import PageImage, grouped
from svu_mi.output.interval_summary import interval_of
from svu_mi.output.panels import bar_edges
from svu_mi.output.report.turntable import Turntable
from svu_mi.output.style import css_colors
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.posterior import Posterior

BINS = 25  # bars of the histogram
TOPS = (0.2, 0.3, 0.5, 1.0)  # possible upper ends of probability axes
CHANNEL_STYLES = ("red", "green", "blue")
# Example texels: name, and quantile of the entropy of seen texels.
EXAMPLES = (("Low entropy", 0.01), ("Median entropy", 0.5), ("High entropy", 0.99))
ALIKE = 200  # texels of similar entropy from which the most visible one is chosen
LEFT, RIGHT, TOP, BOTTOM = 44, 8, 10, 26  # margins for axis labels, in pixels
GAP = 0.12  # gap between bars, relative to a bar


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Bars and lines in pixels of an SVG.

    Attributes:
        alt: Alternative text.
        edges: (N + 1,) increasing edges of the bars.
        heights: (N,) values of the bars; empty for lines only.
        labels: (N,) tooltips of the bars.
        colors: (N,) colours of the bars; empty for the page's colour.
        lines: Style from ``page.css`` (``red``, ``prior``, ...), x values and y values per line.
        top: Value at the upper end.
        x_ticks: Values and labels of the x axis.
        y_ticks: Values and labels of the y axis.
    """

    alt: str
    edges: np.ndarray
    heights: Sequence[float] | np.ndarray = ()
    labels: Sequence[str] = ()
    colors: Sequence[str] = ()
    lines: Sequence[tuple[str, np.ndarray, np.ndarray]] = ()
    top: float
    x_ticks: Sequence[tuple[float, str]] = ((0, "0"), (0.5, "0.5"), (1, "1"))
    y_ticks: Sequence[tuple[float, str]]
    width: float = 320
    height: float = 170

    @property
    def box(self) -> tuple[float, float, float]:
        """Left end, right end and lower end of the bars in pixels."""
        return LEFT, self.width - RIGHT, self.height - BOTTOM

    def x(self, value: float) -> float:
        """Return the x coordinate of a value."""
        (left, right, _), low, high = self.box, self.edges[0], self.edges[-1]
        return round(float(left + (value - low) / (high - low) * (right - left)), 2)

    def y(self, value: float) -> float:
        """Return the y coordinate of a value, clamped to the axis."""
        floor = self.box[2]
        return round(float(floor - min(max(value / self.top, 0), 1) * (floor - TOP)), 2)

    def bars(self) -> Iterator[dict[str, float]]:
        """Yield x, y, width and height of each bar."""
        for first, last, value in zip(self.edges, self.edges[1:], self.heights, strict=False):
            width = self.x(last) - self.x(first)
            x, y = round(self.x(first) + GAP / 2 * width, 2), self.y(value)
            yield {"x": x, "y": y, "width": round((1 - GAP) * width, 2),
                   "height": round(self.box[2] - y, 2)}  # fmt: skip

    def polylines(self) -> Iterator[tuple[str, str]]:
        """Yield style and SVG points of each line."""
        for style, across, up in self.lines:
            yield (
                style,
                " ".join(f"{self.x(a)},{self.y(b)}" for a, b in zip(across, up, strict=True)),
            )


def entropy_histogram(estimate: Estimate) -> Plot | None:
    """Return the histogram of the entropy; None if no texel is seen."""
    values = entropies(estimate)[is_seen(estimate)]
    if len(values) == 0:
        return None
    edges = np.linspace(0, 1, BINS + 1)
    parts = np.histogram(values, edges)[0] / len(values)
    most = parts.max()
    return Plot(
        alt=f"Histogram of entropy; the median is {np.median(values):.2f}.",
        edges=edges, heights=parts, colors=css_colors((edges[1:] + edges[:-1]) / 2),
        labels=[f"{a:.2f} to {b:.2f}: {100 * p:.1f} %"
                for a, b, p in zip(edges, edges[1:], parts, strict=False)],
        top=1.08 * most, y_ticks=[(0, "0"), (most, f"{100 * most:.0f} %")],
    )  # fmt: skip


def marginal_plots(estimate: Estimate) -> Iterator[tuple[str, Plot]]:
    """Yield the mean marginal of each open parameter over seen texels, if there are any."""
    if not is_seen(estimate).any():
        return
    of_all, of_lowest = mean_marginals(estimate)
    for name in open_axes(estimate):
        yield label_of(name), _marginal(estimate.posterior, name, of_all[name], of_lowest[name])


def example_texels(
    table: Turntable, estimate: Estimate, frames: list[PageImage]
) -> Iterator[dict[str, Any]]:
    """Yield seen texels of low, median and high entropy with their marginals, from several sides.

    ``x`` and ``y`` are the texel's position in ``picture``, in percent of its width and height.
    If no frame shows the texel, ``picture`` is None.
    """
    seen, entropy = np.flatnonzero(is_seen(estimate)), entropies(estimate)
    order = seen[np.argsort(entropy[seen], kind="stable")]
    used: list[int] = []
    for name, part in EXAMPLES if len(order) else ():
        rank = int(part * (len(order) - 1))
        alike = order[max(rank - ALIKE // 2, 0) : rank + ALIKE // 2 + 1]
        place = None
        for sides in (table.frames_apart(used), None):
            place = place or table.find(estimate.texels, alike, sides)
        texel, number, x, y = place or (int(order[rank]), -1, 0.0, 0.0)
        used += [number] if place else []
        marginals = {
            n: np.array(p, np.float64).reshape(p.shape[1], -1)
            for n, p in estimate.posterior.marginals([texel]).items()
        }
        count = int(coverages(estimate)[texel])
        column, row = column_and_row(estimate, texel)
        yield {
            "name": name, "picture": frames[number] if place else None, "x": 100 * x, "y": 100 * y,
            "sentence": f"Entropy {entropy[texel]:.2f}, in {grouped(count)} "
            f"photograph{'s' if count != 1 else ''}; column {column}, row {row} of the texture.",
            "plots": [(label_of(n), _marginal(estimate.posterior, n, marginals[n]),
                       _interval_text(*interval_of(estimate.posterior, n, texel)))
                      for n in open_axes(estimate)],
        }  # fmt: skip


def _interval_text(low: np.ndarray, high: np.ndarray) -> str:
    """Return the interval of one texel: "0.12 to 0.31", or "R 0.12 to 0.31, G ..."."""
    texts = [f"{a:.2f} to {b:.2f}" for a, b in zip(low, high, strict=True)]
    return texts[0] if len(texts) == 1 else ", ".join(map(" ".join, zip("RGB", texts, strict=True)))


def _marginal(
    posterior: Posterior, name: str, p: np.ndarray, lowest: np.ndarray | None = None
) -> Plot:  # fmt: skip
    """Plot a marginal as bars, or as one line per channel; ``lowest`` is dashed."""
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
        alt=f"Probability of {label_of(name)}: most at {nodes[p.mean(axis=1).argmax()]:.2f}.",
        edges=bar_edges(nodes), heights=bars, lines=lines,
        labels=[f"{v:.2f}: {100 * q:.1f} %" for v, q in zip(nodes, bars, strict=False)],
        top=top, y_ticks=[(t, f"{100 * t:.0f} %") for t in (0, top / 2, top)],
    )  # fmt: skip
