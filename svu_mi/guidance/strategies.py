"""Strategies of guidance, and simple baselines that expected entropy has to beat.

``TABLE`` is the one place to add another. The command line reads it before Mitsuba is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

if TYPE_CHECKING:
    from svu_mi.guidance.strategy_inputs import Prospect

    Name = str


class Judge(Protocol):
    """A strategy at work."""

    def gains(self) -> np.ndarray:
        """What each candidate is worth now, (C,) float64; more is better, and the best is exact."""

    def choose(self, candidate: int) -> None:
        """Take a candidate as photographed from now on."""


@dataclass(frozen=True)
class Strategy:
    """Criterion of candidates; ``make``: prospect -> judge. ``method`` None: for all estimates."""

    unit: str
    make: Callable[[Prospect], Judge]
    forecasts: bool = False
    method: str | None = None


class Farthest:
    """Farthest-point sampling: the direction farthest from all views so far."""

    def __init__(self, directions: np.ndarray, views: int) -> None:
        """Make it of unit directions (V, 3) from the object; the first ``views`` are taken."""
        self._candidates, taken = directions[views:], directions[:views]
        self._angles = _angles(self._candidates, taken).min(axis=1, initial=np.pi)

    def gains(self) -> np.ndarray:
        """Angle to the nearest view so far, in radians."""
        return self._angles

    def choose(self, candidate: int) -> None:
        """Add a candidate."""
        own = _angles(self._candidates, self._candidates[[candidate]])[:, 0]
        self._angles = np.minimum(self._angles, own)


def farthest(directions: np.ndarray, taken: Sequence[int], count: int) -> list[int]:
    """Return ``taken`` and up to ``count`` more directions by farthest-point sampling."""
    chosen = list(taken)
    strategy = Farthest(np.concatenate([directions[chosen], directions]), len(chosen))
    free = np.ones(len(directions), bool)
    free[chosen] = False
    for _ in range(min(count, int(free.sum()))):
        best = int(np.argmax(np.where(free, strategy.gains(), -np.inf)))
        strategy.choose(best)
        free[best] = False
        chosen.append(best)
    return chosen


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(a @ b.T, -1, 1))


class Random:
    """Any order, each as likely."""

    def __init__(self, candidates: int, seed: int) -> None:
        self._gains = np.random.default_rng(seed).permutation(candidates).astype(np.float64)

    def gains(self) -> np.ndarray:
        """Ranks."""
        return self._gains

    def choose(self, candidate: int) -> None:
        """Add a candidate: others keep their rank."""


class Coverage:
    """Most texels that few views see: each is worth 2^-n, seen by n views so far."""

    def __init__(self, seen: np.ndarray, views: int) -> None:
        """Make it of ``seen`` (V, T) bool; the first ``views`` are taken."""
        self._sees = seen[views:]
        self._worth = 0.5 ** seen[:views].sum(axis=0)

    def gains(self) -> np.ndarray:
        """Mean worth over texels."""
        return np.where(self._sees, self._worth, 0).mean(axis=1)

    def choose(self, candidate: int) -> None:
        """Add a candidate."""
        self._worth = self._worth * np.where(self._sees[candidate], 0.5, 1)


TABLE: dict[str, Strategy] = {
    "entropy": Strategy(
        "expected fall of the mean entropy", lambda known: known.greedy, forecasts=True
    ),
    "error": Strategy(
        "expected fall of the mean squared error, relative to the present one",
        lambda known: known.by_error(), forecasts=True, method="angular",
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
