"""What an estimate says, in words and in parts of the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.output.knowledge import TOLERANCE, part, within
from svu_mi.output.page import grouped
from svu_mi.output.result import Result, areas, known, words

ROUGHLY = 0.15  # half-width of an interval up to which a parameter counts as roughly known
STEEP = 0.5  # mean sine of elevation from which a part of the surface faces up, or down


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
    def of(cls, estimate: Any, result: Result, half_width: np.ndarray) -> Parts:
        """Measure the parts.

        Args:
            estimate: the ``Estimate``.
            result: what it says; some texel must be seen.
            half_width: (T,) of the parameter's intervals.
        """
        area = areas(estimate)[result.seen]
        settled, roughly = (within(half_width[result.seen], x) for x in (TOLERANCE, ROUGHLY))
        return cls(part(area, settled), part(area, roughly & ~settled), part(area, ~roughly))


def facing(estimate: Any, chosen: np.ndarray, up: np.ndarray) -> str | None:
    """Return ``upwards`` or ``downwards`` if that is where some texels mostly face, else None.

    Args:
        estimate: the ``Estimate``.
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
    of = {name: int(number) for name, number in estimate.skipped.items() if number}
    unseen = f"{estimate.posterior.prior_entropy:.3g}"
    fixed = ", ".join(f"{words(n)} = {value:g}" for n, value in known(estimate).items())
    sentences: Mapping[str, tuple[str, str]] = {
        "texels outside the charts": (
            "One point of the texture carries no surface.",
            "{n} points of the texture carry no surface: they lie outside its UV charts.",
        ),
        "texels on overlapping charts": (
            "One point is used twice by the texture and was left out.",
            "{n} points are used twice by the texture (overlapping charts) and were left out.",
        ),
        "texels never seen": (
            f"One point of the surface is in no photograph; its entropy is {unseen}.",
            "{n} points of the surface are in no photograph; nothing was computed for them, and "
            f"their entropy is {unseen}.",
        ),
        "views left out": (
            "One photograph was left out.", "{n} photographs were left out."
        ),
        "views that show no texel": (
            "One photograph does not show the object; check its camera.",
            "{n} photographs do not show the object; check their cameras.",
        ),
        "channels of the light equal to another": (
            "", "The light is grey: one colour channel stands for all three."
        ),
        "channels of the photographs equal to another": (
            "", "The photographs are grey: one colour channel stands for all three."
        ),
        "roughness levels that the prior excludes": (
            "One roughness is impossible by the prior and was not tried.",
            "{n} values of roughness are impossible by the prior and were not tried.",
        ),
        "parameters known": (
            f"One parameter was taken as known: {fixed}.",
            f"{{n}} parameters were taken as known: {fixed}.",
        ),
    }  # fmt: skip
    lines = []
    for name, number in of.items():
        one, many = sentences.get(name, (f"{name}: 1.", f"{name}: {{n}}."))
        lines.append(one if number == 1 and one else many.format(n=grouped(number)))
    return lines


def why_left_out(photograph: np.ndarray) -> str:
    """Return why a photograph may not have been used."""
    usable = photograph[np.isfinite(photograph).all(axis=2)]
    if usable.size == 0:
        return "no photograph, or no usable pixel"
    return "entirely black" if usable.max() <= 0 else "left out on request"
