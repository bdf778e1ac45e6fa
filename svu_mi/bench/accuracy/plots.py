"""Pictures of the accuracy benchmark: run time against error, entropies, sparsification.

Each is drawn from the records of all benchmarks, by name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.plots import COLORS, FAINT, INK, MARKS, page, tidy, time_axis
from svu_mi.bench.text import seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_CELLS = 6  # rows of the scatter plot


def _styles(rows: list[Record]) -> dict[str, tuple[str, str]]:
    """Return colour and mark of the estimators, the same in every plot."""
    labels = [row["label"] for row in rows if row["kind"] == "estimator"]
    return {one: (COLORS[k % len(COLORS)], MARKS[k % len(MARKS)]) for k, one in enumerate(labels)}


def time_error(found: Record) -> Figure:
    """The headline: time for all texels, and 1 - rho, mean over cells."""
    record = found["accuracy"]
    rows, figure = record["summary"], page(9, 5.4)
    axes = figure.add_subplot()
    styles = _styles(rows)
    estimators = [row for row in rows if row["kind"] == "estimator"]
    for row in estimators:
        error, (color, mark) = 1 - row["pearson"]["mean"], styles[row["label"]]
        low, high = row["pearson"]["low"], row["pearson"]["high"]
        spread = None if low is None else [[max(0, high - 1 + error)], [1 - low - error]]
        axes.errorbar(row["seconds"], error, spread, fmt=mark, color=color, markersize=9,
                      capsize=3, elinewidth=1, label=row["label"], zorder=3)  # fmt: skip
    times = _reference_points(axes, found) + [row["seconds"] for row in estimators]
    time_axis(axes, times)
    for row in rows:
        if row["kind"] == "sanity":
            error = 1 - row["pearson"]["mean"]
            axes.axhline(error, color=FAINT, linestyle="--", linewidth=1)
            axes.annotate(f"{row['label']} alone", (0.01, error), color=FAINT, fontsize=8,
                          xycoords=("axes fraction", "data"), va="bottom")  # fmt: skip
    axes.set_ylim(bottom=0)
    axes.set_xlabel("run time for all texels (warm)")
    axes.set_ylabel("error: 1 - Pearson correlation with the reference")
    count = len(record["cells"])
    of = f"Mean over {count} cells" if count > 1 else "One cell"
    if any(row["pearson"]["low"] is not None for row in estimators):
        of += "; bars: 95 % over objects"
    axes.set_title(of, fontsize=10, color=INK)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    tidy(axes)
    return figure


def _reference_points(axes: Axes, found: Record) -> list[float]:
    """The reference by samples, and all psi by brute force; return their times.

    All are extrapolated from the reference's few texels to all.
    """
    cells, times = found["accuracy"]["cells"], []
    texels = float(np.mean([cell["texels"] / cell["reference"]["texels"] for cell in cells]))
    halves = [cell["reference"]["split_half"] for cell in cells]
    if all(half is not None for half in halves):
        times.append(float(np.mean([cell["reference"]["seconds"] for cell in cells])) * texels)
        axes.plot(times, 1 - np.mean(halves), "*", color=INK, markersize=13,
                  label="reference, half against half")  # fmt: skip
    if "speed" in found:
        parts = found["speed"]["cells"][0]["rows"]
        curve = parts["reference_spp"]["reference"]
        points = [row for row in curve if row["pearson"] is not None]
        axes.plot([row["seconds"] * texels for row in points],
                  [1 - row["pearson"] for row in points], "-o", color=INK, markersize=4,
                  linewidth=1, label="reference with fewer samples (one cell)")  # fmt: skip
        brute = parts["brute"]["seconds"]
        times += [row["seconds"] * texels for row in points] + [brute]
        axes.axvline(brute, color=INK, linestyle=":", linewidth=1.2)
        axes.annotate(f"every psi path traced: {seconds(brute)} (extrapolated)", (brute, 0.5),
                      xycoords=("data", "axes fraction"), fontsize=8, rotation=90, ha="right",
                      va="center", color=INK)  # fmt: skip
    return times


def scatter(found: Record) -> Figure:
    """Entropy of each estimator against that of the reference, cell by cell."""
    record = found["accuracy"]
    styles, cells = _styles(record["summary"]), record["cells"][:MAX_CELLS]
    figure = page(2.6 * max(len(styles), 1) + 0.6, 2.4 * len(cells) + 0.9)
    grid = figure.subplots(len(cells), max(len(styles), 1), squeeze=False, sharex=True,
                           sharey=True)  # fmt: skip
    for line, cell in zip(grid, cells, strict=True):
        for axes, (label, (color, _)) in zip(line, styles.items(), strict=False):
            row = cell["rows"][label]
            box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
            axes.plot([0, 1], [0, 1], color=FAINT, linewidth=0.8)
            axes.plot(cell["reference"]["entropy"], row["entropy"], ".", color=color,
                      markersize=2.5, alpha=0.5)  # fmt: skip
            axes.text(0.04, 0.94, f"{row['pearson']:.2f}", transform=axes.transAxes, va="top",
                      bbox=box)  # fmt: skip
            if cell is cells[0]:
                axes.set_title(label, fontsize=9, color=INK)
            axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
            tidy(axes)
        line[0].set_ylabel(f"{cell['object']}\n{cell['light']}", fontsize=9)
    figure.supxlabel("entropy of the reference", fontsize=9)
    return figure


def curves(found: Record) -> Figure:
    """Sparsification curves by parameter, mean over cells."""
    record = found["accuracy"]
    styles = _styles(record["summary"])
    names = list(dict.fromkeys(
        name for label in styles for name in record["cells"][0]["rows"][label]["parameters"]
    ))  # fmt: skip
    figure = page(3.9 * max(len(names), 1), 3.8)
    grid = figure.subplots(1, max(len(names), 1), squeeze=False)[0]
    for axes, name in zip(grid, names, strict=False):
        axes.axhline(1, color=FAINT, linewidth=0.8, linestyle="--")
        for label, (color, _) in styles.items():
            drawn = [cell["rows"][label]["sparsification"].get(name)
                     for cell in record["cells"]]  # fmt: skip
            if not all(drawn):
                continue
            removed = np.mean([curve["removed"] for curve in drawn], axis=0)
            for key, line in (("by_uncertainty", "-"), ("oracle", ":")):
                mean = np.mean([curve[key] for curve in drawn], axis=0)
                axes.plot(removed, mean, line, color=color, linewidth=1.4,
                          label=label if line == "-" else None)  # fmt: skip
        axes.set(title=name, xlabel="removed, most uncertain first", xlim=(0, 1))
        axes.set_ylim(bottom=0)
        tidy(axes)
    grid[0].set_ylabel("remaining error / error of all")
    if grid[0].get_legend_handles_labels()[1]:
        grid[0].legend(frameon=False, fontsize=7, loc="lower left", title="(dotted: oracle)",
                       title_fontsize=7)  # fmt: skip
    return figure
