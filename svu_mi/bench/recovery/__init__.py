"""``svu bench recovery``: textures recovered from photographs, against the true ones.

``rows`` says what is compared, ``measure`` runs and times one row on a cell, ``judge`` compares it
with the truth.
"""

from __future__ import annotations

from functools import partial

from svu_mi.bench.experiment import Bench, Experiment
from svu_mi.bench.recovery.bars import find_bars
from svu_mi.bench.recovery.measure import Recovered, under_another_light
from svu_mi.bench.recovery.plots import draw_recovery
from svu_mi.bench.recovery.rows import choose_rows
from svu_mi.bench.recovery.tables import recovery_tables
from svu_mi.bench.study import Asked, Study


def _experiment(bench: Bench, asked: Asked) -> Experiment:
    sizes = bench.sizes.recovery
    rows = choose_rows(asked.rows or sizes.rows)
    subjects = (
        Recovered(bench, cell, partial(under_another_light, cell, asked.data, bench.folder), rows)
        for cell in asked.cells[: sizes.even_cells]
    )
    return Experiment("recovery", subjects)


STUDY = Study(
    title="Recovery of textures", experiment=_experiment, tables=recovery_tables, bars=find_bars,
    note="PSNR: means over the cells that have both rows. Times: medians over cells of ratios.",
    plots={"recovery": draw_recovery},
)  # fmt: skip
