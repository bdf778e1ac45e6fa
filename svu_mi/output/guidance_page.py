"""``guidance.png``: one page that says which photographs to take next, and why."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.look import SIDE, Look, alone
from svu_mi.capture.poses import film_size, resized_sensor
from svu_mi.guidance.result import Guidance, Proposal
from svu_mi.guidance.strategies import TABLE
from svu_mi.names import plain_name
from svu_mi.output import style, views
from svu_mi.output.directions import Directions, color_range, numbered
from svu_mi.output.figures import all_seen, draw_map, map_colors, still
from svu_mi.output.page import grouped
from svu_mi.output.style import GAIN_COLORS, INK, LEFT, RIGHT, RULE
from svu_mi.output.upright import UP
from svu_mi.pipeline import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

SIZE = (18.0, 11.2)  # inches
HEADING = "Which photograph to take next"
# Of the map of directions and the two plots: left, right, top and bottom, in parts of the page.
PLACES = ((LEFT, 0.473, 0.865, 0.51), (0.535, 0.73, 0.875, 0.545), (0.79, RIGHT, 0.875, 0.545))
LINE, LINES = 12, 9  # points from one number to the next above it, and how many there are at most
SHOWN = 5  # proposals that are drawn on the object
WHITE = 0.99  # part of the positive gains of texels that colours do not clip
CROWDED = 0.04  # part of the candidates within which two numbers would overlap


@dataclass(frozen=True)
class Sights:
    """What the proposed cameras will see of the object.

    Attributes:
        guidance: the proposals.
        looks: one of each.
    """

    guidance: Guidance
    looks: list[Look]

    @classmethod
    def of(cls, capture: Capture, guidance: Guidance) -> Sights:
        """Look from the proposals."""
        scene = alone(capture)
        return cls(guidance, [Look.at(scene, _large(one.sensor)) for one in guidance.proposals])

    def entropy(self, estimate: Estimate) -> list[np.ndarray]:
        """Return pictures of the entropy so far, by the proposals that the page shows."""
        colors = map_colors(estimate)
        return [look.painted(colors) for look in self.looks[:SHOWN]]

    def gains(self, maps: np.ndarray) -> list[np.ndarray]:
        """Return pictures of ``Guidance.gain_maps``, as of ``gain_picture``."""
        return [_painted(look, self.guidance, k, maps) for k, look in enumerate(self.looks)]


class GuidanceOverview:
    """Where to go, what it is worth, and what is to be seen there: 1800 x 1120 pixels.

    Args:
        capture: the ``Capture``.
        estimate: what its photographs say.
        guidance: the ``Guidance`` from there.
        up: top of the map of directions.
    """

    def __init__(
        self, capture: Capture, estimate: Estimate, guidance: Guidance,
        up: tuple[float, float, float] = UP,
    ) -> None:  # fmt: skip
        self._guidance, self._estimate = guidance, still(estimate)
        self._capture, self._notes = capture, _notes(capture, estimate, guidance)
        self._directions = Directions.of(capture, guidance, up)
        self._everywhere = all_seen(guidance.texels)

    def begin(self) -> None:
        """Draw where to go, and what it is worth."""
        self._figure = figure = style.new_figure(*SIZE)
        style.heading(figure, HEADING, self._notes, (0.968, 0.936))
        places = [
            figure.add_gridspec(1, 1, left=left, right=right, top=top, bottom=bottom)[0]
            for left, right, top, bottom in PLACES
        ]
        guidance = self._guidance
        style.draw_panels(figure, places, [
            ("", partial(_directions, drawn=self._directions, guidance=guidance)),
            ("Mean entropy of all texels, now and expected",
             partial(draw_expected, capture=self._capture, guidance=guidance)),
            ("All candidates as the next photograph", partial(draw_ranking, guidance=guidance)),
        ])  # fmt: skip
        self._rows = figure.add_gridspec(
            2, SHOWN + 1, left=LEFT + 0.012, right=RIGHT, top=0.42, bottom=0.01, hspace=0.2,
            wspace=0.1,
        )  # fmt: skip

    def draw_entropy(self, pictures: Sequence[np.ndarray]) -> None:
        """Draw what is known (``Sights.entropy``)."""
        names = [_short(one.name) for one in self._guidance.proposals]
        for rank, axes in enumerate(self._row(0, "entropy so far", pictures, names), 1):
            numbered(axes, 0.06, 0.93, rank, "white", 260, transform=axes.transAxes)
        axes = self._figure.add_subplot(self._rows[0, len(pictures)])
        _scaled(axes, draw_map(axes, self._estimate), "entropy of every texel")

    def finish(self, maps: np.ndarray, pictures: Sequence[np.ndarray], path: str | Path) -> None:
        """Draw gains (``Guidance.gain_maps``, ``Sights.gains``), and write the PNG file.

        Raises:
            OutputError: the file cannot be written.
        """
        shown = pictures[:SHOWN]
        self._row(1, "expected gain", shown, [_worth(one) for one in self._guidance.proposals])
        axes = self._figure.add_subplot(self._rows[1, len(shown)])
        first = maps[0] if len(maps) else np.zeros(self._everywhere.texels.count, np.float32)
        scale: Any = {"limits": (0, gain_limit(maps)), "colormap": gain_colors()}
        _scaled(axes, draw_map(axes, self._everywhere, first, **scale), "gain by proposal 1")
        style.save_figure(self._figure, path)

    def _row(
        self, row: int, name: str, pictures: Sequence[np.ndarray], captions: Sequence[str]
    ) -> list[Axes]:
        """Draw what proposed cameras will see, cut to the object."""
        drawn = []
        for column, (image, caption) in enumerate(zip(pictures, captions, strict=False)):
            axes = self._figure.add_subplot(self._rows[row, column])
            window = views.object_window(image[..., 3] > 0)
            style.draw_image(axes, views.crop(image[..., :3], window))
            axes.set_anchor("N")
            style.caption(axes, caption)
            if column == 0:
                axes.text(-0.03, 0.5, name, transform=axes.transAxes, rotation=90, size=11,
                          color=INK, ha="right", va="center")  # fmt: skip
            drawn.append(axes)
        return drawn


def _notes(capture: Capture, estimate: Estimate, guidance: Guidance) -> list[str]:
    width, height = guidance.texels.resolution
    options, reachable = guidance.options, int(guidance.candidates.reachable.sum())
    looked_at = min(options.texels, guidance.texels.count)
    return [
        f"method {guidance.method}",
        f"preset {estimate.preset.name}",
        f"by {options.strategy}",
        f"{sum(capture.used)} photographs",
        f"{reachable} of {guidance.candidates.count} candidates can be reached",
        f"{width} × {height} texels, {grouped(looked_at)} of "
        f"{grouped(guidance.texels.count)} looked at",
    ]


def _directions(axes: Axes, drawn: Directions, guidance: Guidance) -> None:
    colors = drawn.draw(axes)
    style.title(axes, "Directions from which the object can be photographed", pad=34)
    label = f"as the next photograph: {TABLE[guidance.options.strategy].unit}"
    style.color_bar(axes, colors, label, (0.2, -0.06, 0.6, 0.028))


def draw_expected(axes: Axes, capture: Capture, guidance: Guidance) -> None:
    """Draw the mean entropy against the number of photographs: now, and as it is expected.

    Without a forecast, there is nothing to draw but today's.
    """
    from matplotlib.ticker import MaxNLocator

    first = sum(capture.used)
    values = np.array([guidance.entropy, *(one.entropy for one in guidance.proposals)])
    values = values[np.isfinite(values)]
    axes.plot(np.arange(len(values)) + first, values, "-", color=INK, lw=1.6, zorder=1)
    axes.scatter([first], values[:1], 42, c=INK, zorder=2,
                 label=f"of these photographs: {guidance.entropy:.3f}")  # fmt: skip
    for rank, value in enumerate(values[1:], 1):
        numbered(axes, first + rank, value, rank, "white", 210)
    room = max(0.12 * float(np.ptp(values)), 0.01)
    axes.set(xlim=(first - 0.5, first + len(values) - 0.5))
    axes.set(ylim=(max(float(values.min()) - room, -0.02), float(values.max()) + 2.2 * room))
    style.legend(axes, loc="upper right", borderaxespad=0.2, handletextpad=0.2)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True))
    growing = guidance.options.band_limit == "growing"
    light = "; light filtered for that number" if growing else ""
    style.labels(axes, f"photographs{light}", "mean entropy", 9.5)
    style.plain(axes)


def draw_ranking(axes: Axes, guidance: Guidance) -> None:
    """Draw the gains of all candidates that can be reached, the best first."""
    from matplotlib.ticker import MaxNLocator

    order = guidance.ranking
    gains = guidance.gains[order]
    colors = style.colors(gains, color_range(gains))
    axes.bar(np.arange(1, len(order) + 1), gains, width=1 if len(order) > 60 else 0.9, color=colors)
    low, top = min(float(gains.min()), 0), 1.2 * float(max(gains.max(), 1e-9))
    tall = axes.get_window_extent().height * 72 / axes.figure.dpi  # points
    for place, gain, rank, level in _labels(order, gains, guidance.proposals):
        above = 3 + LINE * level
        axes.annotate(
            str(rank), (place, gain), xytext=(0, above), ha="center", va="bottom",
            textcoords="offset points", size=9.5, weight="bold", color=INK,
        )  # fmt: skip
        top = max(top, low + (gain - low) / max(1 - (above + LINE) / tall, 0.5))
    axes.set(xlim=(0.25, len(order) + 0.75), ylim=(low, top))
    axes.axhline(0, color=RULE, lw=1)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    what = "gain" if guidance.options.strategy == "entropy" else "worth"
    style.labels(axes, "candidates, the best first", what, 9.5)
    style.plain(axes)


def gain_limit(maps: np.ndarray) -> float:
    """Return the gain of a texel that has the last colour."""
    positive = maps[maps > 0]
    return max(float(np.quantile(positive, WHITE)), 1e-6) if len(positive) else 1.0


def gain_picture(
    capture: Capture, guidance: Guidance, proposal: int, maps: np.ndarray
) -> np.ndarray:
    """Render the object as a proposed camera will see it, grey where no entropy will go.

    Args:
        capture: whose object it is.
        guidance: the proposals.
        proposal: number of the proposal.
        maps: (proposals, T) of ``Guidance.gain_maps``; all have one scale of colours.

    Returns:
        (h, w, 4) float32 as of ``views.picture``.
    """
    look = Look.at(alone(capture), _large(guidance.proposals[proposal].sensor))
    return _painted(look, guidance, proposal, maps)


def _painted(
    look: Look, guidance: Guidance, proposal: int, maps: np.ndarray
) -> np.ndarray:
    limits = (0, gain_limit(maps))
    return look.painted(map_colors(
        all_seen(guidance.texels), maps[proposal], limits=limits, colormap=gain_colors()
    ))  # fmt: skip


def gain_colors() -> Colormap:
    """Return the colours of gains, from the grey of nothing."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("gain", GAIN_COLORS)


def _scaled(axes: Axes, drawn: Any, words: str) -> None:
    """Give a map, in the layout of the texture, the scale of the pictures beside it."""
    style.color_bar(axes, drawn, place=(1.03, 0.0, 0.04, 1.0), size=8.5)
    style.caption(axes, words)
    axes.set_anchor("NW")


def _labels(
    order: np.ndarray, gains: np.ndarray, proposals: Sequence[Proposal]
) -> Iterator[tuple[int, float, int, int]]:
    """Yield where a proposal's number stands: place, height, rank, and lines above that height.

    Crowded numbers stand one above the other, over the highest bar among theirs; of more than
    nine, only the first are given.
    """
    rank_of = {proposal.candidate: rank for rank, proposal in enumerate(proposals, 1)}
    last, level, height = -np.inf, 0, 0.0
    for place, (candidate, gain) in enumerate(zip(order, gains, strict=True), 1):
        if int(candidate) not in rank_of:
            continue
        level = level + 1 if place - last < CROWDED * len(order) else 0
        height = height if level else max(float(gain), 0.0)
        if level < LINES:
            yield place, height, rank_of[int(candidate)], level
        last = place


def _large(sensor: Any) -> Any:
    """Return the sensor with a film that pictures need not be smaller than."""
    return resized_sensor(sensor, -(-SIDE // max(film_size(sensor))))


def _worth(proposal: Proposal) -> str:
    error = f" ± {proposal.error:.4f}" if proposal.error > 0 else ""
    new = f", {100 * proposal.new:.0f} % new" if proposal.new >= 0.005 else ""
    gain = f"{proposal.gain:.4f}{error}\n" if np.isfinite(proposal.gain) else ""
    return f"{gain}sees {100 * proposal.sees:.0f} % of the texels{new}"


def _short(name: str) -> str:
    name = plain_name(name)
    return name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}"
