"""Result of ``next_best_view``: proposals, scores of all candidates, maps of gain."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.core.checked_arguments import checked
from svu_mi.errors import OptionError
from svu_mi.geometry.neighbors import texel_squares
from svu_mi.geometry.texels import Texels
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.guidance_options import GuidanceOptions
from svu_mi.guidance.strategy_inputs import StrategyInputs

CHUNK = 8192  # texels per launch of a gain map
MAP_SIZE = 128  # values along the longer side of a gain map; finer maps show sampling noise
SHOWN_NAMES = 3  # proposals named by __repr__


@dataclass(frozen=True)
class Proposal:
    """A view to photograph.

    Attributes:
        candidate: Index among the candidates.
        name: Label.
        sensor: Mitsuba sensor with the pose.
        gain: Expected information gain: mean decrease of E[H] over texels, with the earlier
            proposals treated as photographed. NaN for strategies without a forecast.
        error: Standard error of ``gain`` from evaluating only some texels: 0 if all were
            evaluated; NaN for a single texel or without a forecast. The error of drawing
            hypotheses, which all candidates share, is not included.
        entropy: Expected mean entropy with this view: present entropy minus the gains up to
            this proposal. NaN without a forecast.
        sees: Fraction of the texels that the view sees, in [0, 1].
        new: Fraction of the texels that no photograph or earlier proposal sees, in [0, 1].
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
    """Proposals for the next photographs, and the scores of all candidates.

    Attributes:
        candidates: All candidates.
        proposals: Proposed views in order; each treats the earlier ones as photographed.
        scores: (C,) float64, score of every candidate as the next photograph, in the unit of the
            strategy (entropy: mean decrease of E[H]); NaN if unreachable.
        entropy: Mean entropy of the photographs so far over all texels; unseen texels have the
            entropy of the prior (``Posterior.prior_entropy``).
        texels: The T texels.
        options: Options of ``next_best_view``.
        method: Method of the estimate.
        skipped: Numbers of skipped texels, candidates and pairs, and of evaluated pairs.
        timings: Seconds per stage, synchronised.

    Example:
        >>> guidance = svu.next_best_view(estimate, strategy="coverage")
        >>> guidance.scores.shape, guidance.image(0).shape
        ((100,), (64, 64))
        >>> bool(guidance.ranking[0] == guidance.proposals[0].candidate)
        True
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
        """Indices of the reachable candidates by score, best first."""
        order = np.argsort(-self.scores, kind="stable")
        return order[np.isfinite(self.scores[order])]

    def gain_maps(self) -> np.ndarray:
        """Return the gain of every texel by each proposal, (proposals, T) float32.

        Includes texels that were not evaluated for the ranking; 0 if the proposal does not see
        the texel. If a side has more than 128 texels, blocks of texels (2 x 2 for a side
        of 256) share one value. Computed by a forecast on first use, whatever the strategy.

        Raises:
            OptionError: the estimate cannot predict photographs.
        """
        return self._maps.copy()

    @cached_property
    def _maps(self) -> np.ndarray:
        assert self._inputs is not None
        maps = np.zeros((len(self.proposals), self.texels.count), np.float32)
        proposed = Candidates.of([proposal.sensor for proposal in self.proposals])
        everywhere = replace(self._inputs, candidates=proposed, texels=np.arange(self.texels.count))
        seen = everywhere.trace()  # other texels gain nothing
        shown = np.flatnonzero(seen.any(axis=0))
        first, block = self._blocks(shown)
        if shown.size:
            parts = np.array_split(first, -(-len(first) // CHUNK))
            gains = [_texel_information_gain(replace(everywhere, texels=part)) for part in parts]
            maps[:, shown] = np.hstack(gains)[:, block] * seen[:, shown]
        return maps

    def _blocks(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Group (t,) texels in blocks; return one texel per block and each texel's block, (t,)."""
        side = -(-max(self.texels.resolution) // MAP_SIZE)
        row, column = texel_squares(self.texels)[chosen].T
        of_block = row // side * MAP_SIZE + column // side
        _, first, block = np.unique(of_block, return_index=True, return_inverse=True)
        first, block = np.unique(first[block], return_inverse=True)  # in the order of texels
        return chosen[first], block

    @checked
    def image(self, proposal: int = 0) -> np.ndarray:
        """Return the gain of a proposal as an (H, W) float32 texture, 0 outside the charts.

        Raises:
            OptionError: ``proposal`` is out of range.
        """
        if not 0 <= proposal < len(self.proposals):
            raise OptionError(
                f"Guidance.image(): proposal must be 0 to {len(self.proposals) - 1}, "
                f"got {proposal}."
            )
        return self.texels.to_image(self._maps[proposal], 0.0)


def _texel_information_gain(inputs: StrategyInputs) -> np.ndarray:
    """Return every texel's information gain as candidates are added in order, (C, t)."""
    known, count, forecast = inputs.photographs, inputs.candidates.count, inputs.forecast
    if forecast.is_separable:
        steps = forecast.cumulative(np.arange(known), known + np.arange(count))
        return steps[:-1] - steps[1:]
    greedy, gains = inputs.greedy, []
    for candidate in range(count):
        gains.append(greedy.information_gain(candidate))
        greedy.choose(candidate)
    return np.stack(gains)
