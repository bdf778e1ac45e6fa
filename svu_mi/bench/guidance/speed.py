"""What a step of guidance costs, how that grows, and what it costs by refitting."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from svu_mi.bench import clock
from svu_mi.bench.sizes import GuidanceSizes
from svu_mi.capture import Capture
from svu_mi.frequency import fit_sh, power_spectrum
from svu_mi.guidance.candidates import Candidates
from svu_mi.guidance.greedy import Greedy
from svu_mi.guidance.options import GuidanceOptions
from svu_mi.guidance.prospect import Prospect
from svu_mi.guidance.spectral import SpectrumForecast
from svu_mi.options import AnyPreset, Method, preset
from svu_mi.pipeline import Estimate, estimate, observed_of
from svu_mi.posterior import ParameterGrid, PrincipledGrid, spectrum_posterior
from svu_mi.posterior.spectrum import decay
from svu_mi.surface import texels

Record = dict[str, Any]


@dataclass(frozen=True)
class Chooser:
    """How views are chosen: the estimate, its grid, and how many truths Eq. 13 averages over."""

    label: str
    method: Method
    preset: AnyPreset
    grid: PrincipledGrid | ParameterGrid
    hypotheses: int

    def estimate(self, capture: Capture, side: int) -> Estimate:
        """Estimate what the photographs say, on ``side`` x ``side`` texels."""
        return estimate(
            capture, texels(capture.mesh, side), self.method, self.preset, grid=self.grid
        )


SPECTRUM = Chooser(
    "spectrum, 8 x 8 cells, all of them as truths", "spectrum",
    preset("default", parameters="specular"), ParameterGrid(8, 8), 64,
)  # fmt: skip
METHODS = (
    SPECTRUM,
    Chooser(
        "angular fixed, 8 x 8 cells, all rows as truths", "angular",
        preset("fixed", method="angular"), PrincipledGrid(8, 8, 8, known={"metallic": 0.0}), 64,
    ),
    Chooser(
        "angular, 8 x 8 x 8 cells, 8 truths", "angular", preset("default", method="angular"),
        PrincipledGrid(8, 8, 8), 8,
    ),
)  # fmt: skip


def measure_speed(capture: Capture, sizes: GuidanceSizes) -> Record:
    """Time steps of guidance.

    Args:
        capture: some photographs; texels that they do not show take part, too.
        sizes: of the benchmark.

    Returns:
        ``methods``: a record each (see ``_method``); ``refitting``: see ``_refitting``;
        ``photographs``.
    """
    methods = [_method(capture, chooser, sizes) for chooser in METHODS]
    fastest = methods[0]["points"][-1]["first"]
    return {
        "photographs": capture.count,
        "methods": methods,
        "refitting": _refitting(capture, sizes, fastest),
    }


def _method(capture: Capture, chooser: Chooser, sizes: GuidanceSizes) -> Record:
    """Time a method at every size.

    Returns:
        ``label``; ``points``: per size ``candidates``, ``texels``, ``prepare`` (what all steps
        start from), ``first`` (all candidates) and ``later`` (only what changes) seconds per
        view, medians; ``per_view``, of all three at the largest size; ``exponents``, of the growth
        of ``first`` with ``candidates`` and with ``texels``.
    """
    most, side = sizes.candidates[-1], sizes.speed_texels
    by_side = {s: chooser.estimate(capture, s) for s in (*sizes.fewer, side)}
    shapes = [(c, side) for c in sizes.candidates] + [(most, s) for s in sizes.fewer]
    points = {shape: _point(by_side[shape[1]], shape[0], chooser, sizes) for shape in shapes}
    full = points[most, side]
    by_candidates = [points[c, side] for c in sizes.candidates]
    by_texels = [points[most, s] for s in (*sizes.fewer, side)]
    return {
        "label": chooser.label,
        "points": [*(points[most, s] for s in sizes.fewer), *by_candidates],
        "per_view": (full["prepare"] + full["first"] + (sizes.added - 1) * full["later"])
        / sizes.added,
        "exponents": {
            "candidates": _exponent([p["candidates"] for p in by_candidates], by_candidates),
            "texels": _exponent([p["texels"] for p in by_texels], by_texels),
        },
    }


def _point(found: Estimate, candidates: int, chooser: Chooser, sizes: GuidanceSizes) -> Record:
    known, chosen = _prospect(found, candidates, chooser), np.arange(found.texels.count)

    def prepare() -> Any:
        return replace(known).forecast

    forecast = prepare()
    rounds = range(clock.WARM_UP + sizes.repeats)
    steps = [_steps(known.photographs, forecast, sizes.added) for _ in rounds][clock.WARM_UP:]
    return {
        "candidates": candidates,
        "texels": len(chosen),
        "prepare": statistics.median(seconds(prepare) for _ in range(sizes.repeats)),
        "first": statistics.median(one[0] for one in steps),
        "later": statistics.median(t for one in steps for t in one[1:]),
        "hypotheses": float(forecast.hypotheses.counts.numpy().mean()),
    }


def _prospect(found: Estimate, candidates: int, chooser: Chooser) -> Prospect:
    observed = observed_of(found, None)
    around, chosen = Candidates.around(observed.capture, candidates), np.arange(found.texels.count)
    return Prospect(
        found, observed, around, chosen, GuidanceOptions(hypotheses=chooser.hypotheses)
    )


def _steps(photographs: int, forecast: Any, added: int) -> list[float]:
    """Choose views; return the seconds of each."""
    times: list[float] = []
    state: list[Greedy] = []

    def step() -> None:
        if not state:
            state.append(Greedy(forecast, photographs))
        greedy = state[0]
        greedy.choose(int(np.argmax(greedy.gains())))

    for _ in range(added):
        times.append(seconds(step))
    return times


def _refitting(capture: Capture, sizes: GuidanceSizes, step: float) -> Record:
    """Evaluate Eq. 13 as it is written, for a sample of candidates and truths.

    For each candidate and each truth, photographs are made up, fitted with the light, and
    compared with every cell: by this package's own public functions, kernels compiled.

    Returns:
        ``seconds`` of one candidate and truth; ``evaluations`` of all; ``times``: all of them over
        ``step``, a step of guidance; ``once``: seconds for all candidates if each is fitted once,
        and its truths are spectra of the same fit.
    """
    chooser, most = SPECTRUM, sizes.candidates[-1]
    found = chooser.estimate(capture, sizes.speed_texels)
    known = _prospect(found, most, chooser)
    forecast = known.forecast
    assert isinstance(forecast, SpectrumForecast)
    views, table = known.photographs, forecast.responses.table()
    fits, posteriors = [], []
    for candidate in range(sizes.refits[0]):
        for cell in range(clock.WARM_UP + sizes.refits[1]):
            rows = table[[*range(views), views + candidate]]
            fit, compare = _refit(forecast, rows, cell)
            if cell >= clock.WARM_UP:
                fits.append(fit)
                posteriors.append(compare)
    fit, compare = statistics.median(fits), statistics.median(posteriors)
    evaluations = most * chooser.hypotheses
    return {
        "seconds": fit + compare, "evaluations": evaluations, "step": step,
        "times": (fit + compare) * evaluations / step,
        "once": most * (fit + chooser.hypotheses * compare),
    }  # fmt: skip


def _refit(forecast: SpectrumForecast, table: np.ndarray, cell: int) -> tuple[float, float]:
    """Return the seconds of a candidate's fit, light and photographs, and of its posterior."""
    directions, weights = np.moveaxis(table[..., 1:4], 0, 1), table[..., 0].T
    light, switches = np.moveaxis(table[..., 4:], 0, 1), forecast.switches
    level, Ks = divmod(cell, forecast.grid.shape[1])
    falloff = decay(switches, forecast.grid, forecast.prefilter)[level]
    degrees = np.arange(switches.degree + 1)
    shape = forecast.grid.specular_nodes[Ks] ** 2 * falloff ** (degrees**2)
    # Made-up photographs: one more right-hand side, whatever its values.
    both = np.concatenate([light, light], axis=2)
    fitted: list[Any] = []

    def fit() -> None:
        coefficients = fit_sh(
            directions, weights, both, switches.degree, switches.regularizer, switches
        )
        fitted[:] = [np.array(power_spectrum(coefficients))[..., : light.shape[2]]]

    def compare() -> Any:
        incoming = fitted[0]
        return spectrum_posterior(
            incoming, incoming * shape[None, :, None], forecast.grid, preset=switches, scale=1.0
        ).entropy()

    return seconds(fit), seconds(compare)


def seconds(function: Callable[[], Any]) -> float:
    """Return how long a function takes by the clock."""
    return clock.run(function).wall


def _exponent(sizes: list[int], points: list[Record]) -> float:
    """Slope of log time against log size."""
    if len(set(sizes)) < 2:
        return float("nan")
    return float(np.polyfit(np.log(sizes), np.log([p["first"] for p in points]), 1)[0])
