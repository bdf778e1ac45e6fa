"""Strategies of guidance: expected entropy or error, and simple baselines.

``TABLE`` lists all of them. The command line imports this file before Mitsuba is loaded.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

if TYPE_CHECKING:
    from svu_mi.guidance.strategy_inputs import StrategyInputs

    StrategyName = str


class ViewScorer(Protocol):
    """Scores of candidates under a strategy, updated as candidates are chosen."""

    def scores(self) -> np.ndarray:
        """Return the scores of all candidates, (C,) float64. Only the highest must be exact."""

    def choose(self, candidate: int) -> None:
        """Treat a candidate as photographed in later calls."""


@dataclass(frozen=True)
class GuidanceStrategy:
    """Scorer of candidates, the ``unit`` of scores, and the required ``method`` (None: any)."""

    unit: str
    make_scorer: "Callable[[StrategyInputs], ViewScorer]"
    needs_forecast: bool = False
    method: str | None = None


class FarthestScorer:
    """Scorer by farthest-point sampling: angle to the nearest of the views so far."""

    def __init__(self, directions: np.ndarray, views: int) -> None:
        """Initialise from unit directions (V, 3); the first ``views`` have photographs."""
        self._candidates, taken = directions[views:], directions[:views]
        self._angles = _angles(self._candidates, taken).min(axis=1, initial=np.pi)

    def scores(self) -> np.ndarray:
        """Return each candidate's angle to the nearest of the views so far, in radians, (C,)."""
        return self._angles

    def choose(self, candidate: int) -> None:
        """Add the direction of a candidate to the views so far."""
        own = _angles(self._candidates, self._candidates[[candidate]])[:, 0]
        self._angles = np.minimum(self._angles, own)


def farthest(directions: np.ndarray, taken: Sequence[int], count: int) -> list[int]:
    """Return ``taken`` and up to ``count`` more indices by farthest-point sampling."""
    chosen = list(taken)
    strategy = FarthestScorer(np.concatenate([directions[chosen], directions]), len(chosen))
    free = np.ones(len(directions), bool)
    free[chosen] = False
    for _ in range(min(count, int(free.sum()))):
        best = int(np.argmax(np.where(free, strategy.scores(), -np.inf)))
        strategy.choose(best)
        free[best] = False
        chosen.append(best)
    return chosen


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(a @ b.T, -1, 1))


class RandomScorer:
    """Scorer that ranks candidates in random order."""

    def __init__(self, candidates: int, seed: int) -> None:
        self._scores = np.random.default_rng(seed).permutation(candidates).astype(np.float64)

    def scores(self) -> np.ndarray:
        """Return random ranks, (C,)."""
        return self._scores

    def choose(self, candidate: int) -> None:
        """Do nothing: ranks do not depend on earlier choices."""


class CoverageScorer:
    """Scorer by coverage: a texel that n views see so far has the weight 2^-n."""

    def __init__(self, seen: np.ndarray, views: int) -> None:
        """Initialise from visibility (V, T) bool; the first ``views`` have photographs."""
        self._sees = seen[views:]
        self._weight = 0.5 ** seen[:views].sum(axis=0)

    def scores(self) -> np.ndarray:
        """Return the sum of the weights of the texels that each candidate sees, over T, (C,)."""
        return np.where(self._sees, self._weight, 0).mean(axis=1)

    def choose(self, candidate: int) -> None:
        """Halve the weight of the texels that a candidate sees."""
        self._weight = self._weight * np.where(self._sees[candidate], 0.5, 1)


TABLE: dict[str, GuidanceStrategy] = {
    "entropy": GuidanceStrategy(
        "expected decrease of the mean entropy", lambda inputs: inputs.greedy, needs_forecast=True
    ),
    "error": GuidanceStrategy(
        "expected decrease of the mean squared error, relative to the present one",
        lambda inputs: inputs.by_error(), needs_forecast=True, method="angular",
    ),
    "coverage": GuidanceStrategy(
        "mean weight of the texels seen",
        lambda inputs: CoverageScorer(inputs.seen, inputs.photographs),
    ),
    "farthest": GuidanceStrategy(
        "angle to the nearest photograph, in radians",
        lambda inputs: FarthestScorer(inputs.directions, inputs.photographs),
    ),
    "random": GuidanceStrategy(
        "random rank", lambda inputs: RandomScorer(inputs.candidates.count, inputs.options.seed)
    ),
}  # fmt: skip
STRATEGIES = tuple(TABLE)

if not TYPE_CHECKING:
    StrategyName: Any = Literal[STRATEGIES]
