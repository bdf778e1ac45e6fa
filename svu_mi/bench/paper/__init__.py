"""``svu bench paper``: Tables 2 and 3 and Figure 9, with the paper's methods and with ours.

Table 1 is ``svu bench orb``. Figures 2 to 8 show single texels and results of Table 2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from svu_mi.bench.cases import Case
from svu_mi.bench.experiment import BenchRun, Experiment, Record, Subject
from svu_mi.bench.guidance import first_lights
from svu_mi.bench.paper.figure9 import Figure9, draw_figure9, figure9_tables
from svu_mi.bench.paper.table2 import Table2, table2_tables
from svu_mi.bench.paper.table3 import Table3, table3_tables
from svu_mi.bench.study import Selection, Study
from svu_mi.core.validation import require_known

PARTS: dict[
    str, tuple[Callable[[BenchRun, Case], Subject], Callable[[list[Record]], list[str]]]
] = {
    "table3": (Table3, table3_tables),
    "table2": (Table2, table2_tables),
    "figure9": (Figure9, figure9_tables),
}
# Lights of svu_mi's scenes; cases of a folder have the same number of lights.
LIGHTS = {"table2": ("window", "studio", "overcast"), "figure9": ("window", "studio")}


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    require_known(selection.rows, PARTS, "part of the paper")
    return Experiment("paper", _subjects(bench, selection), whole=True)


def _subjects(bench: BenchRun, selection: Selection) -> Iterator[Subject]:
    for part, (subject, _) in PARTS.items():
        if selection.rows and part not in selection.rows:
            continue
        cases = list(selection.cases)
        if part in LIGHTS and selection.data is None:
            cases = [case for case in cases if case.light in LIGHTS[part]]
        elif part in LIGHTS:
            cases = first_lights(cases, len(LIGHTS[part]))
        yield from (subject(bench, case) for case in cases)


def _tables(record: Record) -> list[str]:
    sections = []
    for part, (_, tables) in PARTS.items():
        cases = [case for case in record["cells"] if case["part"] == part]
        sections += tables(cases) if cases else []
    return sections


STUDY = Study(
    title="Tables and figures of the paper", experiment=_experiment, tables=_tables, own_sizes=True,
    plots={"figure9": draw_figure9},
)  # fmt: skip
