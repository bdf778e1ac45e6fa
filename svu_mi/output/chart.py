"""Charts of an HTML page: bars and lines in the coordinates of a small SVG; see ``parts.html``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

LEFT, RIGHT, TOP, BOTTOM = 44, 8, 10, 26  # margins, where the words of the axes are
GAP = 0.12  # between bars, in parts of one


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Bars and lines; the template asks where they are, in pixels of an SVG.

    Attributes:
        words: what is shown, for those who cannot see it.
        edges: (N + 1,) borders of the bars, increasing.
        heights: (N,) of the bars; empty for lines alone.
        labels: (N,) words that appear when a bar is pointed at.
        colors: (N,) of the bars; empty for the page's own.
        lines: style of ``page.css`` (``red``, ``prior``, ...), x and y of each.
        top: value at the upper end.
        x_ticks: values and what to write below them.
        y_ticks: the same, on the left.
        width: of the whole, in pixels.
        height: of the whole.
    """

    words: str
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
    def left(self) -> float:
        """Where the bars begin."""
        return LEFT

    @property
    def right(self) -> float:
        """Where the bars end."""
        return self.width - RIGHT

    @property
    def floor(self) -> float:
        """Where the bars stand."""
        return self.height - BOTTOM

    def x(self, value: float) -> float:
        """Return how far a value is from the left."""
        low, high = self.edges[0], self.edges[-1]
        return round(float(LEFT + (value - low) / (high - low) * (self.right - LEFT)), 2)

    def y(self, value: float) -> float:
        """Return how far a value is from the top; beyond the ends of the axis, an end."""
        part = min(max(value / self.top, 0), 1)
        return round(float(self.floor - part * (self.floor - TOP)), 2)

    def bars(self) -> Iterator[dict[str, float]]:
        """Yield x, y, width and height of each bar."""
        for first, last, value in zip(self.edges, self.edges[1:], self.heights, strict=False):
            width = self.x(last) - self.x(first)
            x, y = round(self.x(first) + GAP / 2 * width, 2), self.y(value)
            yield {"x": x, "y": y, "width": round((1 - GAP) * width, 2),
                   "height": round(self.floor - y, 2)}  # fmt: skip

    def polylines(self) -> Iterator[tuple[str, str]]:
        """Yield style and points of each line, as SVG has them."""
        for style, across, up in self.lines:
            yield style, " ".join(
                f"{self.x(a)},{self.y(b)}" for a, b in zip(across, up, strict=True)
            )
