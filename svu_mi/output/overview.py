"""``overview.png``: one page that says what the photographs tell and where they do not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.files import replacing
from svu_mi.output import views

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 100
SIZE = (16.0, 9.4)  # inches
LEFT, RIGHT = 0.018, 0.985  # margins of the page
COLORMAP, VIEWS_COLORMAP = "viridis", "magma"
UNSEEN = (0.55, 0.55, 0.58)  # grey: in no colormap, and darker than the page
OUTSIDE = (0.95, 0.95, 0.96)
INK, FAINT, RULE = "#26262b", "#6f6f78", "#c4c4cb"
THIN_SPACE = "\u2009"
CERTAIN_PART = 0.1  # the most certain texels, whose marginals are shown beside the mean
SAMPLE = 4_000  # texels that a mean marginal is taken over


@dataclass(frozen=True)
class Result:
    """NumPy copies of what is drawn.

    Attributes:
        entropy: (T,) in [0, 1].
        coverage: (T,) number of views.
        seen: (T,) bool.
        inside: (H, W) bool, True in the charts.
        unseen: (H, W) bool, True in texels that no view sees.
    """

    entropy: np.ndarray
    coverage: np.ndarray
    seen: np.ndarray
    inside: np.ndarray
    unseen: np.ndarray

    @classmethod
    def of(cls, estimate: Any) -> Result:
        """Copy what an estimate says."""
        coverage = np.array(estimate.coverage).astype(np.int64)
        texels, seen = estimate.texels, coverage > 0
        return cls(
            entropy=np.array(estimate.entropy, np.float32),
            coverage=coverage,
            seen=seen,
            inside=texels.to_image(np.ones(texels.count, bool), False),
            unseen=texels.to_image(~seen, False),
        )


def write_overview(capture: Any, estimate: Any, path: str | Path) -> None:
    """Draw photographs, entropy, coverage and marginals on one page of 1600 x 940 pixels.

    Args:
        capture: the ``Capture``.
        estimate: its ``Estimate``; nothing need have been seen.
        path: the PNG file.

    Raises:
        OutputError: the file cannot be written.
    """
    # matplotlib takes half a second to import; and pyplot, with its global state, is not used.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    result = Result.of(estimate)
    _heading(figure, capture, estimate, result)
    objects = figure.add_gridspec(1, 4, left=LEFT, right=RIGHT, top=0.86, bottom=0.455, wspace=0.03)
    maps = figure.add_gridspec(1, 2, left=LEFT, right=0.485, top=0.405, bottom=0.075, wspace=0.09)
    parameters = list(open_axes(estimate))
    plots = figure.add_gridspec(
        2, len(parameters), left=0.535, right=RIGHT, top=0.405, bottom=0.04, hspace=0.6, wspace=0.2
    )
    _object_row(figure, objects, capture, estimate, result)
    _entropy_map(figure, figure.add_subplot(maps[0, 0]), estimate, result)
    _coverage_map(figure, figure.add_subplot(maps[0, 1]), capture, estimate, result)
    _histogram(figure.add_subplot(plots[0, :]), result)
    for column, name in enumerate(parameters):
        _marginal(figure.add_subplot(plots[1, column]), estimate, result, name)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def _heading(figure: Figure, capture: Any, estimate: Any, result: Result) -> None:
    texels, seen = len(result.seen), int(result.seen.sum())
    width, height = estimate.texels.resolution
    mean = f"mean entropy {result.entropy[result.seen].mean():.2f}" if seen else "nothing seen"
    notes = (
        f"method {estimate.method}",
        f"preset {estimate.preset.name}",
        *(f"known {words(name)} {value:g}" for name, value in known(estimate).items()),
        f"{sum(capture.used)} of {capture.count} views",
        f"{width} × {height} texels, {texels:_} in charts".replace("_", THIN_SPACE),
        f"{seen:_} seen ({100 * seen / max(texels, 1):.0f} %)".replace("_", THIN_SPACE),
        mean,
        f"{np.nansum(list(estimate.timings.values())):.1f} s",
    )
    figure.text(
        LEFT, 0.962, "What the photographs say about the reflectance",
        size=19, weight="bold", color=INK, va="center",
    )  # fmt: skip
    figure.text(LEFT, 0.922, "   ·   ".join(notes), size=11.5, color=FAINT, va="center")


def words(name: str) -> str:
    """Return a parameter's name as it is said: base colour, roughness, ..."""
    return name.replace("_", " ").replace("color", "colour")


def open_axes(estimate: Any) -> dict[str, np.ndarray]:
    """Return the nodes of the parameters that are in question, by name."""
    return {name: nodes for name, nodes in estimate.posterior.axes.items() if len(nodes) > 1}


def known(estimate: Any) -> dict[str, float]:
    """Return the parameters of an estimate that were not in question, by name."""
    axes = estimate.posterior.axes.items()
    return {name: float(nodes[0]) for name, nodes in axes if len(nodes) == 1}


def _object_row(figure: Figure, cells: Any, capture: Any, estimate: Any, result: Result) -> None:
    """Photograph and entropy side by side, for two views far apart."""
    chosen = views.far_apart(capture, getattr(estimate, "seen_per_view", None))
    texture = _entropy_colors(estimate, result, gutter=True)
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
        _title(left, f"Photograph {view}")
        _title(right, "Entropy seen from there")


def _entropy_map(figure: Figure, axes: Axes, estimate: Any, result: Result) -> None:
    from matplotlib.colors import Normalize

    axes.imshow(_entropy_colors(estimate, result), interpolation="nearest")
    _hatch(axes, result)
    _title(axes, "Entropy")
    _colorbar(figure, axes, COLORMAP, Normalize(0, 1), "0 = certain,  1 = nothing known")


def _coverage_map(figure: Figure, axes: Axes, capture: Any, estimate: Any, result: Result) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    most = max(int(result.coverage.max(initial=0)), 1)
    scale = Normalize(0, most)
    image = estimate.texels.to_image(result.coverage, 0)
    colors = colormaps[VIEWS_COLORMAP](scale(image))[..., :3]
    axes.imshow(_marked(colors, result), interpolation="nearest")
    _hatch(axes, result)
    _title(axes, "Coverage")
    label = f"views that see the texel, of {sum(capture.used)}"
    bar = _colorbar(figure, axes, VIEWS_COLORMAP, scale, label)
    bar.ax.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))


def _entropy_colors(estimate: Any, result: Result, *, gutter: bool = False) -> np.ndarray:
    """Return (H, W, 3) screen colours; with a gutter, charts grow over what is outside."""
    from matplotlib import colormaps

    from svu_mi.surface.gutter import dilate

    image = estimate.texels.to_image(result.entropy, 1)
    colors = _marked(colormaps[COLORMAP](image)[..., :3], result)
    return dilate(colors, result.inside, 3) if gutter else colors


def _marked(colors: np.ndarray, result: Result) -> np.ndarray:
    colors = np.array(colors, np.float32)
    colors[result.unseen] = UNSEEN
    colors[~result.inside] = OUTSIDE
    return colors


def _hatch(axes: Axes, result: Result) -> None:
    """Hatch what is outside the charts, so that no grey can be taken for a value; add a key."""
    from matplotlib.patches import Patch

    height, width = result.inside.shape
    if not result.inside.all():
        stripes = axes.contourf(
            ~result.inside, levels=(0.5, 1.5), colors="none", hatches=("////",),
            extent=(-0.5, width - 0.5, -0.5, height - 0.5),
        )  # fmt: skip
        stripes.set(edgecolor=RULE, linewidth=0)
    axes.set(xticks=[], yticks=[], anchor="N")
    for spine in axes.spines.values():
        spine.set_color(RULE)
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

    _title(axes, "Entropy of the texels seen")
    _plain(axes)
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


def _marginal(axes: Axes, estimate: Any, result: Result, name: str) -> None:
    """Mean marginal over the texels seen, and over the most certain of them."""
    _title(axes, f"Posterior of {words(name)}")
    _plain(axes)
    if not result.seen.any():
        _nothing(axes)
        return
    nodes = estimate.posterior.axes[name]
    means = mean_marginals(estimate, result, name)
    channels = means[False].shape[1]
    colors = ("#c23b3b", "#2f8f4e", "#3566b8") if channels == 3 else (INK,)
    for k, color in enumerate(colors):
        axes.plot(nodes, means[False][:, k], "o-", color=color, lw=1.8, ms=3)
        axes.plot(nodes, means[True][:, k], color=color, lw=1.2, ls=(0, (3, 2)))
    axes.axhline(1 / len(nodes), color=RULE, lw=1, zorder=0)
    highest = max(float(mean.max()) for mean in means.values())
    axes.set(xlim=(0, 1), ylim=(0, 1.6 * highest))  # room for the key
    for style, label in (("o-", "mean of all seen"), ("--", "of the most certain 10 %")):
        axes.plot([], [], style, color=INK, lw=1.4, ms=3, label=label)
    axes.legend(
        fontsize=8, frameon=False, labelcolor=INK, loc="upper left", borderaxespad=0,
        handlelength=1.6, labelspacing=0.2,
    )  # fmt: skip
    if channels == 3:
        _title(axes, f"Posterior of {words(name)}: R, G, B")


def mean_marginals(estimate: Any, result: Result, name: str) -> dict[bool, np.ndarray]:
    """Return mean marginals of a parameter, if any texel is seen.

    Args:
        estimate: the ``Estimate``.
        result: what it says.
        name: of the parameter.

    Returns:
        (nodes, 1), or (nodes, 3) where channels differ: over all texels seen (False), and over
        the most certain of them (True).
    """
    limit = np.quantile(result.entropy[result.seen], CERTAIN_PART)

    def mean(of: np.ndarray) -> np.ndarray:
        every = np.flatnonzero(of)
        some = every[:: max(len(every) // SAMPLE, 1)]
        p = np.array(estimate.posterior.marginal(name, some), np.float64)
        return p.reshape(len(some), p.shape[1], -1).mean(axis=0)

    return {True: mean(result.seen & (result.entropy <= limit)), False: mean(result.seen)}


def _colorbar(figure: Figure, axes: Axes, name: str, scale: Any, label: str) -> Any:
    from matplotlib.cm import ScalarMappable

    place = axes.inset_axes((0.0, -0.075, 1.0, 0.035))
    bar = figure.colorbar(ScalarMappable(scale, name), cax=place, orientation="horizontal")
    bar.outline.set_visible(False)
    bar.set_label(label, size=9, color=FAINT)
    bar.ax.tick_params(labelsize=9, color=FAINT, labelcolor=INK, length=3)
    return bar


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", size=11.5, color=INK, pad=6)


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(RULE)
    axes.tick_params(labelsize=9, color=RULE, labelcolor=INK, length=3)


def _nothing(axes: Axes) -> None:
    axes.set(xlim=(0, 1), yticks=[])
    axes.text(0.5, 0.5, "no texel was seen", color=FAINT, ha="center", va="center", size=11)
