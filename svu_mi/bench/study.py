"""A benchmark, and how it is run and written."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from svu_mi.bench.cells import Cell
from svu_mi.bench.experiment import Bench, Experiment, Record
from svu_mi.bench.text import Bar, bar_table, left_out
from svu_mi.bench.variants import VARIANTS, Variant
from svu_mi.output import environment_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What of a benchmark is run.

    Attributes:
        cells: objects x lights.
        variants: estimators; all by default.
        rows: labels of the ways of recovery; the usual ones by default.
        data: folder the cells come from, None for the scenes of svu_mi.
        capture: folder of the photographs, for what runs on a real capture instead of cells.
        every: of these, each so many-th is left out.
    """

    cells: Sequence[Cell] = ()
    variants: Sequence[Variant] = VARIANTS
    rows: Sequence[str] = ()
    data: Path | None = None
    capture: Path | None = None
    every: int = 5


def no_bars(record: Record) -> list[Bar]:
    """Return the bars of a benchmark that has none."""
    del record
    return []


@dataclass(frozen=True, kw_only=True)
class Study:
    """A benchmark.

    Attributes:
        title: of its tables.
        experiment: what is measured.
        tables: Markdown of a record.
        summary: adds to a record what follows from its cells; ``sizes`` of the bench are there.
        bars: those that a record has figures for.
        note: how the bars were measured.
        plots: pictures by the name of their file, each drawn from the records of all benchmarks
            by name; None where there is nothing to show.
        on_cells: whether it runs on objects under lights, rather than on a real capture.
    """

    title: str
    experiment: Callable[[Bench, Asked], Experiment]
    tables: Callable[[Record], list[str]]
    summary: Callable[[Record], Record] = dict
    bars: Callable[[Record], list[Bar]] = no_bars
    note: str = ""
    plots: Mapping[str, Callable[[Record], Figure | None]] = field(default_factory=dict)
    on_cells: bool = True

    def run(
        self, bench: Bench, asked: Asked, told: Callable[[Record], None] | None = None
    ) -> Record:
        """Measure everything.

        Args:
            bench: where and how.
            asked: what is run.
            told: called with the record so far after each cell.

        Returns:
            What ``Experiment.run`` returns, with ``sizes``, ``bars`` and what ``summary`` adds.

        Raises:
            SvuError: that of the first cell, if nothing could be run.
            OutputError: the folder cannot be written.
        """

        def whole(found: Record) -> Record:
            record = self.summary({**found, "sizes": bench.sizes})
            return {**record, "bars": [bar.record() for bar in self.bars(record)]}

        def tell(found: Record) -> None:
            if told is not None:
                told(whole(found))

        return whole(self.experiment(bench, asked).run(bench, tell))

    def markdown(self, record: Record) -> str:
        """Return all tables of a record."""
        parts = [
            f"# {self.title}", *bar_table(record["bars"], record["quick"], self.note),
            *self.tables(record), *left_out("Left out", record),
        ]  # fmt: skip
        if record["versions"] > 1:
            parts.append(f"Figures of {record['versions']} versions of the code.")
        return "\n\n".join(parts)


def how_it_was_run(command: str) -> Record:
    """Return the part of a record that says with which command, when and where."""
    return {
        "command": command,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "environment": environment_record(),
    }


def told_how(record: Record) -> str:
    """Return the sentence about what ``how_it_was_run`` returned."""
    place = record["environment"]
    versions = place["versions"]
    return (
        f"`{record['command']}`, {record['date']}; svu_mi {versions['svu_mi']}, Mitsuba "
        f"{versions['mitsuba']}, Dr.Jit {versions['drjit']}, {place['variant']}, "
        f"{place['threads']} threads, {place['platform']}."
    )
