"""``overview.png``: one page that says what the photographs tell and where they do not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.output import style, views
from svu_mi.output.figures import map_colors
from svu_mi.output.knowledge import Knowledge, plain_percent
from svu_mi.output.result import (
    Result,
    known,
    mean_marginals,
    open_axes,
    prior_marginal,
    words,
)
from svu_mi.output.style import (
    COLORMAP,
    ENTROPY_ENDS,
    FAINT,
    INK,
    LEFT,
    OUTSIDE,
    RIGHT,
    RULE,
    UNSEEN,
    VIEWS_COLORMAP,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE = (16.0, 9.4)  # inches


def write_overview(
    capture: Any, estimate: Any, path: str | Path, knowledge: Knowledge | None = None
) -> None:
    """Draw photographs, entropy, coverage and marginals on one page of 1600 x 940 pixels.

    Args:
        capture: the ``Capture``.
        estimate: its ``Estimate``; nothing need have been seen.
        path: the PNG file.
        knowledge: what the estimate says in units; computed if not given.

    Raises:
        OutputError: the file cannot be written.
    """
    figure = style.new_figure(*SIZE)
    result = Result.of(estimate)
    knowledge = knowledge or Knowledge.of(estimate)
    _heading(figure, capture, estimate, result)
    objects = figure.add_gridspec(1, 4, left=LEFT, right=RIGHT, top=0.86, bottom=0.455, wspace=0.03)
    maps = figure.add_gridspec(1, 2, left=LEFT, right=0.485, top=0.405, bottom=0.075, wspace=0.09)
    parameters = list(open_axes(estimate))
    plots = figure.add_gridspec(
        2, len(parameters), left=0.535, right=RIGHT, top=0.405, bottom=0.04, hspace=0.6, wspace=0.2
    )
    _object_row(figure, objects, capture, estimate)
    left = figure.add_subplot(maps[0, 0])
    _map(figure, left, estimate, result, result.entropy, (0, 1), COLORMAP, ENTROPY_ENDS)
    style.title(left, "Entropy")
    _coverage_map(figure, figure.add_subplot(maps[0, 1]), capture, estimate, result)
    _histogram(figure.add_subplot(plots[0, :]), result)
    for column, name in enumerate(parameters):
        _marginal(figure.add_subplot(plots[1, column]), estimate, result, knowledge, name)
    style.save_figure(figure, path)


def _heading(figure: Figure, capture: Any, estimate: Any, result: Result) -> None:
    texels, seen = len(result.seen), int(result.seen.sum())
    width, height = estimate.texels.resolution
    mean = f"mean entropy {result.entropy[result.seen].mean():.2f}" if seen else "nothing seen"
    notes = (
        f"method {estimate.method}",
        f"preset {estimate.preset.name}",
        *(f"known {words(name)} {value:g}" for name, value in known(estimate).items()),
        f"{sum(capture.used)} of {capture.count} views",
        f"{width} × {height} texels, {style.spaced(texels)} in charts",
        f"{style.spaced(seen)} seen ({100 * seen / max(texels, 1):.0f} %)",
        mean,
    )
    style.heading(figure, "What the photographs say about the reflectance", notes, (0.962, 0.922))


def _object_row(figure: Figure, cells: Any, capture: Any, estimate: Any) -> None:
    """Photograph and entropy side by side, for two views far apart."""
    chosen = views.far_apart(capture, getattr(estimate, "seen_per_view", None))
    texture = map_colors(estimate)
    for pair in range(2):
        left, right = (figure.add_subplot(cells[0, 2 * pair + k]) for k in (0, 1))
        for axes in (left, right):
            axes.set(anchor="N")
            axes.set_axis_off()
        if pair >= len(chosen):
            continue
        view = chosen[pair]
        shown = views.picture(capture, texture, capture.sensors[view])
        window = views.object_window(shown[..., 3] > 0)
        mask = capture.masks[view] if capture.masks else None
        photograph = views.tone_mapped(capture.images[view], mask)
        left.imshow(views.crop(photograph, window))
        right.imshow(views.crop(shown[..., :3], window))
        style.title(left, f"Photograph {view}")
        style.title(right, "Entropy seen from there")


def _coverage_map(figure: Figure, axes: Axes, capture: Any, estimate: Any, result: Result) -> None:
    from matplotlib.ticker import MaxNLocator

    limits = (0, max(int(result.coverage.max(initial=0)), 1))
    label = f"views that see the texel, of {sum(capture.used)}"
    bar = _map(figure, axes, estimate, result, result.coverage, limits, VIEWS_COLORMAP, label)
    bar.ax.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    style.title(axes, "Coverage")


def _map(
    figure: Figure, axes: Axes, estimate: Any, result: Result, values: np.ndarray,
    limits: tuple[float, float], colormap: str, label: str,
) -> Any:  # fmt: skip
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colors = map_colors(estimate, values, limits=limits, colormap=colormap, gutter=0)
    axes.imshow(colors, interpolation="nearest")
    _hatch(axes, result)
    return style.color_bar(figure, axes, ScalarMappable(Normalize(*limits), colormap), label)


def _hatch(axes: Axes, result: Result) -> None:
    """Hatch what is outside the charts, so that no grey can be taken for a value; add a key."""
    from matplotlib.patches import Patch

    height, width = result.inside.shape
    if not result.inside.all() and min(height, width) > 1:  # no contour is of a line
        stripes = axes.contourf(
            ~result.inside, levels=(0.5, 1.5), colors="none", hatches=("////",),
            extent=(-0.5, width - 0.5, -0.5, height - 0.5),
        )  # fmt: skip
        stripes.set(edgecolor=RULE, linewidth=0)
    style.framed(axes)
    axes.set(anchor="N")
    key = []
    if result.unseen.any():
        key.append(Patch(facecolor=UNSEEN, label="never seen"))
    if not result.inside.all():
        key.append(Patch(facecolor=OUTSIDE, edgecolor=RULE, hatch="////", label="no surface"))
    if key:
        axes.legend(
            handles=key, loc="lower right", bbox_to_anchor=(1.015, 0.985), ncol=len(key),
            fontsize=9, frameon=False, labelcolor=INK, handlelength=1.4, columnspacing=1.2,
        )  # fmt: skip


def _histogram(axes: Axes, result: Result) -> None:
    from matplotlib import colormaps

    style.title(axes, "Entropy of the texels seen")
    style.plain(axes)
    edges = np.linspace(0, 1, 51)
    values = result.entropy[result.seen]
    if len(values) == 0:
        _nothing(axes)
        return
    part = np.histogram(values, edges)[0] / len(values) * 100
    centers = (edges[1:] + edges[:-1]) / 2
    axes.bar(centers, part, width=0.0185, color=colormaps[COLORMAP](centers))
    median = float(np.median(values))
    axes.axvline(median, color=INK, lw=1, ls=(0, (4, 3)))
    side = -1 if median > 0.5 else 1
    axes.annotate(
        f"median {median:.2f}", (median, 0.92), xycoords=("data", "axes fraction"),
        xytext=(5 * side, 0), textcoords="offset points", size=9, color=INK,
        ha="left" if side > 0 else "right", va="center",
    )  # fmt: skip
    axes.set(xlim=(0, 1), ylim=(0, 1.18 * part.max()))  # room for the word
    axes.set_ylabel("% of texels", size=9, color=FAINT)


def _marginal(
    axes: Axes, estimate: Any, result: Result, knowledge: Knowledge, name: str
) -> None:  # fmt: skip
    """Mean marginal over the texels seen, and over those of the lowest entropy."""
    label = words(name).capitalize()
    style.plain(axes)
    if not result.seen.any():
        style.title(axes, label)
        _nothing(axes)
        return
    nodes = estimate.posterior.axes[name]
    means = mean_marginals(estimate, result, name)
    channels = means[False].shape[1]
    style.title(axes, f"{label}: R, G, B" if channels == 3 else label, pad=21)
    style.subtitle(axes, _known(knowledge, name))
    colors = ("#c23b3b", "#2f8f4e", "#3566b8") if channels == 3 else (INK,)
    for k, color in enumerate(colors):
        axes.plot(nodes, means[False][:, k], "o-", color=color, lw=1.8, ms=3)
        axes.plot(nodes, means[True][:, k], color=color, lw=1.2, ls=(0, (3, 2)))
    prior = prior_marginal(estimate.posterior, name)
    axes.plot(nodes, prior, color=RULE, lw=1, zorder=0)
    highest = max(float(p.max()) for p in (*means.values(), prior))
    axes.set(xlim=(0, 1), ylim=(0, 1.6 * highest))  # room for the key
    for line, what in (("o-", "mean of all seen"), ("--", "10 % of lowest entropy")):
        axes.plot([], [], line, color=INK, lw=1.4, ms=3, label=what)
    axes.legend(
        fontsize=8, frameon=False, labelcolor=INK, loc="upper left", borderaxespad=0,
        handlelength=1.6, labelspacing=0.2,
    )  # fmt: skip


def _known(knowledge: Knowledge, name: str) -> str:
    """Word on how much of the surface seen a parameter is known."""
    known = f"±{knowledge.tolerance:g} on {plain_percent(knowledge.known_part[name])}"
    if name in knowledge.cell_width:
        return f"{known}; cells ±{knowledge.cell_width[name] / 2:.2f}"
    return f"{known} of the area seen"


def _nothing(axes: Axes) -> None:
    axes.set(xlim=(0, 1), yticks=[])
    axes.text(0.5, 0.5, "no texel was seen", color=FAINT, ha="center", va="center", size=11)
