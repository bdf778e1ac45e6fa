"""How far predictions of photographs hold, as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from svu_mi.bench.experiment import Record
from svu_mi.bench.plots import COLORS, FAINT, MARKS, page, tidy
from svu_mi.bench.real.score import LEVELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_real(found: dict[str, Record]) -> Figure | None:
    """Draw R^2 of every photograph in every way, and how intervals hold.

    Args:
        found: records of all benchmarks.
    """
    if "real" not in found or not found["real"]["cells"]:
        return None
    (cell,) = found["real"]["cells"]
    figure = page(11, 4.6)
    views, held = figure.subplots(1, 2, width_ratios=(2, 1))
    for (label, row), color, mark in zip(cell["rows"].items(), COLORS, MARKS, strict=False):
        views.plot(row["views"], mark, color=color, label=f"{label} ({row['r2']:.3f})", ms=5)
        if row["holds"]:
            parts = [row["holds"][str(level)] for level in LEVELS]
            held.plot(LEVELS, parts, mark + "-", color=color, label=label)
    views.set_ylim(max(min(-0.1, *(min(row["views"], default=0) for row in cell["rows"].values())),
                       -1), 1)  # fmt: skip
    views.set(xlabel="photograph that was left out", ylabel="R² of its radiance",
              title=f"{cell['cell']}: photographs predicted from the others")  # fmt: skip
    held.plot([0, 1], [0, 1], color=FAINT, lw=1, label="as they should")
    held.set(xlabel="probability of an interval", ylabel="part of intervals that hold",
             xlim=(0.4, 1), ylim=(0.4, 1), title="Intervals of pixels")  # fmt: skip
    for axes in (views, held):
        tidy(axes)
        axes.legend(frameon=False, fontsize=9)
    return figure
