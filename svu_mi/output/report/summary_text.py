"""Summary of a report: surface shares by interval width, and sentences."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from svu_mi.output.estimate_arrays import is_seen, known_values, label_of, texel_areas
from svu_mi.output.html import grouped
from svu_mi.output.interval_summary import TOLERANCE, area_share, is_within

ROUGHLY = 0.15  # half-width of an interval up to which a parameter counts as roughly known
STEEP = 0.5  # mean sine of elevation from which a part of the surface faces up, or down
# {unseen} is the entropy of the prior.
SKIPPED = {
    "texels outside the charts": "Points of the texture outside its UV charts: {n}.",
    "texels on overlapping charts": "Points on several charts (they overlap), left out: {n}.",
    "texels never seen": "Points of the surface in no photograph: {n}. Nothing was computed for "
    "them, and their entropy is {unseen}.",
    "views left out": "Photographs left out: {n}.",
    "views that show no texel": "Photographs that do not show the object: {n}; check their "
    "cameras.",
    "channels of the light equal to another":
    "The light is grey: one colour channel was used for all three.",
    "channels of the photographs equal to another":
    "The photographs are grey: one colour channel was used for all three.",
    "roughness levels that the prior excludes":
    "Values of roughness excluded by the prior, and not tried: {n}.",
    "parameters known": "Parameters taken as known: {known}.",
}  # fmt: skip


class WidthShares(NamedTuple):
    """Parts of the surface seen, by area, 1 in all: half-width of the interval of a parameter."""

    settled: float  # 0.05 and less
    roughly: float  # up to 0.15
    wide: float

    @classmethod
    def of(cls, estimate: Any, half_width: np.ndarray) -> WidthShares:
        """Return the parts by half-widths of intervals (T,); some texel must be seen."""
        seen = is_seen(estimate)
        area = texel_areas(estimate)[seen]
        settled, roughly = (is_within(half_width[seen], x) for x in (TOLERANCE, ROUGHLY))
        return cls(
            area_share(area, settled),
            area_share(area, roughly & ~settled),
            area_share(area, ~roughly),
        )


def facing_direction(estimate: Any, chosen: np.ndarray, up: np.ndarray) -> str | None:
    """Return ``upwards`` or ``downwards`` if some texels (T,) bool mostly face there, else None."""
    area = texel_areas(estimate)[chosen]
    heights = np.array(estimate.texels.normal, np.float64).T[chosen] @ up
    if not area.sum() > 0:
        return None
    mean = float((area * heights).sum() / area.sum())
    return "upwards" if mean > STEEP else "downwards" if mean < -STEEP else None


def skipped_sentences(estimate: Any) -> list[str]:
    """Return a sentence for each kind of work that was skipped."""
    about = {
        "unseen": f"{estimate.posterior.prior_entropy:.3g}",
        "known": ", ".join(
            f"{label_of(n)} = {value:g}" for n, value in known_values(estimate).items()
        ),
    }
    return [
        SKIPPED.get(name, f"{name}: {{n}}.").format(n=grouped(number), **about)
        for name, number in estimate.skipped.items()
        if number
    ]
