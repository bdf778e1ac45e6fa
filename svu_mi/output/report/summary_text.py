"""Summary of a report: surface shares by interval width, and sentences."""

from typing import NamedTuple

import numpy as np

from svu_mi.output.estimate_arrays import is_seen, known_values, label_of, texel_areas
from svu_mi.output.html import grouped
from svu_mi.output.interval_summary import TOLERANCE, Intervals, area_share, is_within
from svu_mi.posterior.estimate import Estimate

ROUGHLY = 0.15  # largest half-width of an interval that counts as roughly determined
STEEP = 0.5  # smallest mean sine of elevation that counts as upwards or downwards
# {unseen} is replaced by the entropy of the prior.
SKIPPED = {
    "texels outside the charts": "Points of the texture outside its UV charts: {n}.",
    "texels on overlapping charts": "Points on overlapping charts, omitted: {n}.",
    "texels never seen": "Points of the surface in no photograph: {n}. They have the entropy of "
    "the prior, {unseen}.",
    "views left out": "Unused photographs: {n}.",
    "views that show no texel": "Photographs that do not show the object: {n}; check their "
    "cameras.",
    "channels of the light equal to another":
    "The light is grey: one colour channel was used for all three.",
    "channels of the photographs equal to another":
    "The photographs are grey: one colour channel was used for all three.",
    "roughness levels that the prior excludes":
    "Roughness values excluded by the prior, not computed: {n}.",
    "parameters known": "Parameters with a given value: {known}.",
}  # fmt: skip


class WidthShares(NamedTuple):
    """Shares of the seen surface, by area, for three ranges of a parameter's interval width."""

    settled: float  # half-width up to 0.05
    roughly: float  # above 0.05, up to 0.15
    wide: float

    @classmethod
    def of(cls, estimate: Estimate, intervals: Intervals, name: str) -> "WidthShares":
        """Return the shares of a parameter; at least one texel of the intervals must be seen."""
        seen = is_seen(estimate)[intervals.chosen]
        area, half = texel_areas(estimate)[intervals.chosen][seen], intervals.half_width(name)[seen]
        settled, roughly = (is_within(half, x) for x in (TOLERANCE, ROUGHLY))
        return cls(
            area_share(area, settled),
            area_share(area, roughly & ~settled),
            area_share(area, ~roughly),
        )


def facing_direction(estimate: Estimate, chosen: np.ndarray, up: np.ndarray) -> str | None:
    """Return ``upwards`` or ``downwards`` if the chosen texels mostly face that way, else None."""
    area = texel_areas(estimate)[chosen]
    heights = np.array(estimate.texels.normal, np.float64).T[chosen] @ up
    if not area.sum() > 0:
        return None
    mean = float((area * heights).sum() / area.sum())
    return "upwards" if mean > STEEP else "downwards" if mean < -STEEP else None


def skipped_sentences(estimate: Estimate) -> list[str]:
    """Return a sentence for each kind of skipped work."""
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
