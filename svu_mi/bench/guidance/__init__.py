"""``svu bench guidance``: views chosen by each strategy, and textures recovered from them."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.bench.captures import chosen_views
from svu_mi.bench.cases import Case
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Record
from svu_mi.bench.guidance.guidance_tables import draw_guidance, find_bars, guidance_tables
from svu_mi.bench.problem_sizes import GuidanceSizes
from svu_mi.bench.study import Selection, Study
from svu_mi.capture.sensors import bounding_sphere, directions_of
from svu_mi.geometry.texels import Texels, texels
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.next_view import next_best_view
from svu_mi.guidance.strategies import TABLE, farthest
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.recover import recover


@dataclass(frozen=True)
class StrategyRow:
    """A strategy of ``guidance.strategies.TABLE``, by name."""

    label: str


@dataclass(frozen=True)
class ViewSelectionCase(CaseSubject):
    """A case with photographs of all candidates, among which strategies choose.

    Attributes:
        number: Index of the initial set of views; part of the random seed.
        kind: Kind of the initial set, see ``GuidanceSizes``.
    """

    number: int
    kind: str = "even"

    @property
    def name(self) -> str:
        return f"{self.case.name}/{self.kind}_{self.number}"

    @property
    def title(self) -> str:
        return f"{self.case.title}, {self.kind} start {self.number}"

    @property
    def rows(self) -> Sequence[StrategyRow]:
        return [StrategyRow(name) for name in self.sizes.strategies]

    @property
    def sizes(self) -> GuidanceSizes:
        """Sizes of the guidance benchmark."""
        return self.bench.sizes.guidance

    @property
    def seed(self) -> int:
        """Seed of the initial set and of the random strategy, different for each case."""
        return zlib.crc32(f"{self.case.name} {self.number}".encode())

    def settings(self, row: StrategyRow | None) -> Any:
        size = self.bench.sizes
        return (
            str(self.case.scene), self.case.defines, self.kind, self.number,
            (size.views, size.film, size.spp, size.seed), asdict(self.sizes),
            row and row.label,
        )  # fmt: skip

    def head(self) -> Record:
        """Return names, initial views (``start``), their score (``first``) and ``agreement``."""
        return {
            "cell": self.case.title, "object": self.case.object, "kind": self.kind,
            "start": self.start, "first": self.first, "agreement": self.agreement(),
        }  # fmt: skip

    def measure(self, row: StrategyRow) -> Record:
        """Return the ``order`` of added views, and scores after 0 and ``marks`` views."""
        order = self.order(row.label)
        marks = self.sizes.marks
        points = [self.first, *(self.score(self.start + order[:mark]) for mark in marks)]
        return {
            "order": order,
            "psnr": [point["psnr"]["average"] for point in points],
            "entropy": [point["entropy"] for point in points],
            "parameters": {name: [point["psnr"][name] for point in points] for name in NAMES},
        }

    @cached_property
    def layout(self) -> Texels:
        """Texels of the textures."""
        return texels(self.capture.mesh, self.sizes.texels)

    @cached_property
    def first(self) -> Record:
        """Score of the initial views."""
        return self.score(self.start)

    @cached_property
    def start(self) -> list[int]:
        """Indices of initial views: a random one, then farthest-point samples or nearest views."""
        rng = np.random.default_rng(self.seed)
        first = int(rng.integers(self.capture.count))
        if self.kind == "even":
            return self._farthest([first], self.sizes.start - 1)
        nearness = self._directions @ self._directions[first]
        return [int(view) for view in np.argsort(-nearness)[: self.sizes.start]]

    @cached_property
    def visible(self) -> np.ndarray:
        """Texels that are visible in any view, (T,) bool."""
        return np.array(estimate(self.capture, self.layout, preset="fast").coverage) > 0

    def order(self, strategy: str) -> list[int]:
        """Return the views that a strategy adds to the initial ones, in order.

        Strategies with forecasts estimate again from the photograph of each added view. Other
        strategies choose all views at once.
        """
        count = max(self.sizes.marks)
        if strategy == "farthest":
            return self._farthest(self.start, count)[len(self.start) :]
        chosen = list(self.start)
        ahead = 1 if TABLE[strategy].needs_forecast else count
        while len(chosen) < len(self.start) + count:
            left = [v for v in range(self.capture.count) if v not in chosen]
            guidance = next_best_view(
                estimate(chosen_views(self.capture, chosen), self.layout),
                Candidates.of([self.capture.sensors[v] for v in left]), ahead,
                strategy=strategy, seed=self.seed, texels=self.sizes.looked_at,
            )  # fmt: skip
            chosen += [left[p.candidate] for p in guidance.proposals]
        return chosen[len(self.start) :]

    def score(self, views: list[int]) -> Record:
        """Return scores over all texels that any view shows.

        Returns:
            ``psnr`` of recovered textures by parameter, and ``average``; mean ``entropy``, where
            texels that ``views`` do not show count as 1.
        """
        taken = chosen_views(self.capture, views)
        textures = recover(taken, self.layout, "sh").textures
        entropy = np.array(estimate(taken, self.layout).entropy, np.float64)
        return {
            "psnr": self.truth.psnr(textures, self.visible),
            "entropy": float(entropy[self.visible].mean()),
        }

    def agreement(self) -> Record:
        """Compare expected and measured changes of the mean entropy.

        Returns:
            ``gains``: expected decrease for each candidate; ``changes``: decrease if the photograph
            of the candidate is added; ``correlation`` of both.
        """
        left = [view for view in range(self.capture.count) if view not in self.start]
        tried = left[:: max(1, len(left) // self.sizes.asked)][: self.sizes.asked]
        known = estimate(chosen_views(self.capture, self.start), self.layout)
        gains = next_best_view(known, Candidates.at(self.capture, tried)).scores
        changes = [
            _mean_entropy(known) - _mean_entropy(
                estimate(chosen_views(self.capture, [*self.start, view]), self.layout)
            )
            for view in tried
        ]  # fmt: skip
        return {
            "gains": gains.tolist(), "changes": changes,
            "correlation": float(np.corrcoef(gains, changes)[0, 1]),
        }  # fmt: skip

    def _farthest(self, views: list[int], count: int) -> list[int]:
        """Return the views, followed by ``count`` farthest-point samples."""
        return farthest(self._directions, views, count)

    @cached_property
    def _directions(self) -> np.ndarray:
        center, _ = bounding_sphere(self.capture.shape)
        return directions_of(self.capture.sensors, center)


def _mean_entropy(result: Estimate) -> float:
    return float(np.mean(np.array(result.entropy, np.float64)))


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    sizes = bench.sizes.guidance
    chosen = first_lights(selection.cases, sizes.lights)
    # All cases once before any twice, so that interrupted runs contain all cases.
    starts = itertools.product(range(sizes.starts), sizes.kinds, chosen)
    subjects = (ViewSelectionCase(bench, case, number, kind) for number, kind, case in starts)
    return Experiment("guidance", subjects, whole=True)


def first_lights(cases: Sequence[Case], count: int) -> list[Case]:
    """Return the first ``count`` cases of every object."""
    kept: list[Case] = []
    for case in cases:
        if sum(one.object == case.object for one in kept) < count:
            kept.append(case)
    return kept


STUDY = Study(
    title="Guidance: views to photograph next", experiment=_experiment, tables=guidance_tables,
    bars=find_bars, plots={"guidance": draw_guidance},
)  # fmt: skip
