"""Maps on an object's surface: values, their colours and descriptions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from svu_mi.capture.tonemap import srgb
from svu_mi.output import style
from svu_mi.output.estimate_arrays import EstimateArrays, label_of, open_axes
from svu_mi.output.interval_summary import TOLERANCE, WIDEST, Intervals
from svu_mi.output.panels import GUTTER, albedo_colors, map_colors
from svu_mi.output.style import COLORMAP, ENTROPY_ENDS, UNSEEN, VALUES_COLORMAP, VIEWS_COLORMAP
from svu_mi.parameters import PARAMETERS
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.recovery.uncertainty.texture_field import INTERVAL_MASS, TextureField

ENDS = {"specular": ("0: no gloss", "1: mirror of all light")}  # Ks of a ``ParameterGrid``
ENDS |= {p.name: p.end_labels for p in PARAMETERS.values()}


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Colours of numbers from 0 to ``high``, and words for both ends."""

    colormap: str = COLORMAP
    high: float = 1
    label: str
    ends: tuple[str, str]


ENTROPY = Scale(label=ENTROPY_ENDS, ends=("one material left", "nothing known"))


@dataclass(frozen=True, kw_only=True)
class SurfaceMap:
    """A value of every texel.

    Attributes:
        name: what it is.
        sentence: what it means.
        estimate: which texels there are and which are seen; None if the values are a texture.
        values: returns numbers (T,), or (T, 3), whose mean counts; without a scale linear colours
            (T, 3). Of a texture (H, W, 1) or (H, W, 3).
        scale: how numbers become colours; None if they are colours.
    """

    name: str
    sentence: str
    estimate: Estimate | None
    values: Callable[[], Any]
    scale: Scale | None

    def colors(self, gutter: float = GUTTER, unseen: Any = UNSEEN) -> np.ndarray:
        """Return screen colours (H, W, 3), float32 in [0, 1]; row 0 is v = 0.

        Args:
            gutter: texels that charts grow by.
            unseen: what texels that no view sees look like where there is no scale, which tells
                grey from its colours: one colour, or a picture (H, W, 3).
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
    """Return all maps by name; their colours are computed on request.

    Entropy, coverage, the most probable parameters, half the width of their intervals, and the
    entropy of their marginals; and recovered textures, of the same resolution.
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
            sentence=f"What the photographs leave open of {label_of(name)}.",
        )
        for name in unknown
    ]  # fmt: skip
    if recovered is not None:
        recovered.require_resolution(estimate.texels)
        maps += recovered_maps(recovered)
    maps += [] if field is None else field_maps(field, estimate)
    return {one.name: one for one in maps}


def entropy_maps(estimate: Estimate) -> list[SurfaceMap]:
    """Return maps of the entropy and of the coverage."""
    result = EstimateArrays.of(estimate)
    most = result.max_views
    return [
        SurfaceMap(
            name="entropy", estimate=estimate, values=lambda: result.entropy, scale=ENTROPY,
            sentence="What the photographs leave open of all parameters together.",
        ),
        SurfaceMap(
            name="coverage", estimate=estimate, values=lambda: result.coverage,
            scale=Scale(
                colormap=VIEWS_COLORMAP, high=most, label="views that see the texel",
                ends=("no photograph", f"{most} photographs"),
            ),
            sentence="How many photographs see each point; being seen often does not make it "
            "known.",
        ),
    ]  # fmt: skip


def most_probable(estimate: Estimate, name: str) -> SurfaceMap:
    """Return the map of a parameter of the most probable material."""
    scale: Scale | None = Scale(colormap=VALUES_COLORMAP, label=label_of(name), ends=ENDS[name])
    sentence = "Of the material that explains the photographs best."
    if name == "base_color" and estimate.posterior.channels == 3:
        scale = None
        sentence = "The colour that explains the photographs best; chequered where unseen."
    elif name == "base_color":
        sentence = "Brightness of the material that explains the photographs best."
    return SurfaceMap(
        name=f"most probable {label_of(name)}", sentence=sentence, estimate=estimate,
        values=lambda: estimate.posterior.map()[name], scale=scale,
    )  # fmt: skip


def uncertainty(estimate: Estimate, name: str, intervals: Intervals) -> SurfaceMap:
    """Return the map of half the width of a parameter's interval."""
    half = f"half the width of the {100 * intervals.mass:g} % interval"
    several = name == "base_color" and estimate.posterior.channels == 3
    widest = "; of the three channels, the least known" if several else ""
    return SurfaceMap(
        name=f"uncertainty of {label_of(name)}", estimate=estimate,
        values=lambda: intervals.half_width(name),
        scale=Scale(high=WIDEST, label=half, ends=("±0", f"±{WIDEST:g} and more")),
        sentence=f"Half the width of its {100 * intervals.mass:g} % interval{widest}. Settled is "
        f"±{TOLERANCE:g}, the darkest sixth of these colours.",
    )  # fmt: skip


def recovered_maps(textures: Textures) -> list[SurfaceMap]:
    """Return recovered textures as maps."""
    return [
        SurfaceMap(
            name=f"recovered {label_of(name)}", estimate=None, values=partial(np.array, tensor),
            scale=None if name == "base_color" else
            Scale(colormap=VALUES_COLORMAP, label=label_of(name), ends=ENDS[name]),
            sentence="The recovered texture, also where nothing was seen.",
        )
        for name, tensor in textures.items()
    ]  # fmt: skip


def field_maps(field: TextureField, estimate: Estimate) -> list[SurfaceMap]:
    """Return maps of how sure recovered textures are: half the widths of their intervals."""

    def half_width(name: str) -> np.ndarray:
        low, high = field.interval(name, INTERVAL_MASS)
        return np.asarray((high - low).reshape(len(low), -1).max(axis=1) / 2)

    label = f"half the width of the {100 * INTERVAL_MASS:g} % interval"
    return [
        SurfaceMap(
            name=f"uncertainty of recovered {label_of(name)}", estimate=estimate,
            values=partial(half_width, name),
            scale=Scale(high=WIDEST, label=label, ends=("±0", f"±{WIDEST:g} and more")),
            sentence="Of the recovered texture, which neighbours make surer than a point is by "
            "itself, but for errors that they have in common.",
        )
        for name in field.names
    ]  # fmt: skip
