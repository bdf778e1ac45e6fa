"""PSNR of textures and entropy against the number of photographs, by strategy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi import metrics
from svu_mi.bench.captures import chosen_views
from svu_mi.bench.guidance.sizes import Sizes
from svu_mi.capture import Capture
from svu_mi.capture.poses import bounding_sphere, directions_of
from svu_mi.guidance.baselines import farthest
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.next_view import next_best_view
from svu_mi.guidance.options import Strategy
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.recovery.recover import recover
from svu_mi.surface import Texels

Record = dict[str, Any]
LOOKS = ("entropy", "error", "d-optimal")  # at photographs; others know their order at once


@dataclass(frozen=True)
class Shoot:
    """A photographer who has photographed everything, and lets strategies choose.

    Attributes:
        capture: all views, each with its photograph.
        grid: texels of the textures.
        sizes: of the benchmark.
        seed: of the start, and of the random strategy.
    """

    capture: Capture
    grid: Texels
    sizes: Sizes
    seed: int

    @cached_property
    def start(self) -> list[int]:
        """Views of the start: one drawn at random, then the farthest from those before."""
        rng = np.random.default_rng(self.seed)
        first = int(rng.integers(self.capture.count))
        return self._farthest([first], self.sizes.start - 1)

    @cached_property
    def truth(self) -> dict[str, np.ndarray]:
        """True textures."""
        known = metrics.ground_truth(self.capture, self.grid)
        return {name: getattr(known, name) for name in NAMES}

    @cached_property
    def visible(self) -> np.ndarray:
        """(T,) bool, texels that any view sees: whoever does not look there has to guess."""
        return np.array(estimate(self.capture, self.grid, preset="fast").coverage) > 0

    def order(self, strategy: Strategy) -> list[int]:
        """Return the views that a strategy adds to the start, in order.

        After each, it has the photograph: entropies are estimated anew.
        """
        count = max(self.sizes.marks)
        if strategy == "farthest":
            return self._farthest(self.start, count)[len(self.start) :]
        chosen = list(self.start)
        ahead = 1 if strategy in LOOKS else count
        while len(chosen) < len(self.start) + count:
            left = [v for v in range(self.capture.count) if v not in chosen]
            guidance = next_best_view(
                estimate(chosen_views(self.capture, chosen), self.grid),
                Candidates.of([self.capture.sensors[v] for v in left]), ahead,
                strategy=strategy, seed=self.seed,
            )  # fmt: skip
            chosen += [left[p.candidate] for p in guidance.proposals]
        return chosen[len(self.start) :]

    def judge(self, views: list[int]) -> Record:
        """Return ``psnr`` of recovered textures over all visible texels, by parameter and
        ``average``, and ``entropy``, the mean over these texels, unseen ones counting as 1."""
        taken = chosen_views(self.capture, views)
        textures = recover(taken, self.grid, "sh").textures
        found = {name: textures.at(self.grid, name)[self.visible] for name in NAMES}
        truth = {name: value[self.visible] for name, value in self.truth.items()}
        entropy = np.array(estimate(taken, self.grid).entropy, np.float64)
        return {
            "psnr": metrics.texture_psnr(found, truth),
            "entropy": float(entropy[self.visible].mean()),
        }

    def curve(self, strategy: Strategy, start: Record) -> Record:
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

    def curves(self) -> Iterator[tuple[Strategy, Record]]:
        """Yield the curve of every strategy."""
        start = self.judge(self.start)
        for strategy in self.sizes.strategies:
            yield strategy, self.curve(strategy, start)

    def _farthest(self, views: list[int], count: int) -> list[int]:
        """Return views, and ``count`` more by farthest-point sampling."""
        center, _ = bounding_sphere(self.capture.shape)
        return farthest(directions_of(self.capture.sensors, center), views, count)
