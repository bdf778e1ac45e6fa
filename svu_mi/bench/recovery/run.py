"""Run the recovery benchmark, cell by cell and row by row; what is finished is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

from svu_mi.bench.accuracy import Bench
from svu_mi.bench.cells import Cell
from svu_mi.bench.failures import Failures
from svu_mi.bench.recovery.bars import find_bars
from svu_mi.bench.recovery.cells import Task, even_tasks, sharing_tasks
from svu_mi.bench.recovery.costs import measure_costs
from svu_mi.bench.recovery.options import COSTS, Options
from svu_mi.bench.recovery.rows import Row, choose_rows
from svu_mi.bench.recovery.setting import PLACE, Setting
from svu_mi.bench.store import Store, code_and_machine, key_of

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
    sizes = bench.sizes.recovery
    tasks = _tasks(bench, cells, options)
    run = Run(bench, options)
    record: Record = {"cells": run.cells, "costs": None, "bars": [], "failed": run.failures.found,
                      "sizes": sizes, "quick": bench.quick, "versions": 0}  # fmt: skip
    traced: dict[str, int] = {}
    for task in tasks:
        allowed = task.group == "even" or traced.get(task.group, 0) < sizes.path_cells
        traced[task.group] = traced.get(task.group, 0) + 1
        run.add(task, choose_rows(options.rows or sizes.rows, task.group, traced=allowed))
        _tell(record, finished)
    run.failures.raise_unless(run.cells)
    if COSTS in options.groups:
        store, key = Store(bench.folder / PLACE), key_of(cells[0].name, asdict(sizes))
        measure = partial(measure_costs, bench, cells[0])
        record["costs"] = run.recall(store, "costs", key, "Timing single steps", measure)
    _tell(record, finished)
    return record


def _tasks(bench: Bench, cells: Sequence[Cell], options: Options) -> list[Task]:
    """Return tasks of the chosen groups, in the order they are run."""
    tasks = list(even_tasks(cells[: bench.sizes.recovery.even_cells], options.data, bench.folder))
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
        options: what is run.
        cells: their records so far.
        failures: rows that could not be run.
    """

    bench: Bench
    options: Options
    cells: list[Record] = field(default_factory=list)
    failures: Failures = field(default_factory=Failures)

    def add(self, task: Task, rows: Iterable[Row]) -> None:
        """Add the record of a cell: the rows that are there, or that could be run."""
        setting = Setting(self.bench, task)
        found = {}
        for row in rows:
            title = f"{task.title} ({task.group}): {row.label}"
            with self.failures.leave_out(title):
                measure = partial(setting.measure, row)
                record = self.recall(setting.store, row.slug, setting.key(row), title, measure)
                if record is not None:
                    found[row.label] = record
        if found:
            head = next(iter(found.values()))["cell"]
            self.cells.append({**head, "rows": found})

    def recall(
        self, store: Store, name: str, key: str, title: str, measure: Callable[[], Record]
    ) -> Record | None:
        """Return a finished record that may be taken up, or measure; None if that is not asked for.

        Args:
            store: where records are kept.
            name: of the record.
            key: of its settings, whatever the version of the code.
            title: of what is done.
            measure: what is done.
        """
        record = None if self.bench.fresh else store.load(name, key)
        if record is not None and (self.options.any_version or record["code"] == code_now()):
            return record
        if self.options.stored:
            return None
        with self.bench.progress.stage(title):
            return store.save(name, key, {"code": code_now(), **measure()})


def code_now() -> str:
    """Return a digest of the code and the machine."""
    return key_of(*code_and_machine())
