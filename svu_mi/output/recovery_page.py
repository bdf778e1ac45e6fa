"""``recovery.png``: one page that says what was recovered, and how well it explains the views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.look import Look, alone
from svu_mi.capture.shown import srgb
from svu_mi.output import style
from svu_mi.output.figures import (
    all_seen,
    draw_scaled_map,
    map_colors,
    seen_on_object,
    still,
)
from svu_mi.output.page import grouped
from svu_mi.output.relit import SIDE, Comparison
from svu_mi.output.result import is_seen, words
from svu_mi.output.style import GREY, INK, LEFT, OUTSIDE, RIGHT, RULE, VIEWS_COLORMAP
from svu_mi.parameters import NAMES
from svu_mi.pipeline import Estimate
from svu_mi.recovery.field.field import TextureField
from svu_mi.recovery.recover import Recovery

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from svu_mi.output.style import Panel

SIZE = (18.0, 10.2)  # inches
HEADING = "Reflectance recovered from the photographs"
TITLES = tuple(words(name).capitalize() for name in NAMES)
GREYS = "grey: never seen"
WIDEST_SD = 0.3  # at the upper end of the colours; an even prior's is 0.29, that of metals 0.46
SMOOTH = 50  # losses are averaged over this part of the steps


class RecoveryOverview:
    """A page of 1800 x 1020 pixels: textures, what is known of them, losses and comparisons.

    Args:
        capture: the ``Capture``.
        recovery: its ``Recovery``.
        comparisons: of two views, or one.
        estimate: an ``Estimate``, if any, whose entropy is drawn.
    """

    def __init__(
        self, capture: Capture, recovery: Recovery, comparisons: Sequence[Comparison],
        estimate: Estimate | None = None,
    ) -> None:  # fmt: skip
        self._notes, self._losses = _notes(capture, recovery, estimate), np.array(recovery.losses)
        self._objects, scene = [], alone(capture)
        self._maps = _maps(recovery, estimate)
        for comparison, rest in zip(comparisons, (_parameters, _rest), strict=False):
            look = Look.at(scene, capture.sensors[comparison.view], SIDE)
            self._objects.append((comparison, rest(look, recovery, comparison, estimate)))

    def begin(self) -> None:
        """Draw all but how sure textures are."""
        self._figure = figure = style.new_figure(*SIZE)
        style.heading(figure, HEADING, self._notes, (0.962, 0.925))
        plot = figure.add_gridspec(1, 1, left=0.87, right=RIGHT, top=0.875, bottom=0.64)
        rows = figure.add_gridspec(
            2, 6, left=LEFT, right=RIGHT, top=0.545, bottom=0.015, hspace=0.13, wspace=0.1
        )
        style.draw_panels(figure, plot, [("Loss by step", partial(_losses, values=self._losses))])
        self._cells = figure.add_gridspec(
            1, 7, left=LEFT, right=0.83, top=0.875, bottom=0.63, wspace=0.12
        )
        style.draw_panels(figure, [self._cells[k] for k in (0, 1, 2, 6)], self._maps, "NW")
        objects: list[Panel] = []
        for comparison, rest in self._objects:
            objects += [*_compared(comparison), *rest]
        style.draw_panels(figure, rows, objects, "NW")

    def finish(self, deviations: Sequence[Panel], path: str | Path) -> None:
        """Draw ``deviations_of`` textures, and write the PNG file.

        Raises:
            OutputError: the file cannot be written.
        """
        cells = [self._cells[k] for k in (3, 4, 5)]
        style.draw_panels(self._figure, cells, deviations, "NW")
        style.save_figure(self._figure, path)


def write_recovery_overview(
    capture: Capture,
    recovery: Recovery,
    comparisons: Sequence[Comparison],
    path: str | Path,
    estimate: Estimate | None = None,
    field: TextureField | None = None,
) -> None:
    """Draw a ``RecoveryOverview`` at once.

    Args:
        capture: the ``Capture``.
        recovery: its ``Recovery``.
        comparisons: of two views, or one.
        path: the PNG file.
        estimate: an ``Estimate``, if any; its entropy is drawn, and its standard deviations if
            there is no ``field``.
        field: how sure the textures are.

    Raises:
        OutputError: the file cannot be written.
    """
    page = RecoveryOverview(capture, recovery, comparisons, estimate)
    page.begin()
    page.finish(deviations_of(estimate, field), path)


def _notes(capture: Capture, recovery: Recovery, estimate: Estimate | None) -> list[str]:
    width, height = recovery.texels.resolution
    seen = is_seen(recovery)
    return [
        f"method {recovery.method}",
        f"{sum(capture.used)} of {capture.count} views",
        f"{width} × {height} texels, {grouped(len(seen))} in charts",
        f"{100 * seen.sum() / max(len(seen), 1):.0f} % seen",
        *([] if estimate is None else [f"sd and entropy of preset {estimate.preset.name}"]),
        "with sharing" if recovery.settings.get("sharing") else "without sharing",
        f"{len(recovery.losses)} step" + ("s" if len(recovery.losses) != 1 else ""),
    ]


def _maps(recovery: Recovery, estimate: Estimate | None) -> list[Panel]:
    """Return the recovered textures and the entropy, in the layout of the texture."""
    inside, known = recovery.texels.inside(), None if estimate is None else still(estimate)
    color = srgb(np.clip(recovery.image("base_color"), 0, 1))
    values = partial(recovery.textures.at, recovery.texels)
    return [
        (TITLES[0], partial(_texture, image=np.where(inside[..., None], color, OUTSIDE))),
        *((title, partial(_scaled, estimate=all_seen(recovery.texels), values=values(name),
                          colormap=GREY))
          for title, name in zip(TITLES[1:], NAMES[1:], strict=True)),
        ("Entropy", partial(_scaled, estimate=known, label=GREYS)),
    ]  # fmt: skip


def deviations_of(estimate: Estimate | None, field: TextureField | None) -> list[Panel]:
    """Return how sure each of the textures is, in their layout."""
    known = None if estimate is None else still(estimate)
    sd = partial(_deviations, estimate=estimate, field=field)
    return [
        (f"{title}, sd", partial(_uncertainty, estimate=known, sd=sd(name)))
        for title, name in zip(TITLES, NAMES, strict=True)
    ]


def _texture(axes: Axes, image: np.ndarray) -> None:
    axes.imshow(image)
    style.framed(axes)


def _scaled(axes: Axes, estimate: Estimate | None, **options: Any) -> None:
    """Draw a map, narrow as it is, or say that there is none."""
    if estimate is None:
        _empty(axes, "not estimated")
    else:
        draw_scaled_map(axes, estimate, **{"ticks": (0, 0.5, 1), **options})


def _deviations(
    name: str, estimate: Estimate | None, field: TextureField | None
) -> np.ndarray | None:
    """Return the standard deviations of a parameter, (T,) or (T, C), if anybody knows them."""
    if field is not None:
        return field.sd(name)
    if estimate is None or name not in estimate.posterior.axes:
        return None
    return np.asarray(estimate.posterior.sd(name), np.float32)


def _uncertainty(axes: Axes, estimate: Estimate | None, sd: np.ndarray | None) -> None:
    """Draw the standard deviation of a parameter, of base colour that of the worst channel."""
    if estimate is None or sd is None:
        _empty(axes, "not estimated")
        return
    worst = sd.reshape(len(sd), -1).max(axis=1, initial=0)
    _scaled(axes, estimate, values=worst, limits=(0, WIDEST_SD), ticks=(0, 0.1, 0.2), label=GREYS)


def _losses(axes: Axes, values: np.ndarray) -> None:
    losses = values.astype(np.float64)
    if len(losses) < 2:
        _empty(axes, "no descent")
        return
    width = max(len(losses) // SMOOTH, 1)
    mean = np.convolve(losses, np.ones(width) / width, "valid")
    axes.plot(losses, color=RULE, lw=0.8)
    axes.plot(np.arange(len(mean)) + (width - 1) / 2, mean, color=INK, lw=1.6)
    if losses.min() > 0 and losses.max() > 20 * losses.min():
        axes.set_yscale("log")
    style.plain(axes)


def _compared(comparison: Comparison) -> list[Panel]:
    """A photograph, what the textures make of it, and the difference."""
    error = comparison.mean_difference
    titles = (
        f"Photograph {comparison.view}", "Rendered as recovered",
        "Difference" if error is None else f"Difference, mean {error:.3f}",
    )  # fmt: skip
    images = comparison.cropped()
    return [(title, partial(style.draw_image, image=image))
            for title, image in zip(titles, images, strict=False)]  # fmt: skip


def _parameters(
    look: Look, recovery: Recovery, _: Comparison, __: Estimate | None
) -> list[Panel]:
    """The three parameters on the object."""
    color = srgb(np.clip(np.array(recovery.textures.base_color, np.float32), 0, 1))
    on_object = partial(_on_object, look, all_seen(recovery.texels), colormap=GREY)
    return [
        (TITLES[0], _picture(look, color)),
        *((title, on_object(recovery.textures.at(recovery.texels, name)))
          for title, name in zip(TITLES[1:], NAMES[1:], strict=True)),
    ]  # fmt: skip


def _rest(
    look: Look, recovery: Recovery, comparison: Comparison, estimate: Estimate | None
) -> list[Panel]:
    """The other light, and what is known of the object from there."""
    coverage = np.array(recovery.coverage)
    most = max(float(coverage.max(initial=0)), 1.0)
    return [
        ("Under another light", partial(style.draw_image, image=comparison.cropped()[3])),
        ("", lambda axes: axes.set_axis_off()) if estimate is None else
        ("Entropy", _on_object(look, estimate)),
        ("Coverage", _on_object(look, recovery, coverage, limits=(0, most),
                                colormap=VIEWS_COLORMAP)),
    ]  # fmt: skip


def _on_object(
    look: Look, estimate: Any, values: Any | None = None, **options: Any
) -> Callable[[Axes], None]:
    """Return what draws a value of every texel on the object; ``options`` are those of
    ``map_colors``."""
    return _picture(look, map_colors(estimate, values, **options))


def _picture(look: Look, colors: np.ndarray) -> Callable[[Axes], None]:
    """Return what draws screen colours (H, W, 3) on the object, which is traced now."""
    return partial(style.draw_image, image=seen_on_object(look, colors))


def _empty(axes: Axes, text: str) -> None:
    style.framed(axes)
    axes.set_box_aspect(1)
    style.nothing(axes, text)
