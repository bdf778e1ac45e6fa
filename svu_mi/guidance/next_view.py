"""Capture guidance: which photograph to take next (Sec. 5.1). The file to read first.

    estimate + candidates -> forecast of some texels -> gain of every candidate -> the best view
                                   ^                                                   |
                                   +---------------- as if photographed ---------------+
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.poses import bounding_sphere
from svu_mi.capture.scene import to_world
from svu_mi.errors import OptionError
from svu_mi.guidance import baselines
from svu_mi.guidance.angular import AngularForecast
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.forecaster import Forecaster, forecaster
from svu_mi.guidance.greedy import Greedy, Strategy
from svu_mi.guidance.hypotheses import Hypotheses
from svu_mi.guidance.measures import SquaredError
from svu_mi.guidance.options import GuidanceOptions
from svu_mi.pipeline import Estimate
from svu_mi.progress import Progress
from svu_mi.surface import Texels

AROUND = 100  # candidates that are placed when none are given
CHUNK = 8192  # texels whose maps are computed at a time
LEAST = 1e-4  # of a parameter's variance that others are compared with


@dataclass(frozen=True)
class Proposal:
    """A view to photograph.

    Attributes:
        candidate: its number among the candidates.
        name: its label.
        sensor: where to take it from.
        gain: what is expected to become known: mean over texels of E[H] before and after, the
            proposals before it taken as photographed.
        error: standard error of that mean, as not all texels were looked at; 0 if they were.
        entropy: mean over texels of E[H] with this view.
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


@dataclass(frozen=True, kw_only=True)
class Guidance:
    """Which photographs to take next.

    Attributes:
        candidates: what there was to choose from.
        proposals: the best view, then the best one once that is taken, ...
        gains: (C,) float64, gain of every candidate as the next photograph, in the unit of the
            strategy (mean change of E[H], if by entropy); NaN where not reachable. With
            ``lazy``, an upper bound for candidates that were not looked at.
        entropy: mean over texels of the expected entropy so far: of photographs from the views
            there are, whatever the truth. Unseen texels count as 1.
        texels: the T texels.
        options: how candidates were judged.
        method: of the estimate.
        skipped: what was not computed, by reason, as counts.
        timings: seconds per stage, synchronised.
    """

    candidates: Candidates
    proposals: tuple[Proposal, ...]
    gains: np.ndarray
    entropy: float
    texels: Texels
    options: GuidanceOptions
    method: str
    skipped: dict[str, int]
    timings: dict[str, float] = field(default_factory=dict)
    _source: Forecaster | None = field(default=None, repr=False, compare=False)

    @property
    def ranking(self) -> np.ndarray:
        """Numbers of the reachable candidates as the next photograph, the best first."""
        order = np.argsort(-self.gains, kind="stable")
        return order[np.isfinite(self.gains[order])]

    def gain_maps(self) -> np.ndarray:
        """Return the gain of every texel by each proposal: (proposals, T) float32.

        That of all texels, not only of those that the candidates were judged by; 0 where the
        proposal does not see the texel.
        """
        assert self._source is not None
        maps = np.zeros((len(self.proposals), self.texels.count), np.float32)
        sensors = [proposal.sensor for proposal in self.proposals]
        for first in range(0, self.texels.count, CHUNK):
            chosen = np.arange(first, min(first + CHUNK, self.texels.count))
            greedy = _greedy(self._source, chosen, sensors, self.options)
            for k in range(len(sensors)):
                maps[k, chosen] = greedy.texel_gains(k)
                greedy.choose(k)
        return maps

    def image(self, proposal: int = 0) -> np.ndarray:
        """Return the gain of a proposal as an (H, W) float32 texture, 0 outside the charts.

        Raises:
            OptionError: there is no such proposal.
        """
        if not 0 <= proposal < len(self.proposals):
            raise OptionError(
                f"Guidance.image(): there are {len(self.proposals)} proposals, numbered from 0; "
                f"got {proposal}."
            )
        return self.texels.to_image(self.gain_maps()[proposal], 0.0)


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
    if count < 1:
        raise OptionError(f"next_best_view(): count must be at least 1, got {count}.")
    options = _options(options, switches)
    source, progress = forecaster(estimate), progress or Progress()
    candidates = candidates or _default(source.observed.capture)
    texels = source.observed.texels
    with progress.stage("Looking from the candidates"):
        chosen = _sample(texels.count, options)
        greedy = _greedy(source, chosen, candidates.sensors, options)
    before = float(greedy.entropy.mean())
    left_out = 1 - len(chosen) / texels.count
    with progress.stage("Choosing views", count) as stage:
        strategy = _strategy(options, greedy, source.observed.capture, candidates)
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


def _greedy(
    source: Forecaster, texels: np.ndarray, sensors: Any, options: GuidanceOptions
) -> Greedy:
    forecast = source.forecast(texels, sensors, options.hypotheses, options.seed)
    return Greedy(forecast, source.observed.views.number, lazy=options.lazy)


def _strategy(
    options: GuidanceOptions, greedy: Greedy, capture: Capture, candidates: Candidates
) -> Strategy:
    """Return what judges candidates."""
    forecast: Any = greedy.forecast
    angular = isinstance(forecast, AngularForecast)
    if options.strategy in ("error", "d-optimal") and not angular:
        raise OptionError(
            f"next_best_view(): {options.strategy} needs an estimate by method='angular'."
        )
    if options.strategy == "entropy":
        return greedy
    if options.strategy == "random":
        return baselines.Random(candidates.count, options.seed)
    if options.strategy == "coverage":
        return baselines.Coverage(forecast.seen, greedy.photographs)
    if options.strategy == "farthest":
        used = [s for s, u in zip(capture.sensors, capture.used, strict=True) if u]
        places = [to_world(sensor)[:3, 3] for sensor in (*used, *candidates.sensors)]
        center, _ = bounding_sphere(capture.shape)
        return baselines.Farthest(baselines.unit_directions(places, center), len(used))
    if options.strategy == "error":
        judged = replace(forecast, measure=_error(forecast, greedy))
        return Greedy(judged, greedy.photographs, lazy=options.lazy)
    most_probable, _ = forecast.hypotheses.at(0, np.arange(forecast.count))
    table = forecast.responses.table()
    cells = np.array(most_probable).astype(np.int64)
    slopes = baselines.jacobians(table, forecast.grid, cells)
    return baselines.DOptimal(slopes, forecast.seen, greedy.photographs)


def _error(forecast: AngularForecast, greedy: Greedy) -> SquaredError:
    """Return the measure of squared errors, relative to those of texels seen so far."""
    shape = forecast.grid.shape
    energies = np.zeros(shape) if forecast.prior is None else np.array(forecast.prior)
    weights = np.exp(-energies.reshape(1, -1).astype(np.float64))
    prior = Hypotheses.of(weights / weights.sum()).variances(forecast.grid)[:, 0]
    known = forecast.hypotheses.variances(forecast.grid)[:, ~greedy.unseen()]
    present = known.mean(axis=1) if known.size else prior
    # A parameter that is known has no error to lower.
    present = np.maximum(present, LEAST)
    return SquaredError(present=tuple(present.tolist()), prior=tuple(prior.tolist()))


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
    sees = greedy.forecast.seen[greedy.photographs :]
    return {
        "texels not looked at": texels - greedy.forecast.count,
        "candidates that cannot be reached": int((~candidates.reachable).sum()),
        "candidates that see nothing": int((~sees.any(axis=1)).sum()),
        "pairs of candidate and texel that do not see each other": int((~sees).sum()),
        "pairs evaluated": greedy.evaluated,
    }
