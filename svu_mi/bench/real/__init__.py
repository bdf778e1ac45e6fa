"""``svu bench real``: photographs that were left out, predicted from the others.

A real capture has no true textures to compare with; but it has photographs. ``left_out`` finds
light, gains and textures from some of them, ``ways`` say what the others should show, and
``score`` how far that holds.
"""

from __future__ import annotations

from svu_mi.bench.experiment import Bench, Experiment, Record
from svu_mi.bench.real.left_out import LeftOut
from svu_mi.bench.real.plots import draw_real
from svu_mi.bench.real.tables import real_tables
from svu_mi.bench.real.ways import MEANS, POSTERIOR
from svu_mi.bench.study import Asked, Study
from svu_mi.bench.text import Bar

MARGIN = 0.05  # of R^2 over texel means
HOLDS = (0.80, 0.97)  # part of the 90 % intervals that may hold


def _experiment(bench: Bench, asked: Asked) -> Experiment:
    assert asked.capture is not None
    return Experiment("real", [LeftOut(bench, asked.capture, asked.every)], whole=True)


def find_bars(record: Record) -> list[Bar]:
    """Return what predictions have to reach."""
    if not record["cells"]:
        return []
    (cell,) = record["cells"]
    ours, means = (cell["rows"][way.label] for way in (POSTERIOR, MEANS))
    if not ours["holds"]:
        return []
    holds = ours["holds"]["0.9"]
    return [
        Bar("R^2 of left-out photographs, over texel means", ours["r2"] - means["r2"], MARGIN,
            least=True),
        Bar("90 % intervals of left-out pixels hold", holds, HOLDS[0], least=True),
        Bar("90 % intervals of left-out pixels hold", holds, HOLDS[1]),
    ]  # fmt: skip


STUDY = Study(
    title="Photographs that were left out", experiment=_experiment, tables=real_tables,
    bars=find_bars, plots={"real": draw_real}, on_cells=False,
)  # fmt: skip
