"""``guidance.png``: page with the proposed photographs and their information gain."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.sensors import film_size, resized_sensor
from svu_mi.capture.tonemap import SIDE, ObjectView, object_only_scene
from svu_mi.core.identifiers import plain_name
from svu_mi.errors import counted
from svu_mi.guidance.guidance_result import Guidance, Proposal
from svu_mi.guidance.strategies import TABLE
from svu_mi.output import style
from svu_mi.output.direction_map import draw_directions, draw_numbered
from svu_mi.output.html import grouped
from svu_mi.output.panels import draw_look, draw_map, fully_seen, map_colors
from svu_mi.output.style import INK, LEFT, MARK, RIGHT, RULE, UNSEEN, Block, Panel
from svu_mi.posterior.estimate import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

SIZE = (18.0, 11.2)  # inches
HEADING = "Proposed views for the next photographs"
# Direction map, expected entropy, ranking: left, right, bottom, top as fractions of the page.
PLACES = ((LEFT, 0.473, 0.5, 0.85), (0.535, 0.73, 0.535, 0.86), (0.79, RIGHT, 0.535, 0.86))
SHOWN = 5  # proposals drawn on the object
WHITE = 0.99  # quantile of the positive gains at the upper end of the colours


def proposal_views(capture: Capture, guidance: Guidance) -> list[ObjectView]:
    """Return the view of the object from each proposed camera."""
    scene, sensors = object_only_scene(capture), [one.sensor for one in guidance.proposals]
    enlarged = (resized_sensor(s, -(-SIDE // max(film_size(s)))) for s in sensors)
    return [ObjectView.at(scene, sensor) for sensor in enlarged]


def file_names(capture: Capture, guidance: Guidance) -> list[str]:
    """Return file names for the photographs of the proposals.

    Sensors of the capture keep the names of their files; other names continue their numbers.
    """
    names, free = [], capture.count
    for proposal in guidance.proposals:
        own = [k for k, sensor in enumerate(capture.sensors) if sensor is proposal.sensor]
        if own:
            names.append((capture.files or capture.names)[own[0]])
        else:
            names.append(f"view_{free:04d}.exr")
            free += 1
    return names


def write_guidance_overview(
    capture: Capture, estimate: Estimate, guidance: Guidance, maps: np.ndarray,
    looks: Sequence[ObjectView], path: str | Path, up: tuple[float, float, float] | None = None,
) -> None:  # fmt: skip
    """Draw directions, ranking and the proposed views (1800 x 1120 pixels).

    ``maps`` is ``Guidance.gain_maps()``, ``looks`` is ``proposal_views()``; ``up`` is the top of
    the direction map.
    """
    entropy, shown = map_colors(estimate), guidance.proposals[:SHOWN]
    names = [_short_name(Path(name).stem) for name in file_names(capture, guidance)]
    everywhere, empty = fully_seen(guidance.texels), np.zeros(guidance.texels.count, np.float32)
    scale: Any = {
        "limits": (0, information_gain_limit(maps)),
        "colormap": information_gain_colors(),
    }
    first = maps[0] if len(maps) else empty
    sights: list[Panel | None] = [
        ("", partial(_draw_view, look=look, colors=entropy, words=name, rank=rank,
                     row="entropy so far" if rank == 1 else ""))
        for rank, (look, name) in enumerate(zip(looks, names[:SHOWN], strict=False), 1)
    ]  # fmt: skip
    sights.append(("", partial(_draw_texture, estimate=estimate, words="entropy, texture space")))
    sights += [
        ("", partial(_draw_view, look=look, colors=map_colors(everywhere, gains, **scale),
                     words=_caption(one, guidance.entropy), row="expected gain" if k == 0 else ""))
        for k, (look, gains, one) in enumerate(zip(looks, maps, shown, strict=False))
    ]  # fmt: skip
    gained = partial(_draw_texture, estimate=everywhere, values=first, **scale)
    sights.append(("", partial(gained, words="gain of proposal 1")))
    plots: list[Panel] = [
        ("", partial(_directions, capture=capture, guidance=guidance, up=up)),
        ("Mean entropy of all texels: present and expected",
         partial(draw_expected, capture=capture, guidance=guidance)),
        ("Gain of all candidates", partial(draw_ranking, guidance=guidance)),
    ]  # fmt: skip
    blocks = [Block(panels=[plot], box=box) for plot, box in zip(plots, PLACES, strict=True)]
    blocks.append(Block(
        panels=sights, shape=(2, len(shown) + 1), box=(LEFT + 0.012, 0.955, 0.01, 0.41),
        space=(0.1, 0.2), anchor="N",
    ))  # fmt: skip
    style.write_page(path, SIZE, HEADING, _notes(capture, estimate, guidance), blocks)


def _draw_view(
    axes: "Axes", look: ObjectView, colors: np.ndarray, words: str, rank: int = 0, row: str = ""
) -> None:
    """Draw the view of a proposed camera, cropped to the object."""
    draw_look(axes, look, colors)
    style.caption(axes, words)
    if row:
        axes.text(-0.03, 0.5, row, transform=axes.transAxes, rotation=90, size=11, color=INK,
                  ha="right", va="center")  # fmt: skip
    if rank:
        draw_numbered(axes, 0.06, 0.93, rank, "white", 260, transform=axes.transAxes)


def _draw_texture(axes: "Axes", estimate: Any, words: str, **options: Any) -> None:
    """Draw a map in texture space, with a colour bar to its right."""
    drawn = draw_map(axes, estimate, **options)
    style.color_bar(axes, drawn, place=(1.03, 0.0, 0.04, 1.0), size=8.5)
    style.caption(axes, words)


def _notes(capture: Capture, estimate: Estimate, guidance: Guidance) -> list[str]:
    width, height = guidance.texels.resolution
    options, reachable = guidance.options, int(guidance.candidates.reachable.sum())
    looked_at = min(options.texels, guidance.texels.count)
    return [
        f"method {guidance.method}",
        f"preset {estimate.preset.name}",
        f"strategy {options.strategy}",
        counted(sum(capture.used), "photograph"),
        f"{reachable} of {guidance.candidates.count} candidates reachable",
        f"{width} × {height} texels, {grouped(looked_at)} of "
        f"{grouped(guidance.texels.count)} evaluated",
    ]


def _directions(
    axes: "Axes", capture: Capture, guidance: Guidance, up: tuple[float, float, float] | None
) -> None:
    factor, unit = score_unit(guidance)
    colors = draw_directions(axes, capture, guidance, up=up, factor=factor)
    style.title(axes, "Directions of photographs and candidates", pad=34)
    style.color_bar(axes, colors, f"as the next photograph: {unit}", (0.2, -0.06, 0.6, 0.028))


def draw_expected(axes: "Axes", capture: Capture, guidance: Guidance) -> None:
    """Draw the mean entropy against the number of photographs: present and expected.

    Strategies without a forecast show the present value only.
    """
    from matplotlib.ticker import MaxNLocator

    first = sum(capture.used)
    values = np.array([guidance.entropy, *(one.entropy for one in guidance.proposals)])
    values = values[np.isfinite(values)]
    axes.plot(np.arange(len(values)) + first, values, "-", color=INK, lw=1.6, zorder=1)
    axes.scatter([first], values[:1], 42, c=INK, zorder=2,
                 label=f"present: {guidance.entropy:.3f}")  # fmt: skip
    for rank, value in enumerate(values[1:], 1):
        draw_numbered(axes, first + rank, value, rank, "white", 210)
    room = max(0.12 * float(np.ptp(values)), 0.01)
    axes.set(xlim=(first - 0.5, first + len(values) - 0.5))
    axes.set(ylim=(max(float(values.min()) - room, -0.02), float(values.max()) + 2.2 * room))
    style.legend(axes, loc="upper right", borderaxespad=0.2, handletextpad=0.2)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True))
    growing = guidance.options.band_limit == "growing"
    light = "; light filtered for that number" if growing else ""
    style.labels(axes, f"photographs{light}", "mean entropy", 9.5)
    style.minimal_axes(axes)


def draw_ranking(axes: "Axes", guidance: Guidance) -> None:
    """Draw the scores of all reachable candidates, best first."""
    from matplotlib.ticker import MaxNLocator

    order, (factor, unit) = guidance.ranking, score_unit(guidance)
    scores = factor * guidance.scores[order]
    proposed = np.isin(order, [one.candidate for one in guidance.proposals])
    places, width = np.arange(1, len(order) + 1), 1 if len(order) > 60 else 0.9
    for chosen, color, label in ((proposed, MARK, "proposals"), (~proposed, UNSEEN, "others")):
        axes.bar(places[chosen], scores[chosen], width=width, color=color, label=label)
    axes.set(xlim=(0.25, len(order) + 0.75), ylim=(min(scores.min(), 0), None))
    axes.axhline(0, color=RULE, lw=1)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    style.legend(axes, loc="upper right")
    style.labels(axes, "candidates, best first", unit, 9.5)
    style.minimal_axes(axes)


def score_unit(guidance: Guidance) -> tuple[float, str]:
    """Return the factor and the unit in which scores are drawn; percent if they are relative."""
    strategy = guidance.options.strategy
    if strategy == "entropy":
        return 100 / max(guidance.entropy, 1e-9), "decrease of the mean entropy, %"
    if strategy == "error":
        return 100.0, "decrease of the mean squared error, %"
    return 1.0, TABLE[strategy].unit


def information_gain_limit(maps: np.ndarray) -> float:
    """Return the information gain at the upper end of the colour scale."""
    positive = maps[maps > 0]
    return max(float(np.quantile(positive, WHITE)), 1e-6) if len(positive) else 1.0


def information_gain_pictures(
    looks: Sequence[ObjectView], guidance: Guidance, maps: np.ndarray
) -> list[np.ndarray]:
    """Render information gains (proposals, T) from proposed cameras, (h, w, 4); grey where 0.

    ``looks`` is ``proposal_views()``, and ``maps`` is ``Guidance.gain_maps()``.
    """
    everywhere, scale = fully_seen(guidance.texels), information_gain_colors()
    limits = (0, information_gain_limit(maps))
    return [
        look.painted(map_colors(everywhere, gains, limits=limits, colormap=scale))
        for look, gains in zip(looks, maps, strict=True)
    ]


def information_gain_colors() -> "Colormap":
    """Return the colormap of information gains; 0 is grey."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("gain", style.INFORMATION_GAIN_COLORS)


def _caption(proposal: Proposal, entropy: float) -> str:
    percent = 100 / max(entropy, 1e-9)
    error = f" ± {percent * proposal.error:.1f}" if proposal.error > 0 else ""
    new = f", {100 * proposal.new:.0f} % new" if proposal.new >= 0.005 else ""
    gain = ""
    if np.isfinite(proposal.gain):
        gain = f"lowers mean entropy by {percent * proposal.gain:.1f}{error} %\n"
    return f"{gain}sees {100 * proposal.sees:.0f} % of the texels{new}"


def _short_name(name: str) -> str:
    name = plain_name(name)
    return name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}"
