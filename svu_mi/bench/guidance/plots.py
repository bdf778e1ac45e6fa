"""guidance.png: PSNR and entropy against the number of added views (Fig. 9 of the paper)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.guidance.verdict import object_curves
from svu_mi.bench.plots import COLORS, INK, MARKS, page, tidy
from svu_mi.bench.sizes import GuidanceSizes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

def draw_guidance(found: Record) -> Figure:
    """Draw both curves of every strategy, from the records of all benchmarks."""
    runs, sizes = found["guidance"]["cells"], found["guidance"]["sizes"].guidance
    figure = page(12.0, 4.6)
    left, right = figure.subplots(1, 2)
    _curves(left, runs, sizes, "psnr", "average texture PSNR over the start's (dB)")
    left.axhline(sizes.step, color=INK, linewidth=0.6, linestyle=":")
    _curves(right, runs, sizes, "entropy", "mean entropy, relative to the start's")
    left.legend(frameon=False, fontsize=8)
    return figure


def _curves(
    axes: Axes, runs: list[Record], sizes: GuidanceSizes, name: str, label: str
) -> None:
    """Mean over objects, and its standard error as a band."""
    places = [0, *sizes.marks]
    for k, strategy in enumerate(sizes.strategies):
        color, mark = COLORS[k % len(COLORS)], MARKS[k % len(MARKS)]
        curves = object_curves(runs, strategy, name)
        mean, error = curves.mean(axis=0), np.zeros(curves.shape[1])
        if len(curves) > 1:
            error = curves.std(axis=0, ddof=1) / np.sqrt(len(curves))
        style = {"color": color, "markersize": 5, "linewidth": 1.2}
        axes.plot(places, mean, mark + "-", label=strategy, **style)
        axes.fill_between(places, mean - error, mean + error, color=color, alpha=0.12, linewidth=0)
    axes.set(xlabel="photographs added", ylabel=label)
    axes.set_title(f"{len(runs)} starts of {sizes.start} photographs", fontsize=10, color=INK)
    tidy(axes)
