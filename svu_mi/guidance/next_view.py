"""Capture guidance (Sec. 5.1): proposals for the next photograph. The file to read first.

    E[H] = sum_psi p(psi | B, L') H(B'_psi, L')                                  (Eq. 13)

1. Draw hypotheses psi of every texel from its posterior given the photographs B.
2. Predict the pixels of each candidate view for psi from geometry and light. Compute the entropy H
   of the posterior given existing and predicted pixels B'_psi, and average it over psi.
3. Propose the candidate with the lowest E[H], treat it as photographed, and repeat.

``make_forecast`` implements steps 1 and 2; ``greedy`` evaluates the candidates of step 3.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError, warn
from svu_mi.guidance.candidates import Candidates, candidates_or_default
from svu_mi.guidance.greedy import GreedyScorer
from svu_mi.guidance.guidance_options import GuidanceOptions, require_method, with_switches
from svu_mi.guidance.guidance_result import Guidance, Proposal
from svu_mi.guidance.strategies import TABLE, ViewScorer
from svu_mi.guidance.strategy_inputs import StrategyInputs
from svu_mi.pipeline import materialized
from svu_mi.posterior.estimate import Estimate, observations_of


def next_best_view(
    estimate: Estimate,
    candidates: Candidates | Sequence[Any] | None = None,
    count: int = 1,
    *,
    options: GuidanceOptions | None = None,
    progress: Progress | None = None,
    **switches: Any,
) -> Guidance:
    """Propose the next photographs by lowest expected entropy (Eq. 13).

    Only the geometry of a candidate and the known light are used, no pixels.

    Args:
        estimate: Posterior of the photographs so far (``svu.estimate``).
        candidates: Views to choose from, or Mitsuba sensors. Default: the capture's sensors
            without a photograph; if every sensor has one, 100 views on a sphere around the object.
        count: Number of proposals; each treats the earlier ones as photographed.
        options: Criterion and sample sizes (default: ``GuidanceOptions()``).
        progress: Receiver of stages and timings.
        **switches: Fields of ``options`` to replace: ``strategy="coverage"``, ``texels=10_000``.

    Raises:
        OptionError: a count below 1, an unknown strategy, an option out of range, or an estimate
            that cannot predict photographs although the strategy needs a forecast.
        SceneError: a candidate is not a pinhole camera.

    Example:
        >>> guidance = svu.next_best_view(estimate, count=2, texels=256)
        >>> guidance.candidates.count, len(guidance.proposals)
        (100, 2)
        >>> bool(guidance.proposals[1].entropy < guidance.entropy)
        True
    """
    if count < 1:
        raise OptionError(f"next_best_view(): count must be at least 1, got {count}.")
    options = with_switches(options, switches).resolved(estimate.preset)
    require_method(options, estimate.method)
    strategy = TABLE[options.strategy]
    progress = progress or Progress()
    observed = observations_of(estimate, None)
    estimate = materialized(estimate, progress)
    candidates = candidates_or_default(candidates, observed.capture)
    texels = _evenly_spaced(observed.texels.count, options)
    inputs = StrategyInputs(estimate, observed, candidates, texels, options)
    with progress.stage("Viewing from the candidates"):
        scorer = strategy.make_scorer(inputs)
        greedy = inputs.greedy if strategy.needs_forecast else None
    entropy = float(np.mean(np.array(estimate.entropy, np.float64)))
    with progress.stage("Choosing views", count) as stage:
        steps = []
        for step in _choose_views(scorer, greedy, inputs, count, entropy):
            steps.append(step)
            stage.update(len(steps), count)
    if len(steps) < count:
        warn(f"Only {len(steps)} of {count} views are proposed: there are no more candidates.")
    return Guidance(
        candidates=candidates,
        proposals=tuple(proposal for proposal, _ in steps),
        scores=steps[0][1],
        entropy=entropy,
        texels=observed.texels,
        options=options,
        method=estimate.method,
        skipped=_skipped(greedy, inputs),
        timings=progress.timings,
        _inputs=replace(inputs),  # drops the cached forecast, which takes most of the memory
    )


def _choose_views(
    scorer: ViewScorer, greedy: GreedyScorer | None, inputs: StrategyInputs, count: int,
    entropy: float,
) -> Iterator[tuple[Proposal, np.ndarray]]:  # fmt: skip
    """Yield the best candidate and all scores (C,), treating each choice as photographed."""
    free = inputs.candidates.reachable.copy()
    covered = np.asarray(inputs.seen[: inputs.photographs].any(axis=0))
    for _ in range(min(count, int(free.sum()))):
        scores = np.where(free, _valid(scorer.scores(), free, inputs.options.strategy), np.nan)
        best = int(np.nanargmax(scores))
        if greedy is not None and not greedy.forecast.is_separable:
            entropy = float(greedy.entropy.mean())  # with the light of this step
        proposal = _proposal(best, greedy, inputs, covered, entropy)
        yield proposal, scores
        entropy = proposal.entropy
        free[best] = False
        covered = covered | inputs.seen[inputs.photographs + best]
        scorer.choose(best)
        if greedy is not None and greedy is not scorer:
            greedy.choose(best)


def _valid(scores: Any, free: np.ndarray, strategy: str) -> np.ndarray:
    """Return the scores of a strategy; raise unless there is a number for each candidate."""
    scores = np.asarray(scores)
    if scores.shape != free.shape or np.isnan(scores[free]).any():
        wrong = "NaN" if scores.shape == free.shape else f"scores of shape {scores.shape}"
        raise OptionError(
            f"next_best_view(): the strategy {strategy!r} returned {wrong}; scores() must return "
            f"one number for each of the {len(free)} candidates, which follow the photographs in "
            "StrategyInputs."
        )
    return scores


def _proposal(
    best: int, greedy: GreedyScorer | None, inputs: StrategyInputs, covered: np.ndarray,
    entropy: float,
) -> Proposal:  # fmt: skip
    """Return the proposal of candidate ``best``; its gain is subtracted from ``entropy``."""
    gain = np.full(1, np.nan) if greedy is None else greedy.information_gain(best)
    sees = inputs.seen[inputs.photographs + best]
    return Proposal(
        candidate=best,
        name=inputs.candidates.names[best],
        sensor=inputs.candidates.sensors[best],
        gain=float(gain.mean()),
        error=_standard_error(gain, 1 - len(inputs.texels) / inputs.observed.texels.count),
        entropy=entropy - float(gain.mean()),
        sees=float(sees.mean()),
        new=float((sees & ~covered).mean()),
    )


def _standard_error(gain: np.ndarray, left_out: float) -> float:
    """Return the standard error of the mean gain; 0 if no texels were omitted, NaN for one.

    Differences of successive texels give the variance of evenly spaced samples [Wolter 1984].
    """
    if left_out == 0 and not np.isnan(gain).all():
        return 0.0
    if len(gain) < 2:
        return float("nan")
    return float(np.sqrt(np.square(np.diff(gain)).mean() / 2 * left_out / len(gain)))


def _evenly_spaced(count: int, options: GuidanceOptions) -> np.ndarray:
    """Return texels at equal steps of the texel order, in which neighbours are close."""
    if count <= options.texels:
        return np.arange(count)
    start = np.random.default_rng(options.seed).random()
    return np.floor((np.arange(options.texels) + start) * (count / options.texels)).astype(np.int64)


def _skipped(greedy: GreedyScorer | None, inputs: StrategyInputs) -> dict[str, int]:
    """Return numbers of skipped texels, candidates and pairs, and of evaluated pairs."""
    reachable = inputs.candidates.reachable
    sees = inputs.seen[inputs.photographs :][reachable]
    return {
        "texels not looked at": inputs.observed.texels.count - len(inputs.texels),
        "candidates that cannot be reached": int((~reachable).sum()),
        "candidates that see nothing": int((~sees.any(axis=1)).sum()),
        "pairs of candidate and texel that do not see each other": int((~sees).sum()),
        "pairs evaluated": 0 if greedy is None else greedy.evaluated,
    }


