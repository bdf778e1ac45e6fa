"""guidance.png: PSNR and entropy against the number of added views (Fig. 9 of the paper)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.bench.guidance.verdict import object_curves
from svu_mi.bench.plots import COLORS, INK, MARKS, page, save, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Record = dict[str, Any]


def draw_guidance(folder: Path, record: Record) -> list[Path]:
    """Write ``guidance.png``, unless there is nothing to show.

    Args:
        folder: of the file.
        record: what ``run_guidance`` returns.

    Returns:
        The files written.

    Raises:
        OutputError: the file cannot be written.
    """
    if not record["runs"]:
        return []
    figure = page(12.0, 4.6)
    left, right = figure.subplots(1, 2)
    _curves(left, record, "psnr", "average texture PSNR over the start's (dB)")
    left.axhline(record["sizes"].step, color=INK, linewidth=0.6, linestyle=":")
    _curves(right, record, "entropy", "mean entropy, relative to the start's")
    left.legend(frameon=False, fontsize=8)
    return [save(figure, folder, "guidance")]


def _curves(axes: Axes, record: Record, name: str, label: str) -> None:
    """Mean over objects, and its standard error as a band."""
    runs, sizes = record["runs"], record["sizes"]
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
