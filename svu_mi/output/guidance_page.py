"""``guidance.png``: one page that says which photographs to take next, and why."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture.poses import bounding_sphere, describe, make_sensor
from svu_mi.capture.scene import to_world
from svu_mi.files import replacing
from svu_mi.output import views
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
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

DPI = 100
SIZE = (18.0, 11.2)  # inches
SHOWN = 5  # proposals that are drawn on the object
WHITE = 0.99  # part of the positive gains of texels that colours do not clip
CROWDED = 0.04  # part of the candidates within which two numbers would overlap
WORST = 0.02  # part of the candidates' gains that colours clip below
GAIN_COLORS = ("#c6c6cc", "#f6c06b", "#e8743b", "#b3243f", "#5b0f3a")  # grey: nothing gained
LUMINANCE, DARK = (0.2126, 0.7152, 0.0722), 0.45  # numbers on darker discs are white
UP = (0.0, 1.0, 0.0)
UNITS = {
    "entropy": "expected change of the mean entropy",
    "d-optimal": "mean change of log det of the information",
    "coverage": "mean worth of the texels seen",
    "farthest": "angle to the nearest photograph, in radians",
    "random": "a drawn rank",
}  # of Guidance.gains, by strategy


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


def draw_directions(
    axes: Axes, capture: Any, guidance: Any, *, up: tuple[float, float, float] = UP
) -> ScalarMappable:
    """Draw all candidates on a map of the directions around the object.

    An equal-area map (Hammer's), seen from outside; its centre is below the first photograph.
    Candidates are dots, hollow if they cannot be reached; photographs are crosses; proposals have
    their rank.

    Args:
        axes: where to.
        capture: the ``Capture``; photographs that are used are shown.
        guidance: candidates, their gains, and the proposals.
        up: top of the map.

    Returns:
        What was drawn, to hand to ``figure.colorbar``.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    used = [s for s, u in zip(capture.sensors, capture.used, strict=True) if u]
    center, _ = bounding_sphere(capture.shape)
    frame = _frame(np.array(up, np.float64), _directions(used, center)[0])
    x, y = _hammer(_directions(guidance.candidates.sensors, center) @ frame.T)
    gains, reachable = guidance.gains, guidance.candidates.reachable
    drawn = ScalarMappable(Normalize(*_range(gains[reachable])), COLORMAP)
    _graticule(axes)
    size = _dot(axes, len(gains))
    axes.scatter(x[~reachable], y[~reachable], size, facecolors="none", edgecolors=UNSEEN, lw=1)
    colors = drawn.to_rgba(gains[reachable])
    axes.scatter(x[reachable], y[reachable], size, c=colors, lw=0)
    for color, width in (("white", 4.5), (INK, 2.0)):
        axes.scatter(*_hammer(_directions(used, center) @ frame.T), 60, c=color, marker="x",
                     lw=width, zorder=3)  # fmt: skip
    for rank, proposal in enumerate(guidance.proposals, 1):
        k = proposal.candidate
        _numbered(axes, x[k], y[k], rank, drawn.to_rgba(gains[k]), max(size, 230))
    _key(axes, bool((~reachable).any()))
    return drawn


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
        _numbered(axes, first + rank, value, rank, "white", 210)
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
    colors = colormaps[COLORMAP](Normalize(*_range(gains))(gains))
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
                _numbered(axes, 0.06, 0.93, column + 1, "white", 260, transform=axes.transAxes)
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
    record = describe(sensor)
    factor = -(-views.SIDE // max(record["crop_size"]))
    for key in ("film", "crop_offset", "crop_size"):
        record[key] = [factor * value for value in record[key]]
    return make_sensor(record, "overview")


def _worth(proposal: Any) -> str:
    error = f" ± {proposal.error:.4f}" if proposal.error > 0 else ""
    new = f", {100 * proposal.new:.0f} % as the first" if proposal.new >= 0.005 else ""
    return f"{proposal.gain:.4f}{error}\nsees {100 * proposal.sees:.0f} % of the texels{new}"


def _short(name: str) -> str:
    return name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}"


def _directions(sensors: Any, center: np.ndarray) -> np.ndarray:
    """Unit vectors (V, 3) from the object to sensors; upwards for one at its very centre."""
    offsets = np.array([to_world(sensor)[:3, 3] - center for sensor in sensors]).reshape(-1, 3)
    lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
    return np.where(lengths > 0, offsets / np.maximum(lengths, 1e-30), UP)


def _frame(up: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Rows right, up, front (3, 3); ``first`` is in front, or above it."""
    up = up / np.linalg.norm(up)
    for front in (first, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])):
        front = front - (front @ up) * up
        if np.linalg.norm(front) > 1e-3:
            break
    front = front / np.linalg.norm(front)
    return np.stack([np.cross(up, front), up, front])


def _hammer(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project (right, up, front) (V, 3) onto an ellipse of half-axes 2 sqrt(2) and sqrt(2)."""
    right, up, front = directions.T
    half, level = np.arctan2(right, front) / 2, np.sqrt(np.maximum(1 - up**2, 0))
    scale = np.sqrt(2 / (1 + level * np.cos(half)))
    return 2 * scale * level * np.sin(half), scale * up


def _graticule(axes: Axes) -> None:
    """Draw the border of the map, and lines every 30 degrees of elevation and 45 of azimuth."""
    t = np.linspace(-np.pi, np.pi, 181)

    def line(azimuth: Any, elevation: Any, **style: Any) -> None:
        level = np.cos(elevation)
        parts = (level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth, level * np.cos(azimuth))
        axes.plot(*_hammer(np.stack(parts, axis=-1)), color=RULE, zorder=0, **style)

    edge = np.pi - 1e-6
    for elevation in np.radians([-60, -30, 0, 30, 60]):
        line(np.clip(t, -edge, edge), elevation, lw=1.1 if elevation == 0 else 0.6)
    for azimuth in np.radians([-135, -90, -45, 0, 45, 90, 135]):
        line(azimuth + 0 * t, t / 2, lw=0.6)
    for azimuth in (-edge, edge):
        line(azimuth + 0 * t, t / 2, lw=1.2)
    root = np.sqrt(2)
    axes.set(xlim=(-2.02 * root, 2.02 * root), ylim=(-1.05 * root, 1.05 * root), aspect="equal")
    axes.set_anchor("W")
    axes.set_axis_off()
    axes.text(0, 1.02 * root, "above", size=9.5, color=FAINT, ha="center", va="bottom")
    axes.text(0, -1.02 * root, "below", size=9.5, color=FAINT, ha="center", va="top")


def _key(axes: Axes, unreachable: bool) -> None:
    axes.scatter([], [], 60, c=INK, marker="x", lw=2, label="photographs so far")
    axes.scatter([], [], 90, c="white", edgecolors=INK, lw=1.6, label="proposals, by rank")
    axes.scatter([], [], 60, c=[(0.13, 0.57, 0.55)], lw=0, label="other candidates")
    if unreachable:
        axes.scatter([], [], 60, facecolors="none", edgecolors=UNSEEN, label="out of reach")
    axes.legend(
        fontsize=9.5, frameon=False, labelcolor=INK, loc="lower left", borderaxespad=0,
        bbox_to_anchor=(-0.01, 1.03), handletextpad=0.1, ncol=4, columnspacing=1.4,
    )  # fmt: skip


def _numbered(axes: Axes, x: float, y: float, rank: int, color: Any, size: float,
              **options: Any) -> None:  # fmt: skip
    """Draw a disk with a number in it."""
    from matplotlib.colors import to_rgb

    ink = INK if np.dot(LUMINANCE, to_rgb(color)) > DARK else "white"
    axes.scatter([x], [y], size, c=[color], edgecolors=INK, lw=1.6, zorder=4, **options)
    axes.text(
        x, y, str(rank), size=9.5, weight="bold", color=ink, ha="center", va="center_baseline",
        zorder=5, **options,
    )  # fmt: skip


def _dot(axes: Axes, count: int) -> float:
    """Area of a candidate's dot in square points: dots of an even sphere do not touch."""
    width = axes.get_position().width * axes.figure.get_size_inches()[0] * 72
    diameter = 0.62 * np.sqrt(4 * np.pi / max(count, 1)) * width / (4.04 * np.sqrt(2))
    return float(np.clip(diameter**2, 9, 170))


def _range(gains: np.ndarray) -> tuple[float, float]:
    """Values at both ends of the colours; a few candidates that see nothing do not count."""
    low, high = float(np.quantile(gains, WORST)), float(gains.max())
    return (low, high) if high > low else (low - 1e-6, low + 1e-6)


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
