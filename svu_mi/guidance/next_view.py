"""Capture guidance: which photograph to take next (Sec. 5.1). The file to read first.

    estimate + candidates -> forecast of some texels -> gain of every candidate -> the best view
                                   ^                                                   |
                                   +---------------- as if photographed ---------------+
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from numbers import Integral
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.errors import OptionError
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.forecaster import forecaster
from svu_mi.guidance.greedy import Greedy, Strategy, look
from svu_mi.guidance.options import GuidanceOptions
from svu_mi.guidance.result import Guidance, Proposal
from svu_mi.guidance.strategies import find_strategy
from svu_mi.pipeline import Estimate
from svu_mi.progress import Progress

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
            over parameters that do not say what photographs would show.
        SceneError: a candidate is no pinhole camera.
    """
    if not isinstance(count, Integral) or isinstance(count, bool) or count < 1:
        raise OptionError(
            f"next_best_view(): count must be at least 1, a whole number, got {count!r}."
        )
    options = _options(options, switches)
    source, progress = forecaster(estimate), progress or Progress()
    if candidates is None:
        candidates = _default(source.observed.capture)
    elif not isinstance(candidates, Candidates):
        candidates = Candidates.of(candidates)
    texels = source.observed.texels
    with progress.stage("Looking from the candidates"):
        chosen = _sample(texels.count, options)
        packed = source.pack(candidates.sensors)
        greedy = look(source, chosen, packed, options, candidates.reachable)
    before = float(greedy.entropy.mean())
    left_out = 1 - len(chosen) / texels.count
    with progress.stage("Choosing views", count) as stage:
        strategy = find_strategy(options, greedy, source.observed.capture, candidates)
        steps = []
        for step in _choices(strategy, greedy, candidates, count, left_out):
            steps.append(step)
            stage.update(len(steps), count)
    return Guidance(
        candidates=candidates,
        proposals=tuple(proposal for proposal, _ in steps),
        gains=steps[0][1],
        entropy=before,
        texels=texels,
        options=options,
        method=estimate.method,
        skipped=_skipped(greedy, candidates, texels.count),
        timings=progress.timings,
        _source=source,
    )


def _options(options: GuidanceOptions | None, switches: dict[str, Any]) -> GuidanceOptions:
    options = GuidanceOptions() if options is None else options
    if not isinstance(options, GuidanceOptions):
        raise OptionError(f"next_best_view(): options must be GuidanceOptions, got {options!r}.")
    known = asdict(options)
    for name in switches:
        if name not in known:
            raise OptionError(
                f"next_best_view(): unknown option {name!r}; there are {', '.join(known)}."
            )
    return replace(options, **switches)


def _default(capture: Capture) -> Candidates:
    """Sensors whose photograph is missing; one that is black, say, has been taken."""
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
    strategy: Strategy, greedy: Greedy, candidates: Candidates, count: int, left_out: float
) -> Iterator[tuple[Proposal, np.ndarray]]:
    """Choose the best candidate, take it as photographed, and so on.

    Args:
        strategy: what judges them.
        greedy: expected entropies.
        candidates: where to choose from.
        count: how many to choose; fewer if there are not as many.
        left_out: part of the texels that is not looked at.

    Yields:
        A proposal, and the gains (C,) of all candidates when it was chosen.
    """
    free = candidates.reachable.copy()
    for _ in range(min(count, int(free.sum()))):
        gains = np.where(free, strategy.gains(), np.nan)
        best = int(np.nanargmax(gains))
        yield _proposal(best, greedy, candidates, left_out), gains
        free[best] = False
        strategy.choose(best)
        if strategy is not greedy:
            greedy.choose(best)


def _proposal(
    candidate: int, greedy: Greedy, candidates: Candidates, left_out: float
) -> Proposal:
    change = greedy.texel_gains(candidate)
    sees = greedy.forecast.seen[greedy.photographs + candidate]
    return Proposal(
        candidate=candidate,
        name=candidates.names[candidate],
        sensor=candidates.sensors[candidate],
        gain=float(change.mean()),
        error=_standard_error(change, left_out),
        entropy=float((greedy.entropy - change).mean()),
        sees=float(sees.mean()),
        new=float((sees & greedy.unseen()).mean()),
    )


def _standard_error(change: np.ndarray, left_out: float) -> float:
    """Of the mean over all texels, from some of them; NaN from a single one."""
    if left_out == 0:
        return 0.0
    if len(change) < 2:
        return float("nan")
    return float(change.std(ddof=1) * np.sqrt(left_out / len(change)))


def _skipped(greedy: Greedy, candidates: Candidates, texels: int) -> dict[str, int]:
    sees = greedy.forecast.seen[greedy.photographs :][candidates.reachable]
    return {
        "texels not looked at": texels - greedy.forecast.count,
        "candidates that cannot be reached": int((~candidates.reachable).sum()),
        "candidates that see nothing": int((~sees.any(axis=1)).sum()),
        "pairs of candidate and texel that do not see each other": int((~sees).sum()),
        "pairs evaluated": greedy.evaluated,
    }
