"""Capture guidance (Sec. 5.1): which photograph to take next. The file to read first.

    E[H] = sum_psi p(psi | B, L') H(B'_psi, L')                                  (Eq. 13)

1. Draw hypotheses psi of every texel from its posterior given the photographs B.
2. Predict what each candidate view would show of psi, from geometry and the known light alone.
   The posterior of existing and predicted pixels B'_psi has the entropy H; average it over psi.
3. Propose the candidate with the lowest E[H], treat it as photographed, and repeat.

``make_forecast`` has the first two steps, ``greedy`` the order of evaluation in the third.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np

from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.guidance.candidates import Candidates, candidates_or_default
from svu_mi.guidance.greedy import GreedyScorer
from svu_mi.guidance.guidance_options import GuidanceOptions, with_switches
from svu_mi.guidance.guidance_result import Guidance, Proposal
from svu_mi.guidance.make_forecast import require_band_limit
from svu_mi.guidance.strategies import ViewScorer, strategy_for
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
    """Propose photographs to take next: those with the lowest expected entropy (Eq. 13).

    Every psi may be the truth, with the probability that the photographs B give it. Nothing of a
    candidate is used but its geometry and the known light.

    Args:
        estimate: posterior of the photographs so far (``svu.estimate``).
        candidates: where photographs can be taken from, or live Mitsuba sensors; by default the
            sensors of the capture whose photograph is missing, or 100 views on a sphere around
            the object.
        count: number of proposals; each treats those before it as photographed.
        options: how candidates are compared.
        progress: shows the stages and collects timings.
        **switches: single options instead, such as ``strategy="coverage"`` or ``texels=10_000``.

    Raises:
        OptionError: a count below 1, an unknown strategy, an option out of range, or an estimate
            that cannot predict photographs, with a strategy that needs a forecast.
        SceneError: a candidate is not a pinhole camera.
    """
    _require(estimate, count)
    options = with_switches(options, switches).resolved(estimate.preset)
    require_band_limit(estimate.method, options)
    strategy = strategy_for(options.strategy, estimate.method)
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
        _inputs=replace(inputs),  # without its forecast, which takes most of the memory
    )


def _choose_views(
    scorer: ViewScorer, greedy: GreedyScorer | None, inputs: StrategyInputs, count: int,
    entropy: float,
) -> Iterator[tuple[Proposal, np.ndarray]]:  # fmt: skip
    """Yield the best candidate and the scores (C,) of all; treat it as photographed; repeat."""
    free = inputs.candidates.reachable.copy()
    covered = np.asarray(inputs.seen[: inputs.photographs].any(axis=0))
    for _ in range(min(count, int(free.sum()))):
        scores = np.where(free, scorer.scores(), np.nan)
        best = int(np.nanargmax(scores))
        if greedy is not None and not greedy.forecast.is_separable:
            entropy = float(greedy.entropy.mean())  # in the light of this step
        proposal = _proposal(best, greedy, inputs, covered, entropy)
        yield proposal, scores
        entropy = proposal.entropy
        free[best] = False
        covered = covered | inputs.seen[inputs.photographs + best]
        scorer.choose(best)
        if greedy is not None and greedy is not scorer:
            greedy.choose(best)


def _proposal(
    best: int, greedy: GreedyScorer | None, inputs: StrategyInputs, covered: np.ndarray,
    entropy: float,
) -> Proposal:  # fmt: skip
    """Return a candidate as a proposal: E[H] falls from ``entropy`` by its information gain."""
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
    """Return the standard error of the mean over all texels, of a part of them; NaN of one."""
    if np.isnan(gain).all():
        return float("nan")
    if left_out == 0:
        return 0.0
    if len(gain) < 2:
        return float("nan")
    return float(gain.std(ddof=1) * np.sqrt(left_out / len(gain)))


def _evenly_spaced(count: int, options: GuidanceOptions) -> np.ndarray:
    """Return texels at equal steps of their order, in which neighbours are near each other."""
    if count <= options.texels:
        return np.arange(count)
    start = np.random.default_rng(options.seed).random()
    return np.floor((np.arange(options.texels) + start) * (count / options.texels)).astype(np.int64)


def _skipped(greedy: GreedyScorer | None, inputs: StrategyInputs) -> dict[str, int]:
    """Return counts of what was not computed, by reason."""
    reachable = inputs.candidates.reachable
    sees = inputs.seen[inputs.photographs :][reachable]
    return {
        "texels not looked at": inputs.observed.texels.count - len(inputs.texels),
        "candidates that cannot be reached": int((~reachable).sum()),
        "candidates that see nothing": int((~sees.any(axis=1)).sum()),
        "pairs of candidate and texel that do not see each other": int((~sees).sum()),
        "pairs evaluated": 0 if greedy is None else greedy.evaluated,
    }


def _require(estimate: Any, count: Any) -> None:
    if not isinstance(estimate, Estimate):
        raise OptionError(
            f"next_best_view(): an estimate is needed, got a {type(estimate).__name__}; make one "
            "with svu.estimate(capture, texels)."
        )
    if not isinstance(count, Integral) or isinstance(count, bool) or count < 1:
        raise OptionError(
            f"next_best_view(): count must be at least 1, a whole number, got {count!r}."
        )
