"""``overview.png``: page with known shares, entropy and coverage of an estimate."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.tonemap import ObjectView, object_only_scene
from svu_mi.errors import counted
from svu_mi.output import object_views, style
from svu_mi.output.estimate_arrays import coverages, entropies, is_seen, known_values, label_of
from svu_mi.output.html import grouped
from svu_mi.output.interval_summary import IntervalSummary, plain_percent
from svu_mi.output.panels import draw_photograph, draw_scaled_map, is_tall, map_colors
from svu_mi.output.style import LEFT, RIGHT, RULE, Block, Panel
from svu_mi.posterior.estimate import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = (16.0, 10.2)  # inches
HEADING = "Uncertainty of the reflectance"
BINS, FULL = 50, 0.01  # bars of the histogram; share of the last bar from which it is explained


def write_overview(
    capture: Capture, estimate: Estimate, path: str | Path, summary: IntervalSummary | None = None
) -> None:
    """Draw known shares, photographs, entropy and coverage (1600 x 1020 pixels).

    ``summary`` contains the widths of the intervals; default: computed here.

    Raises:
        OutputError: the file cannot be written.
    """
    summary = summary or IntervalSummary.of(estimate)
    tested = estimate.prediction
    wrong = estimate.prediction_sentence if tested and not tested.reliable else None
    shares: list[Panel] = [
        ("", partial(_share, summary=summary, name=name)) for name in summary.known_part
    ]
    if wrong or not shares:
        shares = [("", partial(_sentence, text=wrong or summary.sentence()))]
    style.write_page(path, SIZE, HEADING, _notes(capture, estimate, summary), [
        Block(panels=shares, shape=(1, len(shares)), box=(LEFT, RIGHT, 0.83, 0.905)),
        Block(panels=_objects(capture, estimate), shape=(1, 4), box=(LEFT, RIGHT, 0.41, 0.785),
              space=(0.03, 0), anchor="N"),
        Block(panels=[("Entropy", partial(_entropy_map, estimate=estimate)),
                      ("Coverage", partial(_coverage_map, capture, estimate))],
              shape=(1, 2), box=(LEFT, 0.485, 0.075, 0.365), space=(0.09, 0), anchor="NW"),
        Block(panels=[("Entropy of seen texels", partial(_histogram, estimate=estimate))],
              box=(0.535, RIGHT, 0.075, 0.365)),
    ])  # fmt: skip


def _share(axes: Axes, summary: IntervalSummary, name: str) -> None:
    """Write on which share of the surface a parameter is known, in large digits."""
    axes.set_axis_off()
    width = summary.cell_width.get(name)
    cells = "of the surface area seen" if width is None else f"cells of the grid ±{width / 2:.2f}"
    lines = (label_of(name).capitalize(), f"known to ±{summary.tolerance:g}, {cells}")
    share = plain_percent(summary.known_part[name])
    share = share.replace("under ", "<").replace("over ", ">")
    axes.text(0, 0.5, share, size=32, weight="bold", color=style.INK, va="center")
    for place, text, color in zip((0.72, 0.28), lines, (style.INK, style.FAINT), strict=True):
        axes.text(0.33, place, text, size=10.5, color=color, va="center")


def _sentence(axes: Axes, text: str) -> None:
    axes.set_axis_off()
    axes.text(0, 0.5, text, size=13, color=style.INK, va="center", wrap=True)


def _notes(capture: Capture, estimate: Estimate, summary: IntervalSummary) -> list[str]:
    (width, height), entropy = summary.resolution, summary.mean_entropy
    return [
        f"method {estimate.method}",
        f"preset {estimate.preset.name}",
        *(f"known {label_of(name)} {value:g}" for name, value in known_values(estimate).items()),
        f"{sum(capture.used)} of {capture.count} views",
        f"{width} × {height} texels, {grouped(estimate.texels.count)} in charts",
        f"{plain_percent(summary.seen_part)} of the surface area seen",
        "nothing seen" if entropy is None else f"mean entropy {entropy:.2f}",
    ]


def _objects(capture: Capture, estimate: Estimate) -> Iterator[Panel]:
    """Yield photograph and entropy side by side, for two views with different directions."""
    texture = map_colors(estimate)
    for view in object_views.distant_views(capture, getattr(estimate, "seen_per_view", None)):
        shown = ObjectView.at(object_only_scene(capture), capture.sensors[view]).painted(texture)
        window = object_views.object_window(shown[..., 3] > 0)
        draw = partial(draw_photograph, capture=capture, view=view, window=window)
        yield style.photograph_title(capture.names[view]), draw
        entropy = object_views.crop(shown[..., :3], window)
        yield "Entropy in this view", partial(style.draw_image, image=entropy)


def _entropy_map(axes: Axes, estimate: Estimate) -> None:
    draw_scaled_map(axes, estimate, label=style.ENTROPY_ENDS, interpolation="nearest")
    _hatch(axes, estimate)


def _coverage_map(capture: Capture, estimate: Estimate, axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    counts, label = coverages(estimate), f"views that see the texel, of {sum(capture.used)}"
    bar = draw_scaled_map(
        axes, estimate, counts, label, limits=(0, max(counts.max(initial=0), 1)),
        colormap=style.VIEWS_COLORMAP, interpolation="nearest",
    )  # fmt: skip
    bar.long_axis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    _hatch(axes, estimate, legend=False)


def _histogram(axes: Axes, estimate: Estimate) -> None:
    style.minimal_axes(axes)
    seen = is_seen(estimate)
    edges, values = np.linspace(0, 1, BINS + 1), entropies(estimate)[seen]
    if len(values) == 0:
        axes.set(xlim=(0, 1), yticks=[])
        style.write_centered(axes, "no texel seen")
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
    style.labels(axes, style.ENTROPY_ENDS, "% of texels")
    if part[-1] >= 100 * FULL:
        views = np.median(coverages(estimate)[seen][values >= edges[-2]])
        number = counted(views, "photograph")
        text = f"last bar: {part[-1]:.0f} % of texels; median of {number} each"
        axes.set_title(text, loc="right", y=1.0, size=style.TEXT, color=style.FAINT, pad=6)


def _hatch(axes: Axes, estimate: Estimate, legend: bool = True) -> None:
    """Hatch pixels outside the charts, whose grey is not a value; ``legend`` explains it."""
    from matplotlib.patches import Patch

    inside = estimate.texels.inside()
    height, width = inside.shape
    if not inside.all() and min(height, width) > 1:  # contourf needs two rows and columns
        stripes = axes.contourf(
            ~inside, levels=(0.5, 1.5), colors="none", hatches=("////",),
            extent=(-0.5, width - 0.5, -0.5, height - 0.5),
        )  # fmt: skip
        stripes.set(edgecolor=RULE, linewidth=0)
    style.frame_map(axes)
    key = []
    if not is_seen(estimate).all():
        key.append(Patch(facecolor=style.UNSEEN, label="never seen"))
    if not inside.all():
        outside = style.OUTSIDE
        key.append(Patch(facecolor=outside, edgecolor=RULE, hatch="////", label="no surface"))
    if key and legend:
        place, corner, columns = "lower right", (1.015, 0.985), len(key)
        if is_tall(estimate):
            place, corner, columns = "upper left", (1.0, 1.03), 1
        style.legend(axes, handles=key, loc=place, bbox_to_anchor=corner, ncol=columns,
                     handlelength=1.4, columnspacing=1.2)  # fmt: skip
