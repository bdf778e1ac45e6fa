"""PSNR of textures and entropy against the number of photographs, by strategy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.bench.captures import chosen_views
from svu_mi.bench.sizes import GuidanceSizes
from svu_mi.bench.truth import Truth
from svu_mi.capture import Capture
from svu_mi.capture.poses import bounding_sphere, directions_of
from svu_mi.guidance.baselines import farthest
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.next_view import next_best_view
from svu_mi.guidance.strategies import TABLE
from svu_mi.parameters import NAMES
from svu_mi.pipeline import Estimate, estimate
from svu_mi.recovery.recover import recover
from svu_mi.surface import Texels

Record = dict[str, Any]


@dataclass(frozen=True)
class Shoot:
    """A photographer who has photographed everything, and lets strategies choose.

    Attributes:
        capture: all views, each with its photograph.
        grid: texels of the textures.
        sizes: of the benchmark.
        seed: of the start, and of the random strategy.
        kind: of the start, see ``Sizes``.
    """

    capture: Capture
    grid: Texels
    sizes: GuidanceSizes
    seed: int
    kind: str = "even"

    @cached_property
    def start(self) -> list[int]:
        """Views of the start: one drawn at random, and the farthest from those before; or the
        nearest to it."""
        rng = np.random.default_rng(self.seed)
        first = int(rng.integers(self.capture.count))
        if self.kind == "even":
            return self._farthest([first], self.sizes.start - 1)
        nearness = self._directions @ self._directions[first]
        return [int(view) for view in np.argsort(-nearness)[: self.sizes.start]]

    @cached_property
    def truth(self) -> Truth:
        """True textures."""
        return Truth.of(self.capture, self.grid)

    @cached_property
    def visible(self) -> np.ndarray:
        """(T,) bool, texels that any view sees: whoever does not look there has to guess."""
        return np.array(estimate(self.capture, self.grid, preset="fast").coverage) > 0

    def order(self, strategy: str) -> list[int]:
        """Return the views that a strategy adds to the start, in order.

        After each, it has the photograph: what it forecasts from is estimated anew. Others know
        their order at once.
        """
        count = max(self.sizes.marks)
        if strategy == "farthest":
            return self._farthest(self.start, count)[len(self.start) :]
        chosen = list(self.start)
        ahead = 1 if TABLE[strategy].forecasts else count
        while len(chosen) < len(self.start) + count:
            left = [v for v in range(self.capture.count) if v not in chosen]
            guidance = next_best_view(
                estimate(chosen_views(self.capture, chosen), self.grid),
                Candidates.of([self.capture.sensors[v] for v in left]), ahead,
                strategy=strategy, seed=self.seed, texels=self.sizes.looked_at,
            )  # fmt: skip
            chosen += [left[p.candidate] for p in guidance.proposals]
        return chosen[len(self.start) :]

    def judge(self, views: list[int]) -> Record:
        """Return ``psnr`` of recovered textures over all visible texels, by parameter and
        ``average``, and ``entropy``, the mean over these texels, unseen ones counting as 1."""
        taken = chosen_views(self.capture, views)
        textures = recover(taken, self.grid, "sh").textures
        entropy = np.array(estimate(taken, self.grid).entropy, np.float64)
        return {
            "psnr": self.truth.psnr(textures, self.visible),
            "entropy": float(entropy[self.visible].mean()),
        }

    def agreement(self) -> Record:
        """Compare the forecast at the start with what photographs then change.

        Returns:
            Per candidate asked ``gains``, expected changes of the mean entropy, and ``changes``,
            those of ``estimate`` once its photograph is there; and their ``correlation``.
        """
        left = [view for view in range(self.capture.count) if view not in self.start]
        asked = left[:: max(1, len(left) // self.sizes.asked)][: self.sizes.asked]
        known = estimate(chosen_views(self.capture, self.start), self.grid)
        gains = next_best_view(known, Candidates.at(self.capture, asked)).gains
        changes = [
            _mean_entropy(known) - _mean_entropy(
                estimate(chosen_views(self.capture, [*self.start, view]), self.grid)
            )
            for view in asked
        ]  # fmt: skip
        return {
            "gains": gains.tolist(), "changes": changes,
            "correlation": float(np.corrcoef(gains, changes)[0, 1]),
        }  # fmt: skip

    def curve(self, strategy: str, start: Record) -> Record:
        """Return the ``order`` of a strategy, and per mark what ``judge`` says, as lists."""
        order = self.order(strategy)
        points = [start, *(self.judge(self.start + order[:mark]) for mark in self.sizes.marks)]
        return {
            "order": order,
            "psnr": [point["psnr"]["average"] for point in points],
            "entropy": [point["entropy"] for point in points],
            "parameters": {
                name: [point["psnr"][name] for point in points] for name in NAMES
            },
        }  # fmt: skip

    def curves(self) -> Iterator[tuple[str, Record]]:
        """Yield the curve of every strategy."""
        start = self.judge(self.start)
        for strategy in self.sizes.strategies:
            yield strategy, self.curve(strategy, start)

    def _farthest(self, views: list[int], count: int) -> list[int]:
        """Return views, and ``count`` more by farthest-point sampling."""
        return farthest(self._directions, views, count)

    @cached_property
    def _directions(self) -> np.ndarray:
        center, _ = bounding_sphere(self.capture.shape)
        return directions_of(self.capture.sensors, center)


def _mean_entropy(found: Estimate) -> float:
    return float(np.mean(np.array(found.entropy, np.float64)))
