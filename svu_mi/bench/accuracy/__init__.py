"""``svu bench accuracy``: how well every estimator agrees with a path-traced posterior and with
the truth.

``measure`` says what is measured on a cell, ``judge`` compares one posterior with the truth,
``summary`` has means over cells, ``tables`` and ``plots`` show them.
"""

from __future__ import annotations

from svu_mi.bench.accuracy.measure import Compared
from svu_mi.bench.accuracy.plots import curves, scatter, time_error
from svu_mi.bench.accuracy.summary import summarize
from svu_mi.bench.accuracy.tables import accuracy_tables
from svu_mi.bench.experiment import Bench, Experiment
from svu_mi.bench.study import Asked, Study


def _experiment(bench: Bench, asked: Asked) -> Experiment:
    subjects = (Compared(bench, cell, asked.variants) for cell in asked.cells)
    return Experiment("accuracy", subjects, whole=True)


STUDY = Study(
    title="Agreement with path tracing, and with the truth",
    experiment=_experiment,
    summary=lambda record: {**record, "summary": summarize(record["cells"])},
    tables=accuracy_tables,
    plots={"time_error": time_error, "scatter": scatter, "sparsification": curves},
)  # fmt: skip
