"""``overview.png``: page with entropy, coverage and marginals of an estimate."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.tonemap import ObjectView, object_only_scene
from svu_mi.output import object_views, style
from svu_mi.output.estimate_arrays import (
    EstimateArrays,
    known_values,
    label_of,
    mean_marginals,
    open_axes,
    prior_marginal,
)
from svu_mi.output.html import grouped
from svu_mi.output.interval_summary import IntervalSummary, plain_percent
from svu_mi.output.panels import draw_photograph, draw_scaled_map, map_colors
from svu_mi.output.style import LEFT, RIGHT, RULE, Block
from svu_mi.posterior.estimate import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from svu_mi.output.style import Panel

SIZE = (16.0, 9.4)  # inches
HEADING = "Uncertainty of the reflectance"


def write_overview(
    capture: Capture, estimate: Estimate, path: str | Path, summary: IntervalSummary | None = None
) -> None:
    """Draw photographs, entropy, coverage and marginals (1600 x 940 pixels).

    ``summary`` contains the widths of the intervals; default: computed here.

    Raises:
        OutputError: the file cannot be written.
    """
    result, summary = EstimateArrays.of(estimate), summary or IntervalSummary.of(estimate)
    names = list(open_axes(estimate))
    means = mean_marginals(estimate, result) if result.seen.any() else None
    marginals = [
        (label_of(name).capitalize(), partial(
            _marginal, estimate=estimate, name=name, means=means, summary=summary))
        for name in names
    ]  # fmt: skip
    style.write_page(path, SIZE, HEADING, _notes(capture, estimate, summary), [
        Block(panels=_objects(capture, estimate), shape=(1, 4), box=(LEFT, RIGHT, 0.455, 0.86),
              space=(0.03, 0), anchor="N"),
        Block(panels=[("Entropy", partial(_entropy_map, estimate=estimate, result=result)),
                      ("Coverage", partial(_coverage_map, capture, estimate, result))],
              shape=(1, 2), box=(LEFT, 0.485, 0.075, 0.405), space=(0.09, 0), anchor="N"),
        Block(panels=[("Entropy of seen texels", partial(_histogram, result=result))],
              box=(0.535, RIGHT, 0.263, 0.405)),
        Block(panels=marginals, shape=(1, max(len(names), 1)), box=(0.535, RIGHT, 0.04, 0.182),
              space=(0.2, 0)),
    ])  # fmt: skip


def _notes(capture: Capture, estimate: Estimate, summary: IntervalSummary) -> list[str]:
    (width, height), entropy = summary.resolution, summary.mean_entropy
    return [
        f"method {estimate.method}",
        f"preset {estimate.preset.name}",
        *(f"known {label_of(name)} {value:g}" for name, value in known_values(estimate).items()),
        f"{sum(capture.used)} of {capture.count} views",
        f"{width} × {height} texels, {grouped(estimate.texels.count)} in charts",
        f"{plain_percent(summary.seen_part)} of the surface seen",
        "nothing seen" if entropy is None else f"mean entropy {entropy:.2f}",
    ]


def _objects(capture: Capture, estimate: Estimate) -> Iterator[Panel]:
    """Yield photograph and entropy side by side, for two views with different directions."""
    texture = map_colors(estimate)
    for view in object_views.distant_views(capture, getattr(estimate, "seen_per_view", None)):
        shown = ObjectView.at(object_only_scene(capture), capture.sensors[view]).painted(texture)
        window = object_views.object_window(shown[..., 3] > 0)
        draw = partial(draw_photograph, capture=capture, view=view, window=window)
        yield f"Photograph {view}", draw
        entropy = object_views.crop(shown[..., :3], window)
        yield "Entropy in this view", partial(style.draw_image, image=entropy)


def _entropy_map(axes: Axes, estimate: Estimate, result: EstimateArrays) -> None:
    draw_scaled_map(axes, estimate, label=style.ENTROPY_ENDS, interpolation="nearest")
    _hatch(axes, result)


def _coverage_map(capture: Capture, estimate: Estimate, result: EstimateArrays, axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    label = f"views that see the texel, of {sum(capture.used)}"
    bar = draw_scaled_map(
        axes, estimate, result.coverage, label, limits=(0, result.max_views),
        colormap=style.VIEWS_COLORMAP, interpolation="nearest",
    )  # fmt: skip
    bar.ax.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    _hatch(axes, result)


def _histogram(axes: Axes, result: EstimateArrays) -> None:
    style.minimal_axes(axes)
    edges, values = np.linspace(0, 1, 51), result.entropy[result.seen]
    if len(values) == 0:
        _note_nothing_seen(axes)
        return
    part = np.histogram(values, edges)[0] / len(values) * 100
    centers = (edges[1:] + edges[:-1]) / 2
    axes.bar(centers, part, width=0.0185, color=style.colors(centers))
    median = float(np.median(values))
    axes.axvline(median, color=style.INK, lw=1, ls=(0, (4, 3)))
    side = -1 if median > 0.5 else 1
    axes.annotate(
        f"median {median:.2f}", (median, 0.92), xycoords=("data", "axes fraction"),
        xytext=(5 * side, 0), textcoords="offset points", size=style.TEXT, color=style.INK,
        ha="left" if side > 0 else "right", va="center",
    )  # fmt: skip
    axes.set(xlim=(0, 1), ylim=(0, 1.18 * part.max()))  # room for the label
    style.labels(axes, up="% of texels")


def _marginal(
    axes: Axes, estimate: Estimate, name: str, means: Any, summary: IntervalSummary
) -> None:
    """Draw the mean marginals of all seen texels and of the 10 % with the lowest entropy."""
    style.minimal_axes(axes)
    if means is None:
        _note_nothing_seen(axes)
        return
    nodes, (of_all, of_lowest) = estimate.posterior.axes[name], (mean[name] for mean in means)
    several = of_all.shape[1] == 3
    label = label_of(name).capitalize()
    style.title(axes, f"{label}: R, G, B" if several else label, pad=21)
    style.subtitle(axes, _share(summary, name))
    for k, color in enumerate(style.CHANNEL_COLORS if several else (style.INK,)):
        axes.plot(nodes, of_all[:, k], "o-", color=color, lw=1.8, ms=3)
        axes.plot(nodes, of_lowest[:, k], color=color, lw=1.2, ls=(0, (3, 2)))
    prior = prior_marginal(estimate.posterior, name)
    axes.plot(nodes, prior, color=RULE, lw=1, zorder=0)
    highest = max(float(p.max()) for p in (of_all, of_lowest, prior))
    axes.set(xlim=(0, 1), ylim=(0, 1.6 * highest))  # room for the legend
    for line, what in (("o-", "mean of all seen"), ("--", "10 % with lowest entropy")):
        axes.plot([], [], line, color=style.INK, lw=1.4, ms=3, label=what)
    style.legend(axes, 8, loc="upper left", borderaxespad=0, handlelength=1.6, labelspacing=0.2)


def _share(summary: IntervalSummary, name: str) -> str:
    """Return on which share of the surface a parameter is known."""
    if summary.withheld:
        return "light estimated: no ± given"
    width = summary.cell_width.get(name)
    rest = " of the area seen" if width is None else f"; cells ±{width / 2:.2f}"
    return f"±{summary.tolerance:g} on {plain_percent(summary.known_part[name])}{rest}"


def _hatch(axes: Axes, result: Any) -> None:
    """Hatch pixels outside the charts, whose grey is not a value, and draw a legend."""
    from matplotlib.patches import Patch

    height, width = result.inside.shape
    if not result.inside.all() and min(height, width) > 1:  # contourf needs two rows and columns
        stripes = axes.contourf(
            ~result.inside, levels=(0.5, 1.5), colors="none", hatches=("////",),
            extent=(-0.5, width - 0.5, -0.5, height - 0.5),
        )  # fmt: skip
        stripes.set(edgecolor=RULE, linewidth=0)
    style.frame_map(axes)
    key = []
    if result.unseen.any():
        key.append(Patch(facecolor=style.UNSEEN, label="never seen"))
    if not result.inside.all():
        outside = style.OUTSIDE
        key.append(Patch(facecolor=outside, edgecolor=RULE, hatch="////", label="no surface"))
    if key:
        style.legend(
            axes, handles=key, loc="lower right", bbox_to_anchor=(1.015, 0.985), ncol=len(key),
            handlelength=1.4, columnspacing=1.2,
        )  # fmt: skip


def _note_nothing_seen(axes: Axes) -> None:
    axes.set(xlim=(0, 1), yticks=[])
    style.write_centered(axes, "no texel seen")
