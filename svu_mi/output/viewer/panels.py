"""What the viewer's panel shows: a texel's posterior, in words and pictures, and colour bars."""

from __future__ import annotations

from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.output import style
from svu_mi.output.figures import draw_marginal
from svu_mi.output.result import open_axes, words
from svu_mi.output.style import MARK, new_figure
from svu_mi.output.surface_maps import Scale
from svu_mi.output.viewer.picking import Pick
from svu_mi.pipeline import Estimate
from svu_mi.recovery.textures import Textures

WIDTH, DPI = 3.6, 160  # inches
NO_BREAK, DASH = "\u00a0", "\u2060–\u2060"  # a space and a dash at which no line breaks
NAMED = 4  # cameras that are named; the others are counted


def says(capture: Capture, pick: Pick) -> str:
    """Return what is known of a texel, as Markdown."""
    lines = [f"**Texel {pick.column}, {pick.row}** (column, row), number {pick.texel}", ""]
    lines += [f"* entropy **{pick.entropy:.3f}**", f"* {_seen_by(capture, pick)}"]
    if not pick.beliefs:
        return "\n".join([*lines, "* nothing is known"])
    return "\n".join([*lines, "", *_table(pick)])


def _table(pick: Pick) -> list[str]:
    """Mean, interval and most probable value of each parameter, as lines of a Markdown table."""
    lines = [f"| | mean | {100 * pick.level:g} % interval | most probable |", "|-|-|-|-|"]
    for name, of in pick.beliefs.items():
        channels = (" R", " G", " B") if len(of.mean) == 3 else ("",)
        for channel, best, mean, low, high in zip(
            channels, of.best, of.mean, of.low, of.high, strict=True
        ):
            label = f"{words(name)}{channel}".replace(" ", NO_BREAK)
            lines.append(f"| {label} | **{mean:.2f}** | {low:.2f}{DASH}{high:.2f} | {best:.2f} |")
    return lines


def _seen_by(capture: Capture, pick: Pick) -> str:
    count = len(pick.seen_by)
    if not count:
        return f"seen by none of {sum(capture.used)} views"
    names = [capture.names[view] for view in pick.seen_by[:NAMED]]
    more = [f"and {count - NAMED} more"] if count > NAMED else []
    return f"seen by **{count}** of {sum(capture.used)} views: {', '.join([*names, *more])}"


def draw_pick(estimate: Estimate, pick: Pick, recovered: Textures | None = None) -> np.ndarray:
    """Draw the marginals of a texel, one below the other, and mark its recovered values.

    Returns:
        (h, w, 3) uint8.
    """
    names = list(open_axes(estimate))
    figure = new_figure(WIDTH, 1.25 * len(names), DPI, layout="constrained")
    for row, name in enumerate(names, 1):
        axes = figure.add_subplot(len(names), 1, row)
        draw_marginal(axes, estimate.posterior, pick.texel, name)
        axes.tick_params(labelsize=8)
        axes.xaxis.label.set_size(9)
        value = None if recovered is None else getattr(recovered, name, None)
        if value is not None:
            # Of a colour the mean, as of the marginals.
            axes.axvline(np.array(value)[pick.row, pick.column].mean(), color=MARK, lw=2)
            axes.plot([], [], color=MARK, lw=2, label="recovered")
            style.legend(axes, 8, handlelength=1)
    return _pixels(figure)


def draw_scale(scale: Scale | None) -> np.ndarray:
    """Draw a colour bar, (h, w, 3) uint8; one white pixel without a scale."""
    if scale is None:
        return np.full((1, 1, 3), 255, np.uint8)
    figure = new_figure(WIDTH, 0.55, DPI, layout="constrained")
    drawn = style.scale((0, scale.high), scale.colormap)
    style.color_bar(figure.add_subplot(), drawn, scale.label, None)
    return _pixels(figure)


def _pixels(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba())[..., :3]
