"""Maps on the object's surface: values, colour scales, descriptions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from svu_mi.capture.tonemap import srgb
from svu_mi.errors import counted
from svu_mi.output import style
from svu_mi.output.estimate_arrays import coverages, entropies, label_of, open_axes
from svu_mi.output.interval_summary import TOLERANCE, WIDEST, Intervals, has_estimated_light
from svu_mi.output.panels import GUTTER, albedo_colors, map_colors
from svu_mi.output.style import COLORMAP, ENTROPY_ENDS, UNSEEN, VALUES_COLORMAP, VIEWS_COLORMAP
from svu_mi.parameters import PARAMETERS
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.intervals import LEVEL
from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.recovery.uncertainty.texture_field import INTERVAL_MASS, TextureField

ENDS = {"specular": ("0: no reflection", "1: mirror")}  # Ks of a ``ParameterGrid``
ENDS |= {p.name: p.end_labels for p in PARAMETERS.values()}


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Colour scale of numbers from 0 to ``high``, with labels of both ends."""

    colormap: str = COLORMAP
    high: float = 1
    label: str
    ends: tuple[str, str]


ENTROPY = Scale(label=ENTROPY_ENDS, ends=("certain", "no information"))


@dataclass(frozen=True, kw_only=True)
class SurfaceMap:
    """Map with a value for every texel.

    Attributes:
        name: Name of the map.
        sentence: Description for pages.
        estimate: Estimate with texels and coverage; None if the values are a texture.
        values: Function that returns the values. With a scale: numbers (T,), or (T, 3), whose
            channels are averaged. Without one: linear colours (T, 3). Textures are (H, W, C).
        scale: Colour scale; None if the values are colours.
    """

    name: str
    sentence: str
    estimate: Estimate | None
    values: Callable[[], Any]
    scale: Scale | None

    def colors(self, gutter: float = GUTTER, unseen: Any = UNSEEN) -> np.ndarray:
        """Return screen colours (H, W, 3), float32 in [0, 1]; row 0 is v = 0.

        Args:
            gutter: Dilation of the charts in texels.
            unseen: Colour (3,) or image (H, W, 3) that marks unseen texels of colour maps, where
                grey may be a value.
        """
        values = np.array(self.values(), np.float32)
        if self.estimate is None:
            image = np.clip(values, 0, 1)
            if self.scale is None:
                return srgb(image)
            return style.colors(image[..., 0], (0, self.scale.high), self.scale.colormap)
        if self.scale is None:
            return albedo_colors(self.estimate, values, gutter=gutter, unseen=unseen)
        return map_colors(
            self.estimate, values.reshape(len(values), -1).mean(axis=1, dtype=np.float64),
            limits=(0, self.scale.high), colormap=self.scale.colormap, gutter=gutter,
        )  # fmt: skip


def surface_maps(
    estimate: Estimate,
    recovered: Textures | None = None,
    intervals: Intervals | None = None,
    field: TextureField | None = None,
) -> dict[str, SurfaceMap]:
    """Return all maps by name; colours are computed on request.

    Maps of entropy, coverage, most probable parameters, interval half-widths, marginal entropies,
    and recovered textures (of the same resolution) with their uncertainty.
    """
    intervals = intervals or Intervals(estimate.posterior)
    unknown = open_axes(estimate)
    maps = entropy_maps(estimate)
    maps += [most_probable(estimate, name) for name in unknown]
    maps += [uncertainty(estimate, name, intervals) for name in unknown]
    maps += [
        SurfaceMap(
            name=f"entropy of {label_of(name)}", estimate=estimate,
            values=partial(estimate.posterior.marginal_entropy, name), scale=ENTROPY,
            sentence=f"Entropy of {label_of(name)} alone, relative to its prior.",
        )
        for name in unknown
    ]  # fmt: skip
    if recovered is not None:
        recovered.require_resolution(estimate.texels)
        maps += recovered_maps(recovered)
    maps += [] if field is None else field_maps(field, estimate)
    return {one.name: one for one in maps}


def entropy_maps(estimate: Estimate) -> list[SurfaceMap]:
    """Return the maps of entropy and coverage."""
    counts = coverages(estimate)
    most = max(int(counts.max(initial=0)), 1)
    return [
        SurfaceMap(
            name="entropy", estimate=estimate, values=lambda: entropies(estimate), scale=ENTROPY,
            sentence="Joint entropy of all parameters, relative to the prior.",
        ),
        SurfaceMap(
            name="coverage", estimate=estimate, values=lambda: counts,
            scale=Scale(
                colormap=VIEWS_COLORMAP, high=most, label="views that see the texel",
                ends=("no photograph", counted(most, "photograph")),
            ),
            sentence="Number of photographs that see each point. Many photographs do not imply low "
            "entropy.",
        ),
    ]  # fmt: skip


def most_probable(estimate: Estimate, name: str) -> SurfaceMap:
    """Return the map of a parameter's most probable value."""
    scale: Scale | None = Scale(colormap=VALUES_COLORMAP, label=label_of(name), ends=ENDS[name])
    sentence = "Value that explains the photographs best."
    if name == "base_color" and estimate.posterior.channels == 3:
        scale = None
        sentence = "Colour that explains the photographs best; chequered where unseen."
    elif name == "base_color":
        sentence = "Brightness that explains the photographs best."
    return SurfaceMap(
        name=f"most probable {label_of(name)}", sentence=sentence, estimate=estimate,
        values=lambda: estimate.posterior.map()[name], scale=scale,
    )  # fmt: skip


def uncertainty(estimate: Estimate, name: str, intervals: Intervals) -> SurfaceMap:
    """Return the map of a parameter's interval half-width."""
    half = f"half the width of the {100 * LEVEL:g} % interval"
    is_found = has_estimated_light(estimate)
    meaning = f"Points count as determined up to ±{TOLERANCE:g}, the darkest sixth of the colours."
    several = name == "base_color" and estimate.posterior.channels == 3
    widest = ", of the widest channel" if several else ""
    return SurfaceMap(
        name=f"uncertainty of {label_of(name)}", estimate=estimate,
        values=lambda: intervals.half_width(name),
        scale=Scale(high=WIDEST, label=half, ends=("±0", f"±{WIDEST:g} and more")),
        sentence=f"Half-width of the {100 * LEVEL:g} % interval{widest}. "
        + ("It may be too small, as the light was estimated." if is_found else meaning),
    )  # fmt: skip


def recovered_maps(textures: Textures) -> list[SurfaceMap]:
    """Return the maps of recovered textures."""
    return [
        SurfaceMap(
            name=f"recovered {label_of(name)}", estimate=None, values=partial(np.array, tensor),
            scale=None if name == "base_color" else
            Scale(colormap=VALUES_COLORMAP, label=label_of(name), ends=ENDS[name]),
            sentence="Recovered texture; values of unseen points are interpolated.",
        )
        for name, tensor in textures.items()
    ]  # fmt: skip


def field_maps(field: TextureField, estimate: Estimate) -> list[SurfaceMap]:
    """Return maps of the interval half-widths of recovered textures."""

    def half_width(name: str) -> np.ndarray:
        low, high = field.interval(name, INTERVAL_MASS)
        return np.asarray((high - low).reshape(len(low), -1).max(axis=1) / 2)

    label = f"half the width of the {100 * INTERVAL_MASS:g} % interval"
    return [
        SurfaceMap(
            name=f"uncertainty of recovered {label_of(name)}", estimate=estimate,
            values=partial(half_width, name),
            scale=Scale(high=WIDEST, label=label, ends=("±0", f"±{WIDEST:g} and more")),
            sentence="Half-width of the recovered texture's interval. It is smaller than for a "
            "single point where neighbours agree, and larger next to other materials.",
        )
        for name in field.names
    ]  # fmt: skip
