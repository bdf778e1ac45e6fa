"""``svu bench speed``: run times, and how they trade against agreement with the reference."""

from __future__ import annotations

from svu_mi.bench.experiment import Bench, Experiment
from svu_mi.bench.speed.measure import Timing
from svu_mi.bench.speed.tables import scaling, speed_tables
from svu_mi.bench.study import Asked, Study


def _experiment(bench: Bench, asked: Asked) -> Experiment:
    return Experiment("speed", [Timing(bench, asked.cells[0], asked.variants)], whole=True)


STUDY = Study(title="Run times", experiment=_experiment, tables=speed_tables,
              plots={"scaling": scaling})  # fmt: skip
