"""Charts of an HTML page: bars and lines in the coordinates of a small SVG; see ``parts.html``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

WIDTH, HEIGHT = 320, 170
LEFT, RIGHT, TOP, BOTTOM = 44, 8, 10, 26  # margins, where the words of the axes are
GAP = 0.12  # between bars, in parts of one


@dataclass(frozen=True)
class Bar:
    """A bar; ``color`` is None for the page's own, ``words`` appear when it is pointed at."""

    x: float
    y: float
    width: float
    height: float
    color: str | None
    words: str


@dataclass(frozen=True)
class Plot:
    """Bars and lines, in pixels of an SVG.

    Attributes:
        width: of the whole.
        height: of the whole.
        bars: from left to right.
        lines: pairs of a style of ``page.css`` (``red``, ``even``, ...) and a polyline's points.
        x_ticks: pairs of a place and its words.
        y_ticks: the same.
        words: what is shown, for those who cannot see it.
    """

    width: float
    height: float
    bars: tuple[Bar, ...]
    lines: tuple[tuple[str, str], ...]
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]
    words: str

    @property
    def floor(self) -> float:
        """Where the bars stand."""
        return self.height - BOTTOM

    @property
    def left(self) -> float:
        """Where the bars begin."""
        return LEFT

    @property
    def right(self) -> float:
        """Where the bars end."""
        return self.width - RIGHT


def plot(
    edges: np.ndarray,
    heights: np.ndarray | None,
    words: str,
    *,
    top: float,
    y_ticks: Sequence[tuple[float, str]],
    x_ticks: Sequence[tuple[float, str]],
    lines: Sequence[tuple[str, np.ndarray, np.ndarray]] = (),
    colors: Sequence[str] | None = None,
    labels: Sequence[str] | None = None,
    width: float = WIDTH,
    height: float = HEIGHT,
) -> Plot:
    """Lay out a plot.

    Args:
        edges: (N + 1,) borders of the bars, increasing.
        heights: (N,) of the bars; None for lines alone.
        words: what is shown.
        top: value at the upper end.
        y_ticks: values and what to write beside them.
        x_ticks: the same, below.
        lines: style, x and y of each.
        colors: (N,) of the bars.
        labels: (N,) words on the bars.
        width: in pixels.
        height: in pixels.
    """
    low, high = float(edges[0]), float(edges[-1])

    def x(value: float) -> float:
        return round(LEFT + (value - low) / (high - low) * (width - LEFT - RIGHT), 2)

    def y(value: float) -> float:
        part = min(max(value / top, 0), 1)
        return round(height - BOTTOM - part * (height - TOP - BOTTOM), 2)

    bars = []
    for k, value in enumerate([] if heights is None else heights):
        first, last = x(edges[k]), x(edges[k + 1])
        gap = GAP / 2 * (last - first)
        size = round(last - first - 2 * gap, 2)
        bars.append(Bar(
            round(first + gap, 2), y(value), size, round(y(0) - y(value), 2),
            colors[k] if colors else None, labels[k] if labels else "",
        ))  # fmt: skip
    points = [
        (style, " ".join(f"{x(a)},{y(b)}" for a, b in zip(across, up, strict=True)))
        for style, across, up in lines
    ]
    return Plot(
        width, height, tuple(bars), tuple(points), tuple((x(v), text) for v, text in x_ticks),
        tuple((y(v), text) for v, text in y_ticks), words,
    )  # fmt: skip
