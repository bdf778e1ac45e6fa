"""``overview.png``: one page that says what the photographs tell and where they do not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.output import style, views
from svu_mi.output.figures import draw_photograph, draw_scaled_map, map_colors
from svu_mi.output.knowledge import Knowledge, plain_percent
from svu_mi.output.page import grouped
from svu_mi.output.result import (
    Result,
    known,
    mean_marginals,
    open_axes,
    prior_marginal,
    words,
)
from svu_mi.output.style import LEFT, RIGHT, RULE
from svu_mi.pipeline import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from svu_mi.output.style import Panel

SIZE = (16.0, 9.4)  # inches
HEADING = "What the photographs say about the reflectance"


def write_overview(
    capture: Capture, estimate: Estimate, path: str | Path, knowledge: Knowledge | None = None
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
    page = _Overview(
        capture, estimate, Result.of(estimate), knowledge or Knowledge.of(estimate)
    )
    figure = style.new_figure(*SIZE)
    style.heading(figure, HEADING, page.notes(), (0.962, 0.922))
    parameters = list(open_axes(estimate))
    objects = figure.add_gridspec(1, 4, left=LEFT, right=RIGHT, top=0.86, bottom=0.455, wspace=0.03)
    maps = figure.add_gridspec(1, 2, left=LEFT, right=0.485, top=0.405, bottom=0.075, wspace=0.09)
    plots = figure.add_gridspec(
        2, len(parameters), left=0.535, right=RIGHT, top=0.405, bottom=0.04, hspace=0.6, wspace=0.2
    )
    style.draw_panels(figure, objects, page.objects(), "N")
    maps_drawn = [("Entropy", page.entropy_map), ("Coverage", page.coverage_map)]
    style.draw_panels(figure, maps, maps_drawn, "N")
    style.draw_panels(figure, [plots[0, :], *(plots[1, k] for k in range(len(parameters)))], [
        ("Entropy of the texels seen", page.histogram),
        *((words(name).capitalize(), partial(page.marginal, name=name)) for name in parameters),
    ])  # fmt: skip
    style.save_figure(figure, path)


@dataclass(frozen=True)
class _Overview:
    """What the page is about; its methods draw its panels.

    Attributes:
        capture: the photographs.
        estimate: what they say.
        result: likewise.
        knowledge: likewise, in units.
    """

    capture: Capture
    estimate: Estimate
    result: Result
    knowledge: Knowledge

    def notes(self) -> list[str]:
        result, seen = self.result, int(self.result.seen.sum())
        width, height = self.estimate.texels.resolution
        return [
            f"method {self.estimate.method}",
            f"preset {self.estimate.preset.name}",
            *(f"known {words(name)} {value:g}" for name, value in known(self.estimate).items()),
            f"{sum(self.capture.used)} of {self.capture.count} views",
            f"{width} × {height} texels, {grouped(len(result.seen))} in charts",
            f"{grouped(seen)} seen ({100 * seen / max(len(result.seen), 1):.0f} %)",
            f"mean entropy {result.entropy[result.seen].mean():.2f}" if seen else "nothing seen",
        ]

    def objects(self) -> Iterator[Panel]:
        """Photograph and entropy side by side, for two views far apart."""
        texture = map_colors(self.estimate)
        seen = getattr(self.estimate, "seen_per_view", None)
        for view in views.far_apart(self.capture, seen):
            shown = views.picture(self.capture, texture, self.capture.sensors[view])
            window = views.object_window(shown[..., 3] > 0)
            draw = partial(draw_photograph, capture=self.capture, view=view, window=window)
            yield f"Photograph {view}", draw
            entropy = views.crop(shown[..., :3], window)
            yield "Entropy seen from there", partial(style.draw_image, image=entropy)

    def entropy_map(self, axes: Axes) -> None:
        draw_scaled_map(axes, self.estimate, label=style.ENTROPY_ENDS, interpolation="nearest")
        _hatch(axes, self.result)

    def coverage_map(self, axes: Axes) -> None:
        from matplotlib.ticker import MaxNLocator

        label = f"views that see the texel, of {sum(self.capture.used)}"
        bar = draw_scaled_map(
            axes, self.estimate, self.result.coverage, label, limits=(0, self.result.most_views),
            colormap=style.VIEWS_COLORMAP, interpolation="nearest",
        )  # fmt: skip
        bar.ax.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
        _hatch(axes, self.result)

    def histogram(self, axes: Axes) -> None:
        style.plain(axes)
        edges = np.linspace(0, 1, 51)
        values = self.result.entropy[self.result.seen]
        if len(values) == 0:
            _nothing(axes)
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
        axes.set(xlim=(0, 1), ylim=(0, 1.18 * part.max()))  # room for the word
        style.labels(axes, up="% of texels")

    def marginal(self, axes: Axes, name: str) -> None:
        """Mean marginal over the texels seen, and over those of the lowest entropy."""
        style.plain(axes)
        if not self.result.seen.any():
            _nothing(axes)
            return
        nodes = self.estimate.posterior.axes[name]
        of_all, of_lowest = (means[name] for means in self._marginals)
        several = of_all.shape[1] == 3
        label = words(name).capitalize()
        style.title(axes, f"{label}: R, G, B" if several else label, pad=21)
        style.subtitle(axes, self._known(name))
        for k, color in enumerate(style.CHANNEL_COLORS if several else (style.INK,)):
            axes.plot(nodes, of_all[:, k], "o-", color=color, lw=1.8, ms=3)
            axes.plot(nodes, of_lowest[:, k], color=color, lw=1.2, ls=(0, (3, 2)))
        prior = prior_marginal(self.estimate.posterior, name)
        axes.plot(nodes, prior, color=RULE, lw=1, zorder=0)
        highest = max(float(p.max()) for p in (of_all, of_lowest, prior))
        axes.set(xlim=(0, 1), ylim=(0, 1.6 * highest))  # room for the key
        for line, what in (("o-", "mean of all seen"), ("--", "10 % of lowest entropy")):
            axes.plot([], [], line, color=style.INK, lw=1.4, ms=3, label=what)
        style.legend(axes, 8, loc="upper left", borderaxespad=0, handlelength=1.6, labelspacing=0.2)

    @cached_property
    def _marginals(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        return mean_marginals(self.estimate, self.result)

    def _known(self, name: str) -> str:
        """Word on how much of the surface seen a parameter is known."""
        knowledge = self.knowledge
        known = f"±{knowledge.tolerance:g} on {plain_percent(knowledge.known_part[name])}"
        if name in knowledge.cell_width:
            return f"{known}; cells ±{knowledge.cell_width[name] / 2:.2f}"
        return f"{known} of the area seen"


def _hatch(axes: Axes, result: Any) -> None:
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


def _nothing(axes: Axes) -> None:
    axes.set(xlim=(0, 1), yticks=[])
    style.nothing(axes, "no texel was seen")
