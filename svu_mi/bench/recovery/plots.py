"""recovery.png: run time against the error of textures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.plots import COLORS, INK, MARKS, page, tidy, time_axis
from svu_mi.bench.recovery.rows import ROWS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_recovery(found: Record) -> Figure:
    """Draw run time against average texture PSNR, every cell small, their mean large, from the
    records of all benchmarks."""
    cells, figure = found["recovery"]["cells"], page(6.5, 4.8)
    axes = figure.add_subplot()
    times: list[float] = []
    for number, row in enumerate(ROWS):
        having = [cell["rows"][row.label] for cell in cells if row.label in cell["rows"]]
        if not having:
            continue
        color, mark = COLORS[number % len(COLORS)], MARKS[number % len(MARKS)]
        took = [one["seconds"] for one in having]
        good = [one["psnr"]["average"] for one in having]
        axes.plot(took, good, mark, color=color, markersize=3.5, alpha=0.35)
        axes.plot([float(np.mean(took))], [float(np.mean(good))], mark, color=color, markersize=10,
                  markeredgecolor="white", label=row.label, zorder=3)  # fmt: skip
        times += took
    time_axis(axes, times)
    axes.set(xlabel="run time, kernels compiled", ylabel="average texture PSNR (dB)")
    axes.set_title(f"{len(cells)} cells (small) and their mean", fontsize=10, color=INK)
    axes.legend(frameon=False, fontsize=8)
    tidy(axes)
    return figure
