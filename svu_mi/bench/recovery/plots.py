"""recovery.png: run time against the error of textures, and what sharing gains."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.bench.plots import COLORS, FAINT, INK, MARKS, page, save, tidy, time_axis
from svu_mi.bench.recovery.bars import gain
from svu_mi.bench.recovery.rows import PATH, PATH_SHARING, ROWS, SH, SH_SHARING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Record = dict[str, Any]


def draw_recovery(folder: Path, record: Record) -> list[Path]:
    """Write ``recovery.png``, unless there is nothing to show.

    Args:
        folder: of the file.
        record: what ``run_recovery`` returns.

    Returns:
        The files written.

    Raises:
        OutputError: the file cannot be written.
    """
    groups = {cell["group"] for cell in record["cells"]}
    even, shared = "even" in groups, bool(groups - {"even"})
    if not groups:
        return []
    figure = page(6.5 * (even + shared), 4.8)
    panels = figure.subplots(1, even + shared, squeeze=False)[0]
    if even:
        _time_error(panels[0], [cell for cell in record["cells"] if cell["group"] == "even"])
    if shared:
        _gains(panels[-1], record["cells"])
    return [save(figure, folder, "recovery")]


def _time_error(axes: Axes, cells: list[Record]) -> None:
    """Warm run time against average texture PSNR: every cell small, their mean large."""
    times: list[float] = []
    for number, row in enumerate(ROWS):
        found = [cell["rows"][row.label] for cell in cells if row.label in cell["rows"]]
        if not found:
            continue
        color, mark = COLORS[number % len(COLORS)], MARKS[number % len(MARKS)]
        took = [one["seconds"] for one in found]
        good = [one["psnr"]["average"] for one in found]
        axes.plot(took, good, mark, color=color, markersize=3.5, alpha=0.35)
        axes.plot([float(np.mean(took))], [float(np.mean(good))], mark, color=color, markersize=10,
                  markeredgecolor="white", label=row.label, zorder=3)  # fmt: skip
        times += took
    time_axis(axes, times)
    axes.set(xlabel="run time, kernels compiled", ylabel="average texture PSNR (dB)")
    axes.set_title(f"{len(cells)} cells (small) and their mean", fontsize=10, color=INK)
    axes.legend(frameon=False, fontsize=8)
    tidy(axes)


def _gains(axes: Axes, cells: list[Record]) -> None:
    """What sharing gains in each cell of the sharing groups."""
    bars: list[tuple[str, list[tuple[float, str]]]] = []
    for group in ("repeated", "varied"):
        for cell in (cell for cell in cells if cell["group"] == group):
            found = []
            for row, base, color in ((SH_SHARING, SH, COLORS[0]), (PATH_SHARING, PATH, COLORS[1])):
                found += [(value, color) for value in gain([cell], group, row, base)]
            bars.append((f"{cell['object']} / {cell['light']} ({group})", found))
    for place, (_, found) in enumerate(reversed(bars)):
        for k, (value, color) in enumerate(found):
            axes.barh(place + 0.18 - 0.36 * k, value, height=0.34, color=color)
    axes.set_yticks(range(len(bars)), [name for name, _ in reversed(bars)], fontsize=8)
    axes.axvline(0, color=INK, linewidth=0.8)
    for least, color in ((1.5, COLORS[0]), (0.5, COLORS[1]), (-0.1, FAINT)):
        axes.axvline(least, color=color, linewidth=0.8, linestyle=":")
    axes.plot([], [], "s", color=COLORS[0], label="SH")
    axes.plot([], [], "s", color=COLORS[1], label="path")
    axes.legend(frameon=False, fontsize=8, title="dotted: bars", title_fontsize=7)
    axes.set_xlabel("gain of sharing, average texture PSNR (dB)")
    tidy(axes)
