"""Everything there is to see on an object's surface, as textures in screen colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from svu_mi.output import views
from svu_mi.output.figures import map_colors
from svu_mi.output.knowledge import WIDEST, Intervals
from svu_mi.output.result import open_axes, words
from svu_mi.output.style import COLORMAP, ENTROPY_ENDS, GREY, UNSEEN, VIEWS_COLORMAP
from svu_mi.pipeline import Estimate
from svu_mi.recovery.textures import Textures
from svu_mi.surface.gutter import dilate


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How numbers become colours.

    Attributes:
        colormap: a name of matplotlib's.
        high: value at the upper end; 0 is at the lower.
        label: what the numbers are.
    """

    colormap: str
    high: float
    label: str


@dataclass(frozen=True, kw_only=True)
class SurfaceMap:
    """A texture to look at.

    Attributes:
        colors: (H, W, 3) float32 screen colours in [0, 1], row 0 at v = 0; charts reach over all
            that is outside, so that no seam shows.
        scale: what the colours stand for; None if they are colours.
    """

    colors: np.ndarray
    scale: Scale | None


def surface_maps(
    estimate: Estimate,
    recovered: Textures | None = None,
    intervals: Intervals | None = None,
) -> dict[str, Callable[[], SurfaceMap]]:
    """Return what can be shown, by name; each is computed when it is called.

    Entropy, coverage, the most probable parameters, how well each is known (half the width of its
    interval, and the entropy of its marginal); and recovered textures. Texels that no view sees are
    grey, but in recovered textures, which have a value everywhere.

    Args:
        estimate: what the photographs say.
        recovered: textures of the same resolution.
        intervals: of the estimate's posterior; computed if not given.

    Raises:
        ShapeError: they are of another one.
    """
    coverage = np.array(estimate.coverage).astype(np.float32)
    most = max(float(coverage.max(initial=0)), 1.0)
    entropy = Scale(colormap=COLORMAP, high=1, label=ENTROPY_ENDS)
    count = Scale(colormap=VIEWS_COLORMAP, high=most, label="views that see the texel")
    maps: dict[str, Callable[[], SurfaceMap]] = {
        "entropy": partial(_numbers, estimate, lambda: estimate.entropy, entropy),
        "coverage": partial(_numbers, estimate, lambda: coverage, count),
    }
    unknown = open_axes(estimate)
    for name in unknown:
        # Not in greys: these are for what nobody sees.
        best = Scale(colormap=VIEWS_COLORMAP, high=1, label=words(name))
        maps[f"most probable {words(name)}"] = partial(_best, estimate, name, best)
    intervals = intervals or Intervals(estimate.posterior)
    for name in unknown:
        label = f"half the width of the {100 * intervals.level:g} % interval"
        scale = Scale(colormap=COLORMAP, high=WIDEST, label=label)
        width = partial(intervals.half_width, name)
        maps[f"uncertainty of {words(name)}"] = partial(_numbers, estimate, width, scale)
    for name in unknown:
        marginal = partial(estimate.posterior.marginal_entropy, name)
        maps[f"entropy of {words(name)}"] = partial(_numbers, estimate, marginal, entropy)
    if recovered is not None:
        recovered.require_resolution(estimate.texels)
        for name, tensor in recovered.items():
            maps[f"recovered {words(name)}"] = partial(_recovered, name, tensor)
    return maps


def _best(estimate: Estimate, name: str, scale: Scale) -> SurfaceMap:
    values = np.array(estimate.posterior.map()[name])
    if values.ndim == 1:
        return _numbers(estimate, lambda: values, scale)
    colors = views.srgb(values)  # R, G and B
    colors[np.array(estimate.coverage) == 0] = UNSEEN
    image = dilate(estimate.texels.to_image(colors), estimate.texels.inside(), np.inf)
    return SurfaceMap(colors=image, scale=None)


def _numbers(estimate: Estimate, values: Callable[[], Any], scale: Scale) -> SurfaceMap:
    """One number per texel; of one per colour channel, the mean."""
    numbers = np.array(values(), np.float64)
    numbers = numbers.reshape(len(numbers), -1).mean(axis=1)
    limits = (0, scale.high)
    colors = map_colors(estimate, numbers, limits=limits, colormap=scale.colormap, gutter=np.inf)
    return SurfaceMap(colors=colors, scale=scale)


def _recovered(name: str, tensor: Any) -> SurfaceMap:
    image = np.clip(np.array(tensor, np.float32), 0, 1)
    if name == "base_color":
        return SurfaceMap(colors=views.srgb(image), scale=None)
    scale = Scale(colormap=GREY, high=1, label=words(name))
    return SurfaceMap(colors=np.repeat(image, 3, axis=2), scale=scale)
