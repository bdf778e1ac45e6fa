"""Result of capture guidance: proposals, scores of all candidates, maps of information gain."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.errors import OptionError
from svu_mi.geometry.neighbors import texel_squares
from svu_mi.geometry.texels import Texels
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.guidance_options import GuidanceOptions
from svu_mi.guidance.strategy_inputs import StrategyInputs

CHUNK = 8192  # texels whose maps are computed at a time
MAP_SIZE = 128  # values of a map along its longer side; finer ones would show their noise
SHOWN_NAMES = 3  # proposals that a line names


@dataclass(frozen=True)
class Proposal:
    """A view to photograph.

    Attributes:
        candidate: its number among the candidates.
        name: its label.
        sensor: where to take it from.
        gain: expected information gain: mean fall of E[H] over texels, with the proposals before
            it taken as photographed. NaN by a strategy without a forecast.
        error: standard error of that mean, as not all texels were looked at; 0 if they were, NaN
            if it was a single one, or without a forecast. That of the hypotheses, which all
            candidates share, is not part of it.
        entropy: mean over texels to be expected with this view: that of the photographs so far,
            less all gains up to here. NaN without a forecast.
        sees: part of the texels that it sees.
        new: part of the texels that it would be the first to see.
    """

    candidate: int
    name: str
    sensor: Any
    gain: float
    error: float
    entropy: float
    sees: float
    new: float


@dataclass(frozen=True, kw_only=True, repr=False)
class Guidance:
    """Which photographs to take next.

    Attributes:
        candidates: all candidates.
        proposals: the best view, then the best one once that is taken, ...
        scores: (C,) float64, score of every candidate as the next photograph, in the unit of the
            strategy (mean change of E[H], if by entropy); NaN where not reachable.
        entropy: of the photographs so far, as ``estimate`` has it: mean over all texels, of which
            unseen ones count as H of the prior (``Posterior.prior_entropy``).
        texels: the T texels.
        options: how candidates were compared.
        method: of the estimate.
        skipped: what was not computed, by reason, as counts.
        timings: seconds per stage, synchronised.
    """

    candidates: Candidates
    proposals: tuple[Proposal, ...]
    scores: np.ndarray
    entropy: float
    texels: Texels
    options: GuidanceOptions
    method: str
    skipped: dict[str, int]
    timings: dict[str, float] = field(default_factory=dict)
    _inputs: StrategyInputs | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        names = ", ".join(proposal.name for proposal in self.proposals[:SHOWN_NAMES])
        more = ", ..." if len(self.proposals) > SHOWN_NAMES else ""
        return (
            f"<Guidance: {names}{more} of {self.candidates.count} candidates, mean entropy "
            f"{self.entropy:.2f} so far>"
        )

    @property
    def ranking(self) -> np.ndarray:
        """Numbers of the reachable candidates as the next photograph, the best first."""
        order = np.argsort(-self.scores, kind="stable")
        return order[np.isfinite(self.scores[order])]

    def gain_maps(self) -> np.ndarray:
        """Return the gain of every texel by each proposal: (proposals, T) float32.

        That of all texels, not only of those that the candidates were judged by; 0 where the
        proposal does not see the texel. In textures of more than 128 texels, a block of
        neighbours (2 x 2 of 256) has the gain of one of them. Computed once, when first asked for,
        by a forecast, also if the strategy did without.

        Raises:
            OptionError: an estimate that does not say what photographs would show.
        """
        return self._maps.copy()

    @cached_property
    def _maps(self) -> np.ndarray:
        assert self._inputs is not None
        maps = np.zeros((len(self.proposals), self.texels.count), np.float32)
        proposed = Candidates.of([proposal.sensor for proposal in self.proposals])
        everywhere = replace(self._inputs, candidates=proposed, texels=np.arange(self.texels.count))
        # Where none of them sees anything, there is nothing to gain.
        seen = everywhere.seen_by_candidates()
        shown = np.flatnonzero(seen.any(axis=0))
        first, block = self._blocks(shown)
        gains = [
            _texel_information_gain(replace(everywhere, texels=first[start : start + CHUNK]))
            for start in range(0, len(first), CHUNK)
        ]
        if gains:
            maps[:, shown] = np.concatenate(gains, axis=1)[:, block] * seen[:, shown]
        return maps

    def _blocks(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return one texel of each block of (t,) texels, and the block number of each, (t,)."""
        width, height = self.texels.resolution
        side = -(-max(width, height) // MAP_SIZE)
        row, column = texel_squares(self.texels)[chosen].T
        of_block = row // side * width + column // side
        _, first, block = np.unique(of_block, return_index=True, return_inverse=True)
        order = np.argsort(first)  # neighbours in order are near each other
        place = np.empty(len(order), np.int64)
        place[order] = np.arange(len(order))
        return chosen[first[order]], place[block]

    def image(self, proposal: int = 0) -> np.ndarray:
        """Return the gain of a proposal as an (H, W) float32 texture, 0 outside the charts.

        Raises:
            OptionError: there is no such proposal.
        """
        if not 0 <= proposal < len(self.proposals):
            raise OptionError(
                f"Guidance.image(): proposal must be 0 to {len(self.proposals) - 1}, "
                f"got {proposal}."
            )
        return self.texels.to_image(self._maps[proposal], 0.0)


def _texel_information_gain(inputs: StrategyInputs) -> np.ndarray:
    """Return the information gain of every texel by each candidate in turn, (C, t)."""
    known, count = inputs.photographs, inputs.candidates.count
    forecast = inputs.forecast
    if forecast.is_separable:
        steps = forecast.cumulative(np.arange(known), known + np.arange(count))
        return steps[:-1] - steps[1:]
    greedy, gains = inputs.greedy, []
    for candidate in range(count):
        gains.append(greedy.information_gain(candidate))
        greedy.choose(candidate)
    return np.stack(gains)
