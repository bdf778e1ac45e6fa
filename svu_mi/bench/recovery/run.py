"""Run the recovery benchmark, cell by cell and row by row; what is finished is kept."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from svu_mi.bench.accuracy import Bench
from svu_mi.bench.cells import Cell
from svu_mi.bench.recovery.bars import find_bars
from svu_mi.bench.recovery.cells import Task, even_tasks, sharing_tasks
from svu_mi.bench.recovery.costs import measure_costs
from svu_mi.bench.recovery.options import COSTS, Options
from svu_mi.bench.recovery.rows import Row, choose_rows
from svu_mi.bench.recovery.setting import PLACE, Setting, code_now, take_up
from svu_mi.bench.recovery.sizes import FULL, QUICK, Sizes
from svu_mi.bench.store import Store, key_of
from svu_mi.errors import SvuError, SvuWarning

Record = dict[str, Any]


def run_recovery(
    bench: Bench,
    cells: Sequence[Cell],
    options: Options | None = None,
    *,
    finished: Callable[[Record], None] | None = None,
) -> Record:
    """Recover textures of every cell in every way, and compare them with the true ones.

    Args:
        bench: where, and how large.
        cells: objects x lights, photographed from everywhere.
        options: what is run.
        finished: called with the record so far after each cell.

    Returns:
        ``cells``: a record each, with ``group``, ``rows`` by label, and counts of texels;
        ``costs``: what ``measure_costs`` returns, or None; ``bars``; ``failed`` rows; number of
        ``versions`` of the code; ``sizes`` and ``quick``.

    Raises:
        OptionError: an unknown row.
        SvuError: that of the first cell, if everything failed.
        OutputError: the folder cannot be written.
    """
    options = options or Options()
    sizes = options.sizes or (QUICK if bench.quick else FULL)
    tasks = _tasks(bench, cells, options, sizes)
    record: Record = {"cells": [], "costs": None, "bars": [], "failed": [], "sizes": sizes,
                      "quick": bench.quick, "versions": 0}  # fmt: skip
    run = Run(bench, sizes, options, record)
    traced: dict[str, int] = {}
    for task in tasks:
        allowed = task.group == "even" or traced.get(task.group, 0) < sizes.path_cells
        traced[task.group] = traced.get(task.group, 0) + 1
        run.add(task, choose_rows(options.rows or sizes.rows, task.group, traced=allowed))
        _tell(record, finished)
    if not record["cells"] and run.first is not None:
        raise run.first
    if COSTS in options.groups:
        record["costs"] = _costs(bench, cells[0], sizes, options)
    _tell(record, finished)
    return record


def _tasks(bench: Bench, cells: Sequence[Cell], options: Options, sizes: Sizes) -> list[Task]:
    """Return tasks of the chosen groups, in the order they are run."""
    tasks = list(even_tasks(cells[: sizes.even_cells], options.data, bench.folder))
    if {"repeated", "varied"} & set(options.groups):
        tasks += sharing_tasks(options.data, bench.folder, quick=bench.quick)
    return [task for task in tasks if task.group in options.groups]


def _tell(record: Record, finished: Callable[[Record], None] | None) -> None:
    record["bars"] = find_bars(record)
    found = [row["code"] for cell in record["cells"] for row in cell["rows"].values()]
    record["versions"] = len(set(found))
    if finished is not None:
        finished(record)


@dataclass
class Run:
    """A run under way.

    Attributes:
        bench: where and how.
        sizes: how large.
        options: what is run.
        record: gets the cells, and the rows that failed.
        first: what the first of these raised.
    """

    bench: Bench
    sizes: Sizes
    options: Options
    record: Record
    first: SvuError | None = None

    def add(self, task: Task, rows: Iterable[Row]) -> None:
        """Add the record of a cell: the rows that are there, or that could be run."""
        setting = Setting(self.bench, task, self.sizes)
        found = {}
        for row in rows:
            try:
                record = self._row(setting, row)
            except SvuError as error:
                self._fail(f"{task.title} ({task.group}): {row.label}", error)
                continue
            if record is not None:
                found[row.label] = record
        if found:
            head = next(iter(found.values()))["cell"]
            self.record["cells"].append({**head, "rows": found})

    def _row(self, setting: Setting, row: Row) -> Record | None:
        record = None
        if not self.bench.fresh:
            record = setting.stored(row, any_version=self.options.any_version)
        if record is not None or self.options.stored:
            return record
        title = f"{setting.task.title} ({setting.task.group}): {row.label}"
        with self.bench.progress.stage(title):
            return setting.measure(row)

    def _fail(self, what: str, error: SvuError) -> None:
        self.first = self.first or error
        self.record["failed"].append({"cell": what, "reason": str(error)})
        warnings.warn(f"{what} is left out: {error}", SvuWarning, stacklevel=2)


def _costs(bench: Bench, cell: Cell, sizes: Sizes, options: Options) -> Record | None:
    store, key = Store(bench.folder / PLACE), key_of(cell.name, asdict(sizes))
    record = None
    if not bench.fresh:
        record = take_up(store, "costs", key, any_version=options.any_version)
    if record is not None or options.stored:
        return record
    with bench.progress.stage("Timing single steps"):
        found = measure_costs(bench, cell, sizes)
        return store.save("costs", key, {"code": code_now(), **found})
