"""What an estimate says, in words and in parts of the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.output.knowledge import TOLERANCE, part, within
from svu_mi.output.page import grouped
from svu_mi.output.result import areas, is_seen, known, words

ROUGHLY = 0.15  # half-width of an interval up to which a parameter counts as roughly known
STEEP = 0.5  # mean sine of elevation from which a part of the surface faces up, or down
# What is skipped: for one, and for several. {unseen} is the entropy of the prior.
SKIPPED = {
    "texels outside the charts": (
        "One point of the texture lies outside its UV charts.",
        "{n} points of the texture lie outside its UV charts.",
    ),
    "texels on overlapping charts": (
        "One point is on several charts (they overlap) and was left out.",
        "{n} points are on several charts (they overlap) and were left out.",
    ),
    "texels never seen": (
        "One point of the surface is in no photograph; its entropy is {unseen}.",
        "{n} points of the surface are in no photograph; nothing was computed for them, and "
        "their entropy is {unseen}.",
    ),
    "views left out": ("One photograph was left out.", "{n} photographs were left out."),
    "views that show no texel": (
        "One photograph does not show the object; check its camera.",
        "{n} photographs do not show the object; check their cameras.",
    ),
    "channels of the light equal to another": (
        "The light is grey: one colour channel was used for all three.",
    ) * 2,
    "channels of the photographs equal to another": (
        "The photographs are grey: one colour channel was used for all three.",
    ) * 2,
    "roughness levels that the prior excludes": (
        "One roughness is excluded by the prior and was not tried.",
        "{n} values of roughness are excluded by the prior and were not tried.",
    ),
    "parameters known": (
        "One parameter was taken as known: {known}.",
        "{n} parameters were taken as known: {known}.",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Parts:
    """Parts of the area of the surface seen, 1 in all, by the interval of one parameter.

    Attributes:
        settled: half-width of 0.05 and less.
        roughly: of more, up to 0.15.
        wide: of more.
    """

    settled: float
    roughly: float
    wide: float

    @classmethod
    def of(
        cls, estimate: Any, half_width: np.ndarray, chosen: np.ndarray | None = None
    ) -> Parts:
        """Measure the parts, of which some texel must be seen, by half-widths of intervals (t,) of
        some texels; of all by default."""
        texels = slice(None) if chosen is None else chosen
        seen = is_seen(estimate)[texels]
        area = areas(estimate)[texels][seen]
        settled, roughly = (within(half_width[seen], x) for x in (TOLERANCE, ROUGHLY))
        return cls(part(area, settled), part(area, roughly & ~settled), part(area, ~roughly))


def facing(estimate: Any, chosen: np.ndarray, up: np.ndarray) -> str | None:
    """Return ``upwards`` or ``downwards`` if that is where some texels mostly face, else None.

    Args:
        estimate: says where texels are.
        chosen: (T,) bool.
        up: unit vector.
    """
    area = areas(estimate)[chosen]
    heights = np.array(estimate.texels.normal, np.float64).T[chosen] @ up
    if not area.sum() > 0:
        return None
    mean = float((area * heights).sum() / area.sum())
    return "upwards" if mean > STEEP else "downwards" if mean < -STEEP else None


def skipped(estimate: Any) -> list[str]:
    """Return what was not computed as sentences, without what there is nothing of."""
    about = {
        "unseen": f"{estimate.posterior.prior_entropy:.3g}",
        "known": ", ".join(f"{words(n)} = {value:g}" for n, value in known(estimate).items()),
    }
    return [
        SKIPPED.get(name, (f"{name}: {{n}}.",) * 2)[number != 1].format(n=grouped(number), **about)
        for name, number in estimate.skipped.items() if number
    ]  # fmt: skip
