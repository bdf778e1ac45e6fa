"""Pictures of a benchmark: run time against error, switches, entropies, sparsification."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.bench.text import seconds
from svu_mi.bench.variants import base_of
from svu_mi.output.style import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Record = dict[str, Any]

DPI = 120
INK, FAINT = "#26262b", "#8a8a93"
COLORS = ("#2f6fb5", "#d1702a", "#3f9a5a", "#9a4fb0", "#b3404a", "#7a6a2f", "#30343a", "#2a9d9b")
MARKS = "osD^vPX*"
MAX_CELLS = 6  # rows of the scatter plot
TICKS = ((1e-3, "1 ms"), (1e-2, "10 ms"), (0.1, "0.1 s"), (1, "1 s"), (10, "10 s"), (60, "1 min"),
         (600, "10 min"), (3600, "1 h"), (36000, "10 h"), (864000, "10 d"))  # fmt: skip


def draw_plots(folder: Path, record: Record) -> list[Path]:
    """Write every plot that the record has figures for.

    Args:
        folder: of the PNG files.
        record: what ``run_bench`` returns.

    Returns:
        The files: time_error.png, switches.png, scatter.png, sparsification.png of the
        accuracy, scaling.png of the speed.

    Raises:
        OutputError: a file cannot be written.
    """
    wanted: dict[str, Callable[[Record], Figure]] = {}
    if record["cells"]:
        wanted |= {"time_error": _time_error, "scatter": _scatter, "sparsification": _curves}
        if any(row["kind"] == "switch" for row in record["summary"]):
            wanted["switches"] = _switches
    if record["speed"]:
        wanted["scaling"] = _scaling
    return [save(draw(record), folder, name) for name, draw in wanted.items()]


def save(figure: Figure, folder: Path, name: str) -> Path:
    """Write a figure into a folder, and return the PNG file.

    Raises:
        OutputError: the file cannot be written.
    """
    path = folder / f"{name}.png"
    save_figure(figure, path)
    return path


def page(width: float, height: float) -> Figure:
    """Return an empty figure of so many inches."""
    return new_figure(width, height, DPI, layout="constrained")


def tidy(axes: Axes) -> None:
    """Give axes the look of all plots: a grid, and no frame above and to the right."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e6e6ea", linewidth=0.8)
    axes.set_axisbelow(True)


def _from_zero(axes: Axes) -> None:
    """Start both axes at 0 and leave room for labels beside the last point."""
    lines = [line.get_xydata() for line in axes.get_lines()]
    if lines:
        right, top = np.concatenate(lines).max(axis=0)
        axes.set(xlim=(0, 1.12 * right or 1), ylim=(0, 1.2 * top or 1))


def time_axis(axes: Axes, times: list[float]) -> None:
    """Show run times on a log axis, in the units people use."""
    low, high = min(times) / 3, max(times) * 3
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    ticks = [(value, name) for value, name in TICKS if low < value < high]
    axes.set_xticks([value for value, _ in ticks], [name for _, name in ticks])
    axes.minorticks_off()


def _styles(rows: list[Record]) -> dict[str, tuple[str, str]]:
    """Return colour and mark of the main estimators, the same in every plot."""
    main = [row["label"] for row in rows if row["kind"] == "main"]
    return {label: (COLORS[k % len(COLORS)], MARKS[k % len(MARKS)]) for k, label in enumerate(main)}


# --- run time against error ---------------------------------------------------------------


def _time_error(record: Record) -> Figure:
    """The headline: time for all texels, and 1 - rho, mean over cells."""
    rows, figure = record["summary"], page(9, 5.4)
    axes = figure.add_subplot()
    styles, others = _styles(rows), False
    estimators = [row for row in rows if row["kind"] in ("main", "switch")]
    for row in estimators:
        error = 1 - row["pearson"]["mean"]
        if row["label"] in styles:
            color, mark = styles[row["label"]]
            low, high = row["pearson"]["low"], row["pearson"]["high"]
            spread = None if low is None else [[max(0, high - 1 + error)], [1 - low - error]]
            axes.errorbar(row["seconds"], error, spread, fmt=mark, color=color, markersize=9,
                          capsize=3, elinewidth=1, label=row["label"], zorder=3)  # fmt: skip
        else:
            label = None if others else "single switches"
            axes.plot(row["seconds"], error, "o", color=FAINT, markersize=4, label=label)
            others = True
    times = _reference_points(axes, record) + [row["seconds"] for row in estimators]
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


def _reference_points(axes: Axes, record: Record) -> list[float]:
    """The reference by samples, and all psi by brute force; return their times.

    All are extrapolated from the reference's few texels to all.
    """
    cells, times = record["cells"], []
    texels = float(np.mean([cell["texels"] / cell["reference"]["texels"] for cell in cells]))
    halves = [cell["reference"]["split_half"] for cell in cells]
    if all(half is not None for half in halves):
        times.append(float(np.mean([cell["reference"]["seconds"] for cell in cells])) * texels)
        axes.plot(times, 1 - np.mean(halves), "*", color=INK, markersize=13,
                  label="reference, half against half")  # fmt: skip
    if record["speed"]:
        curve = record["speed"]["scaling"]["reference_spp"]["reference"]
        points = [row for row in curve if row["pearson"] is not None]
        axes.plot([row["seconds"] * texels for row in points],
                  [1 - row["pearson"] for row in points], "-o", color=INK, markersize=4,
                  linewidth=1, label="reference with fewer samples (one cell)")  # fmt: skip
        brute = record["speed"]["brute"]["seconds"]
        times += [row["seconds"] * texels for row in points] + [brute]
        axes.axvline(brute, color=INK, linestyle=":", linewidth=1.2)
        axes.annotate(f"every psi path traced: {seconds(brute)} (extrapolated)", (brute, 0.5),
                      xycoords=("data", "axes fraction"), fontsize=8, rotation=90, ha="right",
                      va="center", color=INK)  # fmt: skip
    return times


def _scaling(record: Record) -> Figure:
    """Four ways to spend time, each with the agreement that it buys."""
    scaling = record["speed"]["scaling"]
    titles = {"degree": "highest degree l*", "grid": "nodes per axis", "views": "views",
              "reference_spp": "samples of the reference"}  # fmt: skip
    figure = page(11, 7)
    for place, (what, curves) in enumerate(scaling.items(), 1):
        axes = figure.add_subplot(2, 2, place)
        for index, (label, curve) in enumerate(curves.items()):
            points = [row for row in curve if row["pearson"] is not None]
            if not points:
                continue
            x, y = [row["seconds"] for row in points], [1 - row["pearson"] for row in points]
            axes.plot(x, y, "-o", color=COLORS[index], markersize=4, linewidth=1.2, label=label)
            for row, at, error in zip(points, x, y, strict=True):
                axes.annotate(f"{row['value']}", (at, error), xytext=(4, 4), fontsize=8,
                              textcoords="offset points", color=INK)  # fmt: skip
        axes.set_title(titles[what], fontsize=10, color=INK)
        axes.set_xlabel("seconds")
        axes.set_ylabel("1 - Pearson")
        _from_zero(axes)
        if axes.get_legend_handles_labels()[1]:
            axes.legend(frameon=False, fontsize=8, loc="best")
        tidy(axes)
    figure.suptitle(record["speed"]["cell"], fontsize=10, color=INK)
    return figure


# --- accuracy -----------------------------------------------------------------------------


def _switches(record: Record) -> Figure:
    """How much each single switch changes the correlation, per cell and on average."""
    rows = [row for row in record["summary"] if row["kind"] == "switch"]
    figure = page(8, 1.2 + 0.32 * len(rows))
    axes = figure.add_subplot()
    for place, row in enumerate(reversed(rows)):
        base = base_of(row["label"], record["cells"][0]["variants"])
        changes = [
            cell["variants"][row["label"]]["pearson"] - cell["variants"][base]["pearson"]
            for cell in record["cells"]
            if base in cell["variants"]
        ]
        if changes:
            mean = float(np.mean(changes))
            axes.barh(place, mean, color=COLORS[2] if mean > 0 else COLORS[4], height=0.6)
            axes.plot(changes, [place] * len(changes), "|", color=INK, markersize=7)
    axes.set_yticks(range(len(rows)), [row["label"] for row in reversed(rows)], fontsize=8)
    axes.axvline(0, color=INK, linewidth=0.8)
    axes.set_xlabel("change of the Pearson correlation against what is switched")
    axes.set_title("Single switches: mean (bar) and each cell (stroke)", fontsize=10, color=INK)
    tidy(axes)
    return figure


def _scatter(record: Record) -> Figure:
    """Entropy of each main estimator against that of the reference, cell by cell."""
    styles, cells = _styles(record["summary"]), record["cells"][:MAX_CELLS]
    figure = page(2.6 * max(len(styles), 1) + 0.6, 2.4 * len(cells) + 0.9)
    grid = figure.subplots(len(cells), max(len(styles), 1), squeeze=False, sharex=True,
                           sharey=True)  # fmt: skip
    for line, cell in zip(grid, cells, strict=True):
        for axes, (label, (color, _)) in zip(line, styles.items(), strict=False):
            found = cell["variants"][label]
            box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
            axes.plot([0, 1], [0, 1], color=FAINT, linewidth=0.8)
            axes.plot(cell["reference"]["entropy"], found["entropy"], ".", color=color,
                      markersize=2.5, alpha=0.5)  # fmt: skip
            axes.text(0.04, 0.94, f"{found['pearson']:.2f}", transform=axes.transAxes, va="top",
                      bbox=box)  # fmt: skip
            if cell is cells[0]:
                axes.set_title(label, fontsize=9, color=INK)
            axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
            tidy(axes)
        line[0].set_ylabel(f"{cell['object']}\n{cell['light']}", fontsize=9)
    figure.supxlabel("entropy of the reference", fontsize=9)
    return figure


def _curves(record: Record) -> Figure:
    """Sparsification curves by parameter, mean over cells."""
    styles = _styles(record["summary"])
    names = list(dict.fromkeys(
        name for label in styles for name in record["cells"][0]["variants"][label]["parameters"]
    ))  # fmt: skip
    figure = page(3.9 * max(len(names), 1), 3.8)
    grid = figure.subplots(1, max(len(names), 1), squeeze=False)[0]
    for axes, name in zip(grid, names, strict=False):
        axes.axhline(1, color=FAINT, linewidth=0.8, linestyle="--")
        for label, (color, _) in styles.items():
            found = [cell["variants"][label]["sparsification"].get(name)
                     for cell in record["cells"]]  # fmt: skip
            if not all(found):
                continue
            removed = np.mean([curve["removed"] for curve in found], axis=0)
            for key, line in (("by_uncertainty", "-"), ("oracle", ":")):
                mean = np.mean([curve[key] for curve in found], axis=0)
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
