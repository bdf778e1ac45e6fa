"""Picking of texels with rays, and their posteriors as text and plots."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.tonemap import object_only_scene
from svu_mi.core.arrays import to_drjit
from svu_mi.core.identifiers import markdown_text
from svu_mi.errors import OptionError, first_of
from svu_mi.geometry.dilate import dilate
from svu_mi.geometry.texels import Texels
from svu_mi.output import style
from svu_mi.output.estimate_arrays import column_and_row, label_of, open_axes
from svu_mi.output.interval_summary import interval_of
from svu_mi.output.panels import draw_marginal
from svu_mi.output.style import MARK, new_figure
from svu_mi.output.surface_maps import Scale
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.intervals import LEVEL
from svu_mi.recovery.svbrdf_textures import Textures

WIDTH, DPI = 3.6, 160  # inches
NO_BREAK, DASH = "\u00a0", "\u2060–\u2060"  # space and dash without line break
NAMED = 4  # largest number of cameras listed by name


@dataclass(frozen=True, kw_only=True)
class Pick:
    """Texel and its posterior.

    Attributes:
        texel: Index, 0 to T - 1.
        column: Column in the texture.
        row: Row in the texture; row 0 is v = 0.
        position: (3,) float64, centre in world space.
        entropy: Normalised entropy, in [0, 1].
        seen_by: Indices of the sensors that see the texel.
        summaries: Most probable value, mean, and both ends of the interval by parameter, with one
            or three channels; empty if the texel is unseen.
    """

    texel: int
    column: int
    row: int
    position: np.ndarray
    entropy: float
    seen_by: tuple[int, ...]
    summaries: dict[str, tuple[np.ndarray, ...]]


class Picker:
    """Finds texels by rays; only the object can be hit, no other shape."""

    def __init__(self, capture: Capture, estimate: Estimate) -> None:
        self._capture, self._estimate = capture, estimate
        self._nearest = nearest_texel(estimate.texels)
        self._scene = object_only_scene(capture)

    def pick(self, origin: Any, direction: Any) -> Pick | None:
        """Return the first texel that a ray hits; None if it misses the object.

        In charts too narrow for a texel centre, returns the nearest texel in the texture.
        """
        # Arrays: Dr.Jit would compile literal numbers into a new kernel for every ray.
        start, towards = (np.array(v, np.float32)[:, None] for v in (origin, direction))
        ray = mi.Ray3f(to_drjit(mi.Point3f, start), dr.normalize(to_drjit(mi.Vector3f, towards)))
        hit = self._scene.ray_intersect(ray)
        valid, uv = np.array(hit.is_valid()), np.array(hit.uv, np.float64)
        if not valid.all():
            return None
        size = np.array(self._estimate.texels.resolution)
        column, row = np.clip((uv.ravel() * size).astype(int), 0, size - 1)
        return self.describe(int(self._nearest[row, column]))

    def describe(self, texel: int) -> Pick:
        """Return a texel and its posterior.

        Raises:
            OptionError: ``texel`` is out of range.
        """
        texels = self._estimate.texels
        if not 0 <= texel < texels.count:
            raise OptionError(f"texel must be 0 to {texels.count - 1}, got {texel}.")
        column, row = column_and_row(self._estimate, texel)
        seen_by = self._seen_by(texel)
        return Pick(
            texel=texel, column=column, row=row,
            position=np.array(texels.position, np.float64)[:, texel],
            entropy=float(np.array(self._estimate.entropy)[texel]),
            seen_by=seen_by, summaries=self._summaries(texel) if seen_by else {},
        )  # fmt: skip

    def _summaries(self, texel: int) -> dict[str, tuple[np.ndarray, ...]]:
        posterior, summaries = self._estimate.posterior, {}
        best = posterior.map([texel])
        for name in posterior.axes:
            values = np.array(best[name])[0], np.array(posterior.mean(name))[texel]
            ends = interval_of(posterior, name, texel)
            summaries[name] = (*map(np.atleast_1d, values), *ends)
        return summaries

    def _seen_by(self, texel: int) -> tuple[int, ...]:
        observed = self._estimate.observed
        if observed is None:
            raise OptionError("The estimate has no views; use the result of svu.estimate().")
        used = np.flatnonzero(self._capture.used)
        view = dr.arange(mi.UInt32, len(used))
        seen = observed.visibility.bits.test(view, to_drjit(mi.UInt32, np.full(len(used), texel)))
        return tuple(used[np.array(seen)].tolist())


def nearest_texel(texels: Texels) -> np.ndarray:
    """Return the index of the nearest texel in the texture for every pixel, (H, W) int64."""
    width, height = texels.resolution
    numbers = texels.to_image(np.arange(texels.count), -1)
    return dilate(numbers, texels.inside(), float(np.hypot(width, height)))


def texel_markdown(capture: Capture, pick: Pick) -> str:
    """Return the posterior of a texel as Markdown."""
    lines = [f"**Texel {pick.column}, {pick.row}** (column, row), number {pick.texel}", ""]
    lines += [f"* entropy **{pick.entropy:.3f}**", f"* {_seen_by(capture, pick)}"]
    if not pick.summaries:
        return "\n".join([*lines, "* no information: the posterior is the prior"])
    return "\n".join([*lines, "", *_table(pick)])


def _table(pick: Pick) -> list[str]:
    """Return mean, interval and most probable value of each parameter as a Markdown table."""
    lines = [f"| | mean | {100 * LEVEL:g} % interval | most probable |", "|-|-|-|-|"]
    for name, values in pick.summaries.items():
        channels = (" R", " G", " B") if len(values[0]) == 3 else ("",)
        for channel, best, mean, low, high in zip(channels, *values, strict=True):
            label = f"{label_of(name)}{channel}".replace(" ", NO_BREAK)
            lines.append(f"| {label} | **{mean:.2f}** | {low:.2f}{DASH}{high:.2f} | {best:.2f} |")
    return lines


def _seen_by(capture: Capture, pick: Pick) -> str:
    count = len(pick.seen_by)
    if not count:
        return f"not seen by any of {sum(capture.used)} views"
    names = first_of([markdown_text(capture.names[view]) for view in pick.seen_by], NAMED)
    return f"seen by **{count}** of {sum(capture.used)} views: {names}"


def draw_pick(estimate: Estimate, pick: Pick, recovered: Textures | None = None) -> np.ndarray:
    """Draw the marginals of a texel below each other, and mark its recovered values.

    Returns:
        (h, w, 3) uint8 image.
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
            # Mean over channels, as in the marginals.
            axes.axvline(np.array(value)[pick.row, pick.column].mean(), color=MARK, lw=2)
            axes.plot([], [], color=MARK, lw=2, label="recovered")
            style.legend(axes, 8, handlelength=1)
    return _pixels(figure)


def draw_scale(scale: Scale | None) -> np.ndarray:
    """Draw a colour bar, (h, w, 3) uint8; one white pixel if ``scale`` is None."""
    if scale is None:
        return np.full((1, 1, 3), 255, np.uint8)
    figure = new_figure(WIDTH, 0.55, DPI, layout="constrained")
    drawn = style.scalar_mappable((0, scale.high), scale.colormap)
    style.color_bar(figure.add_subplot(), drawn, scale.label, None)
    return _pixels(figure)


def _pixels(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba())[..., :3]
