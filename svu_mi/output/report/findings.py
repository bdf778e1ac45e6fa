"""What an estimate says, in words and in parts of the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.output.page import grouped
from svu_mi.output.result import Result, known, words

CERTAIN, OPEN = 1 / 3, 2 / 3  # entropies that bound what is certain, and what is open
STEEP = 0.5  # mean sine of elevation from which a part of the surface faces up, or down


@dataclass(frozen=True)
class Parts:
    """Parts of the surface's area, 1 in all.

    Attributes:
        certain: entropy below 1/3.
        partly: between.
        uncertain: entropy of 2/3 and more.
        unseen: in no photograph.
    """

    certain: float
    partly: float
    uncertain: float
    unseen: float

    @classmethod
    def of(cls, estimate: Any, result: Result) -> Parts:
        """Measure the parts of an estimate."""
        area = estimate.texels.footprint.numpy().astype(np.float64) ** 2
        entropy, seen = result.entropy, result.seen
        certain, uncertain = entropy < CERTAIN, entropy >= OPEN

        def part(chosen: np.ndarray) -> float:
            return float(area[chosen].sum() / area.sum())  # exactly 1 if all are chosen

        return cls(
            certain=part(seen & certain),
            partly=part(seen & ~certain & ~uncertain),
            uncertain=part(seen & uncertain),
            unseen=part(~seen),
        )


def candidates(estimate: Any, entropy: float = 1.0) -> float:
    """Return how many materials of the grid an entropy leaves in question.

    n^H equally probable ones, of the n that there are, have the normalised entropy H.
    """
    return float(np.prod(estimate.posterior.grid.shape)) ** entropy


def facing(estimate: Any, chosen: np.ndarray, up: np.ndarray) -> str | None:
    """Return ``upwards`` or ``downwards`` if that is where some texels mostly face, else None.

    Args:
        estimate: the ``Estimate``.
        chosen: (T,) bool.
        up: unit vector.
    """
    texels = estimate.texels
    area = texels.footprint.numpy().astype(np.float64)[chosen] ** 2
    heights = np.array(texels.normal, np.float64).T[chosen] @ up
    if not area.sum() > 0:
        return None
    mean = float((area * heights).sum() / area.sum())
    return "upwards" if mean > STEEP else "downwards" if mean < -STEEP else None


def skipped(estimate: Any) -> list[str]:
    """Return what was not computed as sentences, without what there is nothing of."""
    of = {name: int(number) for name, number in estimate.skipped.items() if number}
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
            "One point of the surface is in no photograph; its entropy is 1.",
            "{n} points of the surface are in no photograph; nothing was computed for them, and "
            "their entropy is 1.",
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
