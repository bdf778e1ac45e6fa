"""``guidance.png``: one page that says which photographs to take next, and why."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture.poses import film_size, resized_sensor
from svu_mi.files import replacing
from svu_mi.guidance.options import UNITS
from svu_mi.output import views
from svu_mi.output.directions import UP, color_range, draw_directions, numbered
from svu_mi.output.figures import GUTTER, draw_map
from svu_mi.output.overview import (
    COLORMAP,
    FAINT,
    INK,
    LEFT,
    OUTSIDE,
    RIGHT,
    RULE,
    THIN_SPACE,
    UNSEEN,
)  # fmt: skip
from svu_mi.surface.gutter import dilate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

DPI = 100
SIZE = (18.0, 11.2)  # inches
SHOWN = 5  # proposals that are drawn on the object
WHITE = 0.99  # part of the positive gains of texels that colours do not clip
CROWDED = 0.04  # part of the candidates within which two numbers would overlap
GAIN_COLORS = ("#c6c6cc", "#f6c06b", "#e8743b", "#b3243f", "#5b0f3a")  # grey: nothing gained


def write_guidance_overview(
    capture: Any,
    estimate: Any,
    guidance: Any,
    maps: np.ndarray,
    pictures: Sequence[np.ndarray],
    path: str | Path,
    *,
    up: tuple[float, float, float] = UP,
) -> None:
    """Draw where to go, what it is worth, and what is to be seen there: 1800 x 1120 pixels.

    Args:
        capture: the ``Capture``.
        estimate: what its photographs say.
        guidance: the ``Guidance`` from there.
        maps: (proposals, T) of ``Guidance.gain_maps``.
        pictures: what the proposals see of them, of ``gain_picture``.
        path: the PNG file.
        up: top of the map of directions.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    _heading(figure, capture, estimate, guidance)
    place = figure.add_axes((LEFT, 0.51, 0.455, 0.355))
    drawn = draw_directions(place, capture, guidance, up=up)
    _title(place, "Directions from which the object can be photographed", pad=34)
    _bar_below(figure, place, drawn, f"as the next photograph: {UNITS[guidance.options.strategy]}")
    line = figure.add_axes((0.535, 0.545, 0.195, 0.33))
    draw_expected(line, capture, guidance, estimate)
    _title(line, "Entropy to be expected")
    ranked = figure.add_axes((0.79, 0.545, 0.195, 0.33))
    draw_ranking(ranked, guidance)
    _title(ranked, "All candidates as the next photograph")
    rows = figure.add_gridspec(
        2, SHOWN + 1, left=LEFT + 0.012, right=RIGHT, top=0.42, bottom=0.01, hspace=0.2, wspace=0.1
    )
    _objects(figure, rows, capture, estimate, guidance, pictures)
    _maps(figure, rows, estimate, guidance, maps)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def draw_expected(axes: Axes, capture: Any, guidance: Any, estimate: Any | None = None) -> None:
    """Draw the mean expected entropy against the number of photographs.

    Args:
        axes: where to.
        capture: says how many photographs there are.
        guidance: the proposals.
        estimate: its mean entropy is that of the photographs as they are, a diamond.
    """
    from matplotlib.ticker import MaxNLocator

    first = sum(capture.used)
    values = [guidance.entropy, *(proposal.entropy for proposal in guidance.proposals)]
    axes.plot(np.arange(len(values)) + first, values, "-", color=INK, lw=1.6, zorder=1)
    axes.scatter([first], values[:1], 42, c=INK, zorder=2)
    for rank, value in enumerate(values[1:], 1):
        numbered(axes, first + rank, value, rank, "white", 210)
    shown = list(values)
    if estimate is not None:
        shown.append(float(np.mean(np.array(estimate.entropy, np.float64))))
        axes.scatter([first], shown[-1:], 46, marker="D", facecolors="white", edgecolors=INK,
                     lw=1.4, zorder=3, label=f"of these photographs: {shown[-1]:.3f}")  # fmt: skip
    label = f"to be expected of any from there: {guidance.entropy:.3f}"
    axes.scatter([], [], 42, c=INK, label=label)
    room = max(0.12 * (max(shown) - min(shown)), 0.01)
    axes.set(xlim=(first - 0.5, first + len(values) - 0.5))
    axes.set(ylim=(max(min(shown) - room, -0.02), max(shown) + 3.2 * room))
    axes.legend(fontsize=9, frameon=False, labelcolor=INK, loc="upper right", borderaxespad=0.2,
                handletextpad=0.2, reverse=True)  # fmt: skip
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True))
    axes.set_xlabel("photographs", size=9.5, color=FAINT)
    axes.set_ylabel("mean entropy", size=9.5, color=FAINT)
    _plain(axes)


def draw_ranking(axes: Axes, guidance: Any) -> None:
    """Draw the gains of all candidates that can be reached, the best first.

    Args:
        axes: where to.
        guidance: candidates, their gains, and the proposals.
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    order = guidance.ranking
    gains = guidance.gains[order]
    colors = colormaps[COLORMAP](Normalize(*color_range(gains))(gains))
    axes.bar(np.arange(1, len(order) + 1), gains, width=1 if len(order) > 60 else 0.9, color=colors)
    for place, gain, rank, level in _labels(order, gains, guidance.proposals):
        axes.annotate(
            str(rank), (place, gain), xytext=(0, 3 + 12 * level), ha="center", va="bottom",
            textcoords="offset points", size=9.5, weight="bold", color=INK,
        )  # fmt: skip
    top = float(max(gains.max(), 1e-9))
    axes.set(xlim=(0.25, len(order) + 0.75), ylim=(min(float(gains.min()), 0), 1.2 * top))
    axes.axhline(0, color=RULE, lw=1)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    axes.set_xlabel("candidates, the best first", size=9.5, color=FAINT)
    axes.set_ylabel("gain" if guidance.options.strategy == "entropy" else "worth", size=9.5,
                    color=FAINT)  # fmt: skip
    _plain(axes)


def gain_limit(maps: np.ndarray) -> float:
    """Return the gain of a texel that has the last colour."""
    positive = maps[maps > 0]
    return max(float(np.quantile(positive, WHITE)), 1e-6) if len(positive) else 1.0


def gain_picture(capture: Any, guidance: Any, proposal: int, maps: np.ndarray) -> np.ndarray:
    """Render the object as a proposed camera will see it, grey where no entropy will go.

    Args:
        capture: the ``Capture``.
        guidance: the proposals.
        proposal: number of the proposal.
        maps: (proposals, T) of ``Guidance.gain_maps``; all have one scale of colours.

    Returns:
        (h, w, 4) float32 as of ``views.picture``.
    """
    texels, sensor = guidance.texels, guidance.proposals[proposal].sensor
    image = texels.to_image(np.clip(maps[proposal] / gain_limit(maps), 0, 1))
    colors = np.asarray(gain_colors()(image)[..., :3], np.float32)
    colors[~texels.inside()] = OUTSIDE
    return views.picture(capture, dilate(colors, texels.inside(), GUTTER), _large(sensor))


def gain_colors() -> Colormap:
    """Return the colours of gains, from the grey of nothing."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("gain", GAIN_COLORS)


def _heading(figure: Figure, capture: Any, estimate: Any, guidance: Any) -> None:
    width, height = guidance.texels.resolution
    options, reachable = guidance.options, int(guidance.candidates.reachable.sum())
    looked_at = min(options.texels, guidance.texels.count)
    words = (
        f"method {guidance.method}",
        f"preset {estimate.preset.name}",
        f"by {options.strategy}",
        f"{sum(capture.used)} photographs",
        f"{reachable} of {guidance.candidates.count} candidates can be reached",
        f"{width} × {height} texels, {looked_at:_} of {guidance.texels.count:_} looked at".replace(
            "_", THIN_SPACE
        ),
        f"{np.nansum(list(guidance.timings.values())):.1f} s",
    )
    figure.text(
        LEFT, 0.968, "Which photograph to take next", size=19, weight="bold", color=INK, va="center"
    )
    figure.text(LEFT, 0.936, "   ·   ".join(words), size=11.5, color=FAINT, va="center")


def _objects(
    figure: Figure, rows: Any, capture: Any, estimate: Any, guidance: Any,
    pictures: Sequence[np.ndarray],
) -> None:  # fmt: skip
    """What the proposed cameras will see: entropy so far, and what each is expected to change."""
    entropy = _entropy_texture(estimate)
    shown = zip(guidance.proposals[:SHOWN], pictures, strict=False)
    for column, (proposal, gain) in enumerate(shown):
        before = views.picture(capture, entropy, _large(proposal.sensor))
        window = views.object_window(before[..., 3] > 0)
        for row, image in enumerate((before, gain)):
            axes = figure.add_subplot(rows[row, column])
            axes.imshow(views.crop(image[..., :3], window))
            axes.set(anchor="N")
            axes.set_axis_off()
            words = _short(proposal.name) if row == 0 else _worth(proposal)
            axes.set_title(words, loc="center", size=10, color=INK, pad=4)
            if row == 0:
                numbered(axes, 0.06, 0.93, column + 1, "white", 260, transform=axes.transAxes)
            if column == 0:
                words = ("entropy so far", "expected gain")[row]
                axes.text(-0.03, 0.5, words, transform=axes.transAxes, rotation=90, size=11,
                          color=INK, ha="right", va="center")  # fmt: skip


def _maps(figure: Figure, rows: Any, estimate: Any, guidance: Any, maps: np.ndarray) -> None:
    """Both in the layout of the texture, with the scales of the pictures beside them."""
    column = min(len(guidance.proposals), SHOWN)
    above, below = (figure.add_subplot(rows[row, column]) for row in (0, 1))
    _bar_beside(figure, above, draw_map(above, estimate))
    above.set_title("entropy of every texel", loc="center", size=10, color=INK, pad=4)
    gains = maps[0] if len(maps) else np.zeros(guidance.texels.count, np.float32)
    image = np.clip(guidance.texels.to_image(gains, 0.0), 0, None)
    drawn = below.imshow(image, cmap=gain_colors(), vmin=0, vmax=gain_limit(maps))
    cover = np.zeros((*image.shape, 4), np.float32)
    cover[~guidance.texels.inside()] = (*OUTSIDE, 1)
    below.imshow(cover, interpolation="nearest")
    below.set(xticks=[], yticks=[])
    below.spines[:].set_color(RULE)
    _bar_beside(figure, below, drawn)
    below.set_title("gain by proposal 1", loc="center", size=10, color=INK, pad=4)
    for axes in (above, below):
        axes.set_anchor("NW")


def _labels(
    order: np.ndarray, gains: np.ndarray, proposals: Any
) -> Iterator[tuple[int, float, int, int]]:
    """Yield where a proposal's number stands: place, height, rank, and lines above that height.

    Crowded numbers stand one above the other, over the highest bar among theirs.
    """
    rank_of = {proposal.candidate: rank for rank, proposal in enumerate(proposals, 1)}
    last, level, height = -np.inf, 0, 0.0
    for place, (candidate, gain) in enumerate(zip(order, gains, strict=True), 1):
        if int(candidate) not in rank_of:
            continue
        level = level + 1 if place - last < CROWDED * len(order) else 0
        height = height if level else max(float(gain), 0.0)
        yield place, height, rank_of[int(candidate)], level
        last = place


def _entropy_texture(estimate: Any) -> np.ndarray:
    """(H, W, 3) colours of the entropy so far, unseen texels grey."""
    from matplotlib import colormaps

    inside = estimate.texels.inside()
    image = estimate.texels.to_image(np.array(estimate.entropy, np.float32), 1.0)
    colors = np.asarray(colormaps[COLORMAP](image)[..., :3], np.float32)
    colors[estimate.texels.to_image(np.array(estimate.coverage) == 0, False)] = UNSEEN
    colors[~inside] = OUTSIDE
    return dilate(colors, inside, GUTTER)


def _large(sensor: Any) -> Any:
    """Return the sensor with a film that pictures need not be smaller than."""
    return resized_sensor(sensor, -(-views.SIDE // max(film_size(sensor))))


def _worth(proposal: Any) -> str:
    error = f" ± {proposal.error:.4f}" if proposal.error > 0 else ""
    new = f", {100 * proposal.new:.0f} % as the first" if proposal.new >= 0.005 else ""
    return f"{proposal.gain:.4f}{error}\nsees {100 * proposal.sees:.0f} % of the texels{new}"


def _short(name: str) -> str:
    return name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}"


def _bar_below(figure: Figure, axes: Axes, drawn: Any, label: str) -> None:
    place = axes.inset_axes((0.2, -0.06, 0.6, 0.028))
    _style(figure.colorbar(drawn, cax=place, orientation="horizontal"), label)


def _bar_beside(figure: Figure, axes: Axes, drawn: Any) -> None:
    place = axes.inset_axes((1.03, 0.0, 0.04, 1.0))
    _style(figure.colorbar(drawn, cax=place), "")


def _style(bar: Any, label: str) -> None:
    bar.outline.set_visible(False)
    bar.set_label(label, size=9.5, color=FAINT)
    bar.ax.tick_params(labelsize=8.5, color=FAINT, labelcolor=INK, length=3)


def _title(axes: Axes, text: str, pad: float = 8) -> None:
    axes.set_title(text, loc="left", size=11.5, color=INK, pad=pad)


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(RULE)
    axes.tick_params(labelsize=9, color=RULE, labelcolor=INK, length=3)
