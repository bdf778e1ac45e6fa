"""What a step of guidance costs, how that grows, and what it costs by refitting.

    PYTHONPATH=tests python -m studies.guidance_steps [--quick] [--data FOLDER] [--objects A]
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from studies import clock
from studies.command import Command, main
from svu_mi.bench.captures import some_views
from svu_mi.bench.experiment import Experiment, OnCell, Record
from svu_mi.bench.study import Study
from svu_mi.bench.text import Bar, Column, columns, digits
from svu_mi.bench.text import seconds as shown
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

PHOTOGRAPHS = 10
SECONDS, TIMES, LINEAR = 1.0, 200.0, 1.25  # per added view, over refitting, of the exponent


@dataclass(frozen=True, kw_only=True)
class StepSizes:
    """How much is measured.

    Attributes:
        texels: per side, where steps are timed.
        candidates: numbers of candidates that steps are timed with, the last for the bars.
        fewer: texels per side that steps are timed with, too.
        added: views chosen in a timed run.
        refits: candidates and truths that are evaluated by refitting, as a sample.
        repeats: warm runs, of which the median counts.
    """

    texels: int = 64
    candidates: tuple[int, ...] = (25, 50, 100)
    fewer: tuple[int, ...] = (32, 45)
    added: int = 5
    refits: tuple[int, int] = (2, 3)
    repeats: int = 5


FULL = StepSizes()
QUICK = StepSizes(texels=16, candidates=(4, 8), fewer=(8,), added=2, refits=(1, 1), repeats=1)


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


@dataclass(frozen=True)
class Refitting:
    """Eq. 13 as it is written, beside the ways that are timed."""

    label: str = "refitting"


@dataclass(frozen=True)
class Steps(OnCell):
    """A cell with some photographs, whose next views are chosen.

    Texels that the photographs do not show take part, too.

    Attributes:
        sizes: how much is measured.
    """

    sizes: StepSizes

    @property
    def rows(self) -> tuple[Chooser | Refitting, ...]:
        return (*METHODS, Refitting())

    def settings(self, row: Chooser | Refitting | None) -> Any:
        return super().settings(row), asdict(self.sizes)

    def head(self) -> Record:
        """Return ``cell`` and number of ``photographs``."""
        return {**super().head(), "photographs": self.capture.count}

    def measure(self, row: Chooser | Refitting) -> Record:
        """Return what ``_method`` or ``_refitting`` returns."""
        if row in METHODS:
            return _method(self.capture, row, self.sizes)
        return _refitting(self.capture, self.sizes)

    @cached_property
    def capture(self) -> Capture:
        """The photographs."""
        return some_views(self.bench.capture(self.cell), PHOTOGRAPHS)


def _method(capture: Capture, chooser: Chooser, sizes: StepSizes) -> Record:
    """Time a method at every size.

    Returns:
        ``label``; ``points``: per size ``candidates``, ``texels``, ``prepare`` (what all steps
        start from), ``first`` (all candidates) and ``later`` (only what changes) seconds per
        view, medians; ``per_view``, of all three at the largest size; ``exponents``, of the growth
        of ``first`` with ``candidates`` and with ``texels``.
    """
    most, side = sizes.candidates[-1], sizes.texels
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


def _point(found: Estimate, candidates: int, chooser: Chooser, sizes: StepSizes) -> Record:
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


def _refitting(capture: Capture, sizes: StepSizes) -> Record:
    """Evaluate Eq. 13 as it is written, for a sample of candidates and truths.

    For each candidate and each truth, photographs are made up, fitted with the light, and
    compared with every cell: by this package's own public functions, kernels compiled.

    Returns:
        ``seconds`` of one candidate and truth; ``evaluations`` of all; ``once``: seconds for all
        candidates if each is fitted once, and its truths are spectra of the same fit.
    """
    chooser, most = SPECTRUM, sizes.candidates[-1]
    found = chooser.estimate(capture, sizes.texels)
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
    return {
        "seconds": fit + compare,
        "evaluations": most * chooser.hypotheses,
        "once": most * (fit + chooser.hypotheses * compare),
    }


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


def _step(cell: Record) -> float:
    """Return the seconds of a step of guidance by spectra, which refitting is held against."""
    return cell["rows"][SPECTRUM.label]["points"][-1]["first"]


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of a record."""
    return [bar for cell in record["cells"] for bar in _bars(cell)]


def _bars(cell: Record) -> Iterable[Bar]:
    for chooser in METHODS:
        row = cell["rows"][chooser.label]
        yield Bar(f"{chooser.label}: time per added view", row["per_view"], SECONDS, "s")
        for axis, exponent in row["exponents"].items():
            yield Bar(f"{chooser.label}: time grows with {axis} to the power of", exponent, LINEAR)
    refit = cell["rows"][Refitting.label]
    times = refit["seconds"] * refit["evaluations"] / _step(cell)
    what = "Eq. 13 by refitting every candidate for every truth, over one step"
    yield Bar(what, times, TIMES, "times", least=True)


POINTS = (
    Column("method", lambda line: line[0]),
    Column("candidates", lambda line: line[1]["candidates"]),
    Column("texels", lambda line: line[1]["texels"]),
    Column("truths", lambda line: line[1]["hypotheses"], digits(1)),
    Column("prepare", lambda line: line[1]["prepare"], shown),
    Column("first", lambda line: line[1]["first"], shown),
    Column("later", lambda line: line[1]["later"], shown),
)


def tables(record: Record) -> list[str]:
    """Return the tables of a record."""
    return [text for cell in record["cells"] for text in _tables(cell)]


def _tables(cell: Record) -> list[str]:
    refit, step = cell["rows"][Refitting.label], _step(cell)
    points = [(chooser.label, point) for chooser in METHODS
              for point in cell["rows"][chooser.label]["points"]]  # fmt: skip
    whole = refit["seconds"] * refit["evaluations"]
    return [
        f"{cell['cell']}, {cell['photographs']} photographs; warm, medians. Prepare: once, all "
        "views of all texels; first: every candidate; later: what the view before has changed.",
        columns(POINTS, points),
        f"Refitting one candidate for one truth takes {shown(refit['seconds'])} (fits, spectra, "
        f"posterior; kernels compiled); all {refit['evaluations']} would take {shown(whole)}, "
        f"{whole / step:.0f} times as long as the step by rank-1 changes ({shown(step)}). With "
        "one fit per candidate, as spectra of truths follow from that of the light: "
        f"{shown(refit['once'])}, {refit['once'] / step:.0f} times as long.",
    ]


STUDY = Study(
    title="Time per added view",
    experiment=lambda bench, asked: Experiment(
        "guidance_steps", [Steps(bench, asked.cells[0], QUICK if bench.quick else FULL)], True
    ),
    tables=tables, bars=find_bars,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class GuidanceSteps(Command):
    """What choosing a view costs, for the first object under the first light."""

    def study(self) -> Study:
        """Return what is measured."""
        return STUDY


if __name__ == "__main__":
    raise SystemExit(main(GuidanceSteps))
