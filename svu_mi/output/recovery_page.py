"""``recovery.png``: one page that says what was recovered, and how well it explains the views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.files import replacing
from svu_mi.output import views
from svu_mi.output.figures import draw_map, draw_on_object
from svu_mi.output.overview import (
    FAINT,
    INK,
    LEFT,
    OUTSIDE,
    RULE,
    THIN_SPACE,
    VIEWS_COLORMAP,
)  # fmt: skip
from svu_mi.output.relit import Relit, draw_comparison, draw_relit
from svu_mi.parameters import NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 100
SIZE = (18.0, 10.2)  # inches
GREY = "gray"
SMOOTH = 50  # losses are averaged over this part of the steps


def write_recovery_overview(
    capture: Any,
    recovery: Any,
    comparisons: Sequence[Relit],
    path: str | Path,
    estimate: Any | None = None,
) -> None:
    """Draw textures, entropy, coverage, losses and comparisons on one page of 1800 x 1020 pixels.

    Args:
        capture: the ``Capture``.
        recovery: its ``Recovery``.
        comparisons: of two views, or one.
        path: the PNG file.
        estimate: the ``Estimate`` that was shared by, if any; its entropy is drawn.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    _heading(figure, capture, recovery)
    maps = figure.add_gridspec(1, 5, left=LEFT, right=0.81, top=0.875, bottom=0.63, wspace=0.1)
    plot = figure.add_gridspec(1, 1, left=0.855, right=0.985, top=0.875, bottom=0.64)
    rows = figure.add_gridspec(
        2, 6, left=LEFT, right=0.985, top=0.545, bottom=0.015, hspace=0.13, wspace=0.1
    )
    _maps(figure, [figure.add_subplot(maps[0, k]) for k in range(5)], recovery, estimate)
    _losses(figure.add_subplot(plot[0, 0]), recovery)
    for row, comparison in enumerate(comparisons[:2]):
        cells = [figure.add_subplot(rows[row, k]) for k in range(6)]
        for axes in cells:
            axes.set_anchor("NW")
        draw_comparison(cells[:3], comparison)
        error = comparison.mean_difference
        _title(cells[0], f"Photograph {comparison.view}")
        _title(cells[1], "Rendered as recovered")
        _title(cells[2], "Difference" if error is None else f"Difference, mean {error:.3f}")
        if row == 0:
            _parameters(cells[3:], capture, recovery, comparison.view)
        else:
            _rest(cells[3:], capture, recovery, comparison, estimate)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def _heading(figure: Figure, capture: Any, recovery: Any) -> None:
    width, height = recovery.texels.resolution
    coverage = np.array(recovery.coverage)
    seen = 100 * float((coverage > 0).mean()) if len(coverage) else 0.0
    words = (
        f"method {recovery.method}",
        f"{sum(capture.used)} of {capture.count} views",
        f"{width} × {height} texels, {len(coverage):_} in charts".replace("_", THIN_SPACE),
        f"{seen:.0f} % seen",
        f"{len(recovery.losses)} steps",
        f"{np.nansum(list(recovery.timings.values())):.1f} s",
    )
    figure.text(
        LEFT, 0.962, "The reflectance that the photographs were taken of",
        size=19, weight="bold", color=INK, va="center",
    )  # fmt: skip
    figure.text(LEFT, 0.925, "   ·   ".join(words), size=11.5, color=FAINT, va="center")


def _maps(figure: Figure, cells: Sequence[Axes], recovery: Any, estimate: Any | None) -> None:
    inside = recovery.texels.inside()
    color = views.srgb(np.clip(recovery.image("base_color"), 0, 1))
    cells[0].imshow(np.where(inside[..., None], color, OUTSIDE))
    cells[0].set(xticks=[], yticks=[])
    cells[0].spines[:].set_color(RULE)
    shown = _all_seen(recovery)
    for axes, name in zip(cells[1:], NAMES[1:], strict=False):
        values = recovery.textures.at(recovery.texels, name)
        _colorbar(figure, axes, draw_map(axes, shown, values, colormap=GREY), "")
    if estimate is None:
        _nothing(cells[3], "not estimated")
    else:
        drawn = draw_map(cells[3], estimate)
        _colorbar(figure, cells[3], drawn, "0 = certain, 1 = nothing known")
    coverage = np.array(recovery.coverage)
    most = (0.0, max(float(coverage.max(initial=0)), 1.0))
    drawn = draw_map(cells[4], recovery, coverage, limits=most, colormap=VIEWS_COLORMAP)
    _colorbar(figure, cells[4], drawn, "views; grey: never seen")
    titles = ("Base colour", "Roughness", "Metallic", "Entropy", "Coverage")
    for axes, title in zip(cells, titles, strict=True):
        axes.set_anchor("NW")
        _title(axes, title)


def _losses(axes: Axes, recovery: Any) -> None:
    _title(axes, "Loss by step")
    losses = np.array(recovery.losses, np.float64)
    if len(losses) < 2:
        _nothing(axes, "no descent")
        return
    width = max(len(losses) // SMOOTH, 1)
    mean = np.convolve(losses, np.ones(width) / width, "valid")
    axes.plot(losses, color=RULE, lw=0.8)
    axes.plot(np.arange(len(mean)) + (width - 1) / 2, mean, color=INK, lw=1.6)
    if losses.min() > 0 and losses.max() > 20 * losses.min():
        axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(RULE)
    axes.tick_params(labelsize=9, color=RULE, labelcolor=INK, length=3)


def _parameters(cells: Sequence[Axes], capture: Any, recovery: Any, view: int) -> None:
    """Draw the three parameters on the object."""
    shown = _all_seen(recovery)
    color = np.array(recovery.textures.base_color, np.float32)
    picture = views.picture(capture, views.srgb(np.clip(color, 0, 1)), capture.sensors[view])
    cells[0].imshow(views.crop(picture[..., :3], views.object_window(picture[..., 3] > 0)))
    cells[0].set_axis_off()
    for axes, name in zip(cells[1:], NAMES[1:], strict=True):
        values = recovery.textures.at(recovery.texels, name)
        draw_on_object(axes, capture, shown, view, values, colormap=GREY)
    for axes, title in zip(cells, ("Base colour", "Roughness", "Metallic"), strict=True):
        _title(axes, title)


def _rest(
    cells: Sequence[Axes], capture: Any, recovery: Any, comparison: Relit, estimate: Any | None
) -> None:
    """Draw the other light, and what is known of the object from there."""
    draw_relit(cells[0], comparison)
    _title(cells[0], "Under another light")
    if estimate is not None:
        draw_on_object(cells[1], capture, estimate, comparison.view)
        _title(cells[1], "Entropy")
    else:
        cells[1].set_axis_off()
    coverage = np.array(recovery.coverage)
    most = (0.0, max(float(coverage.max(initial=0)), 1.0))
    draw_on_object(
        cells[2], capture, recovery, comparison.view, coverage, limits=most,
        colormap=VIEWS_COLORMAP,
    )  # fmt: skip
    _title(cells[2], "Coverage")


def _all_seen(recovery: Any) -> Any:
    """A view of a recovery in which no texel is covered with grey: all have some value."""
    ones = np.ones(recovery.texels.count, np.uint32)
    return SimpleNamespace(texels=recovery.texels, coverage=ones)


def _colorbar(figure: Figure, axes: Axes, drawn: Any, label: str) -> None:
    place = axes.inset_axes((0.0, -0.07, 1.0, 0.03))
    bar: Any = figure.colorbar(drawn, cax=place, orientation="horizontal")
    bar.outline.set_visible(False)
    bar.set_label(label, size=8.5, color=FAINT)
    bar.ax.tick_params(labelsize=8.5, color=FAINT, labelcolor=INK, length=3)


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", size=11, color=INK, pad=5)


def _nothing(axes: Axes, text: str) -> None:
    axes.set(xticks=[], yticks=[])
    axes.set_box_aspect(1)
    axes.spines[:].set_color(RULE)
    axes.text(
        0.5, 0.5, text, color=FAINT, ha="center", va="center", size=11, transform=axes.transAxes
    )
