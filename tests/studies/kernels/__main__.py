"""Time the kernels: PYTHONPATH=tests python -m studies.kernels [--quick]."""

from __future__ import annotations

from dataclasses import dataclass

from studies.command import Command, main
from studies.kernels.run import Kernels, find_bars
from studies.kernels.tables import kernel_tables
from svu_mi.bench.experiment import Experiment
from svu_mi.bench.study import Study

STUDY = Study(
    title="Kernels",
    experiment=lambda bench, asked: Experiment("kernels", [Kernels(bench, asked.cells[0])]),
    tables=kernel_tables, bars=find_bars,
    note="Medians of warm runs; compilation with an empty kernel cache.",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Timed(Command):
    """Speed and error of every kernel, what skipping saves, scaling, memory.

    The whole way, from files to a map, is that of the first object under the first light.
    """

    def study(self) -> Study:
        """Return what is measured."""
        return STUDY


if __name__ == "__main__":
    raise SystemExit(main(Timed))
