"""The strategies by name."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.poses import bounding_sphere, directions_of
from svu_mi.errors import OptionError
from svu_mi.guidance import baselines
from svu_mi.guidance.angular import AngularForecast
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.greedy import Greedy, Strategy
from svu_mi.guidance.hypotheses import Hypotheses
from svu_mi.guidance.measures import SquaredError
from svu_mi.guidance.options import GuidanceOptions

LEAST = 1e-4  # of a parameter's variance that others are compared with


def find_strategy(
    options: GuidanceOptions, greedy: Greedy, capture: Capture, candidates: Candidates
) -> Strategy:
    """Return what judges candidates.

    Args:
        options: say which.
        greedy: the one of lowest expected entropy.
        capture: the photographs so far.
        candidates: what there is to choose from.

    Raises:
        OptionError: the strategy needs another kind of estimate.
    """
    forecast, name = greedy.forecast, options.strategy
    if name == "entropy":
        return greedy
    if name == "random":
        return baselines.Random(candidates.count, options.seed)
    if name == "coverage":
        return baselines.Coverage(forecast.seen, greedy.photographs)
    if name == "farthest":
        used = capture.used_sensors
        center, _ = bounding_sphere(capture.shape)
        directions = directions_of((*used, *candidates.sensors), center)
        return baselines.Farthest(directions, len(used))
    if not isinstance(forecast, AngularForecast):
        raise OptionError(f"next_best_view(): {name} needs an estimate by method='angular'.")
    if name == "error":
        judged = replace(forecast, grazing=True, measure=_error(forecast, greedy))
        return Greedy(judged, greedy.photographs, candidates.reachable, lazy=options.lazy)
    return _d_optimal(forecast, greedy.photographs)


def _d_optimal(forecast: AngularForecast, photographs: int) -> baselines.DOptimal:
    most_probable, _ = forecast.hypotheses.at(0, dr.arange(mi.UInt32, forecast.count))
    cells = np.array(most_probable).astype(np.int64)
    slopes = baselines.jacobians(forecast.responses.table(), forecast.grid, cells)
    return baselines.DOptimal(slopes, forecast.seen, photographs)


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
