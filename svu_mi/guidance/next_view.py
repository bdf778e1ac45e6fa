"""Capture guidance: which photograph to take next (Sec. 5.1). The file to read first.

    estimate + candidates -> forecast of some texels -> gain of every candidate -> the best view
                                   ^                                                   |
                                   +---------------- as if photographed ---------------+
"""

from __future__ import annotations

from collections.abc import Iterator
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
    candidates: Candidates | None = None,
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
        candidates: where photographs can be taken from; by default the sensors of the capture
            that have no photograph, or 100 views on a sphere around the object.
        count: how many to propose; each takes those before it as photographed.
        options: how candidates are judged.
        progress: shows what is going on and collects timings.
        **switches: single options instead, such as ``strategy="coverage"`` or ``texels=10_000``.

    Raises:
        OptionError: a count below 1, an unknown strategy, an option out of range, or an estimate
            over parameters that do not say what photographs would show.
        SceneError: a candidate is no pinhole camera.
    """
    if not isinstance(count, Integral) or count < 1:
        raise OptionError(
            f"next_best_view(): count must be at least 1, a whole number, got {count!r}."
        )
    options = _options(options, switches)
    source, progress = forecaster(estimate), progress or Progress()
    candidates = candidates or _default(source.observed.capture)
    texels = source.observed.texels
    with progress.stage("Looking from the candidates"):
        chosen = _sample(texels.count, options)
        greedy = look(source, chosen, candidates.sensors, options, candidates.reachable)
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
    try:
        return replace(options or GuidanceOptions(), **switches)
    except TypeError:
        known = ", ".join(asdict(GuidanceOptions()))
        name = sorted(set(switches) - set(asdict(GuidanceOptions())))[0]
        raise OptionError(
            f"next_best_view(): unknown option {name!r}; there are {known}."
        ) from None


def _default(capture: Capture) -> Candidates:
    if all(capture.used):
        return Candidates.around(capture, AROUND)
    return Candidates.without_photograph(capture)


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
        error=float(change.std() * np.sqrt(left_out / len(change))),
        entropy=float((greedy.entropy - change).mean()),
        sees=float(sees.mean()),
        new=float((sees & greedy.unseen()).mean()),
    )


def _skipped(greedy: Greedy, candidates: Candidates, texels: int) -> dict[str, int]:
    sees = greedy.forecast.seen[greedy.photographs :][candidates.reachable]
    return {
        "texels not looked at": texels - greedy.forecast.count,
        "candidates that cannot be reached": int((~candidates.reachable).sum()),
        "candidates that see nothing": int((~sees.any(axis=1)).sum()),
        "pairs of candidate and texel that do not see each other": int((~sees).sum()),
        "pairs evaluated": greedy.evaluated,
    }
