"""Capture guidance: which photograph to take next (Sec. 5.1). The file to read first.

estimate + candidates -> prospect of some texels -> gain of every candidate -> the best view
                               ^                                                   |
                               +---------------- as if photographed ---------------+
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from numbers import Integral
from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.greedy import Greedy
from svu_mi.guidance.guidance_options import GuidanceOptions
from svu_mi.guidance.guidance_result import Guidance, Proposal
from svu_mi.guidance.make_forecast import refuse_growing
from svu_mi.guidance.strategies import TABLE, Judge, Strategy
from svu_mi.guidance.strategy_inputs import Prospect
from svu_mi.pipeline import materialized
from svu_mi.posterior.estimate import Estimate, observations_of

AROUND = 100  # candidates that are placed when none are given


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

        E[H] = sum_psi p(psi | B, L') H(B'_psi, L')

    The truth may be any psi, as likely as the photographs B so far say; if it is psi, photographs
    B'_psi from all views, old and new, would have the entropy H. Nothing of a candidate is used
    but its geometry and the known light.

    Args:
        estimate: what the photographs so far say (``svu.estimate``).
        candidates: where photographs can be taken from, or live Mitsuba sensors; by default the
            sensors of the capture whose photograph is missing, or 100 views on a sphere around
            the object.
        count: how many to propose; each takes those before it as photographed.
        options: how candidates are judged.
        progress: shows what is going on and collects timings.
        **switches: single options instead, such as ``strategy="coverage"`` or ``texels=10_000``.

    Raises:
        OptionError: a count below 1, an unknown strategy, an option out of range, or an estimate
            that does not say what photographs would show, to a strategy that asks for it.
        SceneError: a candidate is not a pinhole camera.
    """
    _require(estimate, count)
    options = _options(options, switches).resolved(estimate.preset)
    progress = progress or Progress()
    strategy, observed = _strategy(options, estimate), observations_of(estimate, None)
    estimate = materialized(estimate, progress)
    candidates, texels = _candidates(candidates, observed.capture), observed.texels
    known = Prospect(estimate, observed, candidates, _sample(texels.count, options), options)
    with progress.stage("Viewing from the candidates"):
        judge = strategy.make(known)
        greedy = known.greedy if strategy.forecasts else None
    entropy = float(np.mean(np.array(estimate.entropy, np.float64)))
    with progress.stage("Choosing views", count) as stage:
        steps = []
        for step in _choices(judge, greedy, known, count, entropy):
            steps.append(step)
            stage.update(len(steps), count)
    return Guidance(
        candidates=candidates,
        proposals=tuple(proposal for proposal, _ in steps),
        gains=steps[0][1],
        entropy=entropy,
        texels=texels,
        options=options,
        method=estimate.method,
        skipped=_skipped(greedy, known),
        timings=progress.timings,
        _prospect=replace(known),  # without its forecast, which takes most of the memory
    )


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


def _strategy(options: GuidanceOptions, estimate: Estimate) -> Strategy:
    refuse_growing(estimate.method, options)
    strategy = TABLE[options.strategy]
    if strategy.method not in (None, estimate.method):
        raise OptionError(
            f"next_best_view(): {options.strategy} needs an estimate by "
            f"method={strategy.method!r}.",
            shell=f"--strategy {options.strategy} needs --method {strategy.method}.",
        )
    return strategy


def _options(options: GuidanceOptions | None, switches: dict[str, Any]) -> GuidanceOptions:
    options = GuidanceOptions() if options is None else options
    if not isinstance(options, GuidanceOptions):
        raise OptionError(f"next_best_view(): options must be GuidanceOptions, got {options!r}.")
    known = asdict(options)
    for name in switches:
        if name not in known:
            raise OptionError(
                f"next_best_view(): unknown option {name!r}; use one of {', '.join(known)}."
            )
    return replace(options, **switches)


def _candidates(given: Candidates | Sequence[Any] | None, capture: Capture) -> Candidates:
    """Return candidates; by default sensors without a photograph (a black one has been taken)."""
    if isinstance(given, Candidates):
        return given
    if isinstance(given, Sequence) and not isinstance(given, str):
        return Candidates.of(given)
    if given is not None:
        raise OptionError(
            f"next_best_view(): candidates must be Candidates or sensors, got {given!r}; "
            "place some with svu.Candidates.around(capture, count)."
        )
    unused = [view for view, used in enumerate(capture.used) if not used]
    missing = [view for view in unused if not np.isfinite(capture.images[view]).any()]
    return Candidates.at(capture, missing) if missing else Candidates.around(capture, AROUND)


def _sample(count: int, options: GuidanceOptions) -> np.ndarray:
    """Choose texels at equal steps of their order, in which neighbours are near each other."""
    if count <= options.texels:
        return np.arange(count)
    start = np.random.default_rng(options.seed).random()
    return np.floor((np.arange(options.texels) + start) * (count / options.texels)).astype(np.int64)


def _choices(
    judge: Judge, greedy: Greedy | None, known: Prospect, count: int, entropy: float
) -> Iterator[tuple[Proposal, np.ndarray]]:
    """Choose the best candidate again and again; yield proposals, and the gains (C,) of all."""
    free, seen = known.candidates.reachable.copy(), known.seen
    covered = seen[: known.photographs].any(axis=0)
    left_out = 1 - len(known.texels) / known.observed.texels.count
    for _ in range(min(count, int(free.sum()))):
        gains = np.where(free, judge.gains(), np.nan)
        best = int(np.nanargmax(gains))
        change = np.full(1, np.nan) if greedy is None else greedy.texel_gains(best)
        if greedy is not None and not greedy.forecast.lasting:
            entropy = float(greedy.entropy.mean())  # in the light of this step
        entropy -= float(change.mean())
        sees = seen[known.photographs + best]
        yield (
            Proposal(
                candidate=best,
                name=known.candidates.names[best],
                sensor=known.candidates.sensors[best],
                gain=float(change.mean()),
                error=_standard_error(change, left_out),
                entropy=entropy,
                sees=float(sees.mean()),
                new=float((sees & ~covered).mean()),
            ),
            gains,
        )
        free[best] = False
        covered |= sees
        judge.choose(best)
        if greedy is not None and greedy is not judge:
            greedy.choose(best)


def _standard_error(change: np.ndarray, left_out: float) -> float:
    """Of the mean over all texels, from some of them; NaN from a single one."""
    if np.isnan(change).all():
        return float("nan")
    if left_out == 0:
        return 0.0
    if len(change) < 2:
        return float("nan")
    return float(change.std(ddof=1) * np.sqrt(left_out / len(change)))


def _skipped(greedy: Greedy | None, known: Prospect) -> dict[str, int]:
    reachable = known.candidates.reachable
    sees = known.seen[known.photographs :][reachable]
    return {
        "texels not looked at": known.observed.texels.count - len(known.texels),
        "candidates that cannot be reached": int((~reachable).sum()),
        "candidates that see nothing": int((~sees.any(axis=1)).sum()),
        "pairs of candidate and texel that do not see each other": int((~sees).sum()),
        "pairs evaluated": 0 if greedy is None else greedy.evaluated,
    }
