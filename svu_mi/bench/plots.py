"""How all pictures of benchmarks look."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from svu_mi.output.style import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 120
INK, FAINT = "#26262b", "#8a8a93"
COLORS = ("#2f6fb5", "#d1702a", "#3f9a5a", "#9a4fb0", "#b3404a", "#7a6a2f", "#30343a", "#2a9d9b")
MARKS = "osD^vPX*"
TICKS = ((1e-3, "1 ms"), (1e-2, "10 ms"), (0.1, "0.1 s"), (1, "1 s"), (10, "10 s"), (60, "1 min"),
         (600, "10 min"), (3600, "1 h"), (36000, "10 h"), (864000, "10 d"))  # fmt: skip


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


def time_axis(axes: Axes, times: list[float]) -> None:
    """Show run times on a log axis, in the units people use."""
    low, high = min(times) / 3, max(times) * 3
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    ticks = [(value, name) for value, name in TICKS if low < value < high]
    axes.set_xticks([value for value, _ in ticks], [name for _, name in ticks])
    axes.minorticks_off()
