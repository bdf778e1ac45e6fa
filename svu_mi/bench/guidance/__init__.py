"""``svu bench guidance``: which views to photograph, and what each of them is worth.

``curves`` adds views to a start, one by one, by every strategy, and recovers textures from them;
``verdict`` says how many views each needs, and whether that is luck.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from svu_mi.bench.cells import Cell
from svu_mi.bench.experiment import Bench, Experiment
from svu_mi.bench.guidance.curves import Shoot
from svu_mi.bench.guidance.plots import draw_guidance
from svu_mi.bench.guidance.tables import guidance_tables
from svu_mi.bench.guidance.verdict import find_bars
from svu_mi.bench.study import Asked, Study


def _experiment(bench: Bench, asked: Asked) -> Experiment:
    sizes = bench.sizes.guidance
    chosen = few_lights(asked.cells, sizes.lights)
    # Every cell once before any twice: an interrupted run has seen them all.
    starts = itertools.product(range(sizes.starts), sizes.kinds, chosen)
    subjects = (Shoot(bench, cell, number, kind) for number, kind, cell in starts)
    return Experiment("guidance", subjects, whole=True)


def few_lights(cells: Sequence[Cell], count: int) -> list[Cell]:
    """Return the first ``count`` cells of every object."""
    kept: list[Cell] = []
    for cell in cells:
        if sum(one.object == cell.object for one in kept) < count:
            kept.append(cell)
    return kept


STUDY = Study(
    title="Views to photograph next", experiment=_experiment, tables=guidance_tables,
    bars=find_bars, plots={"guidance": draw_guidance},
)  # fmt: skip
