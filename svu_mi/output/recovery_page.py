"""``recovery.png``: one page that says what was recovered, and how well it explains the views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.output import style, views
from svu_mi.output.figures import all_seen, draw_map, draw_on_object, draw_texture
from svu_mi.output.relit import Relit, draw_comparison, draw_relit
from svu_mi.output.result import words
from svu_mi.output.style import FAINT, GREY, INK, LEFT, OUTSIDE, RIGHT, RULE, VIEWS_COLORMAP
from svu_mi.parameters import NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE = (18.0, 10.2)  # inches
TITLES = tuple(words(name).capitalize() for name in NAMES)
WIDEST_SD = 0.3  # at the upper end of the colours; an even prior's is 0.29, that of metals 0.46
SMOOTH = 50  # losses are averaged over this part of the steps


def write_recovery_overview(
    capture: Any,
    recovery: Any,
    comparisons: Sequence[Relit],
    path: str | Path,
    estimate: Any | None = None,
) -> None:
    """Draw textures, what is known of them, losses and comparisons: a page of 1800 x 1020 pixels.

    Args:
        capture: the ``Capture``.
        recovery: its ``Recovery``.
        comparisons: of two views, or one.
        path: the PNG file.
        estimate: an ``Estimate``, if any; its standard deviations and entropy are drawn.

    Raises:
        OutputError: the file cannot be written.
    """
    figure = style.new_figure(*SIZE)
    _heading(figure, capture, recovery, estimate)
    maps = figure.add_gridspec(1, 7, left=LEFT, right=0.83, top=0.875, bottom=0.63, wspace=0.12)
    plot = figure.add_gridspec(1, 1, left=0.87, right=RIGHT, top=0.875, bottom=0.64)
    rows = figure.add_gridspec(
        2, 6, left=LEFT, right=RIGHT, top=0.545, bottom=0.015, hspace=0.13, wspace=0.1
    )
    _maps(figure, [figure.add_subplot(maps[0, k]) for k in range(7)], recovery, estimate)
    _losses(figure.add_subplot(plot[0, 0]), recovery)
    for row, comparison in enumerate(comparisons[:2]):
        cells = [figure.add_subplot(rows[row, k]) for k in range(6)]
        for axes in cells:
            axes.set_anchor("NW")
        draw_comparison(cells[:3], comparison)
        error = comparison.mean_difference
        style.title(cells[0], f"Photograph {comparison.view}")
        style.title(cells[1], "Rendered as recovered")
        style.title(cells[2], "Difference" if error is None else f"Difference, mean {error:.3f}")
        if row == 0:
            _parameters(cells[3:], capture, recovery, comparison.view)
        else:
            _rest(cells[3:], capture, recovery, comparison, estimate)
    style.save_figure(figure, path)


def _heading(figure: Figure, capture: Any, recovery: Any, estimate: Any | None) -> None:
    width, height = recovery.texels.resolution
    coverage = np.array(recovery.coverage)
    seen = 100 * float((coverage > 0).mean()) if len(coverage) else 0.0
    notes = (
        f"method {recovery.method}",
        f"{sum(capture.used)} of {capture.count} views",
        f"{width} × {height} texels, {style.spaced(len(coverage))} in charts",
        f"{seen:.0f} % seen",
        *([] if estimate is None else [f"sd and entropy of preset {estimate.preset.name}"]),
        "with sharing" if recovery.settings.get("sharing") else "without sharing",
        f"{len(recovery.losses)} step" + ("s" if len(recovery.losses) != 1 else ""),
    )
    text = "The reflectance that the photographs were taken of"
    style.heading(figure, text, notes, (0.962, 0.925))


def _maps(figure: Figure, cells: Sequence[Axes], recovery: Any, estimate: Any | None) -> None:
    inside = recovery.texels.inside()
    color = views.srgb(np.clip(recovery.image("base_color"), 0, 1))
    cells[0].imshow(np.where(inside[..., None], color, OUTSIDE))
    style.framed(cells[0])
    shown = all_seen(recovery.texels)
    for axes, name in zip(cells[1:], NAMES[1:], strict=False):
        values = recovery.textures.at(recovery.texels, name)
        style.color_bar(figure, axes, draw_map(axes, shown, values, colormap=GREY))
    drawn = [f"{title}, sd" for title in TITLES]
    if estimate is None:
        for axes in cells[3:]:
            _nothing(axes, "not estimated")
    else:
        for axes, name in zip(cells[3:6], NAMES, strict=True):
            _uncertainty(figure, axes, estimate, name)
        colors = draw_map(cells[6], estimate)
        style.color_bar(figure, cells[6], colors, "grey: never seen")
    for axes, text in zip(cells, (*TITLES, *drawn, "Entropy"), strict=True):
        axes.set_anchor("NW")
        style.title(axes, text)


def _uncertainty(figure: Figure, axes: Axes, estimate: Any, name: str) -> None:
    """Draw the standard deviation of a parameter, of base colour that of the worst channel."""
    if name not in estimate.posterior.axes:
        _nothing(axes, "not estimated")
        return
    sd = np.asarray(estimate.posterior.sd(name), np.float32)
    worst = sd.reshape(len(sd), -1).max(axis=1, initial=0)
    colors = draw_map(axes, estimate, worst, limits=(0, WIDEST_SD))
    bar = style.color_bar(figure, axes, colors, "grey: never seen")
    bar.set_ticks([0, 0.1, 0.2], labels=["0", "0.1", "0.2"])


def _losses(axes: Axes, recovery: Any) -> None:
    style.title(axes, "Loss by step")
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
    style.plain(axes)


def _parameters(cells: Sequence[Axes], capture: Any, recovery: Any, view: int) -> None:
    """Draw the three parameters on the object."""
    shown = all_seen(recovery.texels)
    color = np.array(recovery.textures.base_color, np.float32)
    draw_texture(cells[0], capture, view, views.srgb(np.clip(color, 0, 1)))
    for axes, name in zip(cells[1:], NAMES[1:], strict=True):
        values = recovery.textures.at(recovery.texels, name)
        draw_on_object(axes, capture, shown, view, values, colormap=GREY)
    for axes, text in zip(cells, TITLES, strict=True):
        style.title(axes, text)


def _rest(
    cells: Sequence[Axes], capture: Any, recovery: Any, comparison: Relit, estimate: Any | None
) -> None:
    """Draw the other light, and what is known of the object from there."""
    draw_relit(cells[0], comparison)
    style.title(cells[0], "Under another light")
    if estimate is not None:
        draw_on_object(cells[1], capture, estimate, comparison.view)
        style.title(cells[1], "Entropy")
    else:
        cells[1].set_axis_off()
    coverage = np.array(recovery.coverage)
    most = (0.0, max(float(coverage.max(initial=0)), 1.0))
    draw_on_object(
        cells[2], capture, recovery, comparison.view, coverage, limits=most,
        colormap=VIEWS_COLORMAP,
    )  # fmt: skip
    style.title(cells[2], "Coverage")


def _nothing(axes: Axes, text: str) -> None:
    style.framed(axes)
    axes.set_box_aspect(1)
    axes.text(
        0.5, 0.5, text, color=FAINT, ha="center", va="center", size=11, transform=axes.transAxes
    )
