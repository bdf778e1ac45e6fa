"""All strategies: what each is worth in, what it needs to know, how it is made.

This is the one place to add another. It is read before Mitsuba is loaded, by the command line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from svu_mi.guidance.baselines import Coverage, DOptimal, Farthest, Random

if TYPE_CHECKING:
    from svu_mi.guidance.prospect import Prospect

    Name = str


class Judge(Protocol):
    """A strategy at work."""

    def gains(self) -> np.ndarray:
        """What each candidate is worth now, (C,) float64; more is better, and the best is exact."""

    def choose(self, candidate: int) -> None:
        """Take a candidate as photographed from now on."""


@dataclass(frozen=True)
class Strategy:
    """A way to judge candidates.

    Attributes:
        unit: of gains.
        make: out of a prospect, of which it asks for no more than it needs.
        forecasts: whether it needs a forecast (Eq. 13) and so sees how entropy changes; others
            cost nothing but rays.
        method: that of the estimates it can work with; all by default.
    """

    unit: str
    make: Callable[[Prospect], Judge]
    forecasts: bool = False
    method: str | None = None


TABLE: dict[str, Strategy] = {
    "entropy": Strategy(
        "expected fall of the mean entropy", lambda known: known.greedy, forecasts=True
    ),
    "error": Strategy(
        "expected fall of the mean squared error, relative to the present one",
        lambda known: known.by_error(), forecasts=True, method="angular",
    ),
    "d-optimal": Strategy(
        "mean change of log det of the information",
        lambda known: DOptimal(known.jacobians(), known.photographs),
        forecasts=True, method="angular",
    ),
    "coverage": Strategy(
        "mean worth of the texels seen", lambda known: Coverage(known.seen, known.photographs)
    ),
    "farthest": Strategy(
        "angle to the nearest photograph, in radians",
        lambda known: Farthest(known.directions, known.photographs),
    ),
    "random": Strategy(
        "a drawn rank", lambda known: Random(known.candidates.count, known.options.seed)
    ),
}  # fmt: skip
STRATEGIES = tuple(TABLE)

if not TYPE_CHECKING:
    Name: Any = Literal[STRATEGIES]
