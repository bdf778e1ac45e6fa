"""Studies: measurements, tables and plots of a benchmark; running and writing of all."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from svu_mi.bench import BENCHMARKS
from svu_mi.bench.cases import Case
from svu_mi.bench.compared_estimators import VARIANTS, Variant
from svu_mi.bench.experiment import BenchRun, Experiment, Record
from svu_mi.bench.markdown import Bar, bar_table, left_out, save
from svu_mi.core.io.files import prepare_folder, write_text
from svu_mi.core.validation import require_known
from svu_mi.errors import OptionError
from svu_mi.output.run_record import environment_record, write_manifest

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Selection of cases, rows and data of a benchmark.

    Attributes:
        cases: objects x lights.
        variants: estimators; all by default.
        rows: labels of the ways of recovery; the usual ones by default.
        data: folder of the data, None for the scenes of svu_mi.
        objects: names of objects in ``data``, for what finds them there by itself.
        capture: folder of the photographs, for what runs on a real capture instead of cases.
        every: of these, each so many-th is left out.
        environment_view: of Stanford-ORB, the test photograph whose environment map is the light.
    """

    cases: Sequence[Case] = ()
    variants: Sequence[Variant] = VARIANTS
    rows: Sequence[str] = ()
    data: Path | None = None
    objects: Sequence[str] = ()
    capture: Path | None = None
    every: int = 5
    environment_view: str | None = None


def _none(record: Record) -> list[Any]:
    del record
    return []


@dataclass(frozen=True, kw_only=True)
class Study:
    """A benchmark.

    Attributes:
        title: of its tables.
        experiment: what is measured.
        tables: Markdown of a record.
        summary: adds to a record what follows from its cases; ``sizes`` of the bench are there.
        bars: those that a record has figures for.
        note: how the bars were measured.
        plots: pictures by the name of their file, each drawn from the records of all benchmarks
            by name; None where there is nothing to show.
        lines: what matters most of a record, for the terminal.
        files: written beside the tables, by name; each takes its path and the record.
        runs_on: objects under lights, a real capture, or a data set of its own layout.
        own_sizes: whether it has sizes of photographs of its own, which its tables tell.
    """

    title: str
    experiment: Callable[[BenchRun, Selection], Experiment]
    tables: Callable[[Record], list[str]]
    summary: Callable[[Record], Record] = dict
    bars: Callable[[Record], list[Bar]] = _none
    note: str = ""
    plots: Mapping[str, Callable[[Record], Figure | None]] = field(default_factory=dict)
    lines: Callable[[Record], list[str]] = _none
    files: Mapping[str, Callable[[Path, Record], None]] = field(default_factory=dict)
    runs_on: Literal["cases", "capture", "data"] = "cases"
    own_sizes: bool = False

    def run(
        self, bench: BenchRun, selection: Selection, report: Callable[[Record], None] | None = None
    ) -> Record:
        """Measure everything.

        Args:
            bench: where and how.
            selection: what is run.
            report: called with the record so far after each case.

        Returns:
            What ``Experiment.run`` returns, with ``sizes``, ``bars`` and what ``summary`` adds.

        Raises:
            SvuError: that of the first case, if nothing could be run.
            OutputError: the folder cannot be written.
        """

        def whole(measured: Record) -> Record:
            record = self.summary({**measured, "sizes": bench.sizes})
            return {**record, "bars": [bar.record() for bar in self.bars(record)]}

        tell = report and (lambda measured: report(whole(measured)))
        return whole(self.experiment(bench, selection).run(bench, tell))

    def markdown(self, record: Record) -> str:
        """Return all tables of a record."""
        parts = [
            f"# {self.title}", *bar_table(record["bars"], record["quick"], self.note),
            *self.tables(record), *left_out("Left out", record),
        ]  # fmt: skip
        if record["versions"] > 1:
            parts.append(f"Figures of {record['versions']} versions of the code.")
        return "\n\n".join(parts)


def provenance_record(command: str) -> Record:
    """Return the command, date and environment of a run."""
    return {
        "command": command,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "environment": environment_record(),
    }


def provenance(record: Record) -> str:
    """Return a sentence on command, date and environment."""
    place = record["environment"]
    versions = place["versions"]
    return (
        f"`{record['command']}`, {record['date']}; svu_mi {versions['svu_mi']}, Mitsuba "
        f"{versions['mitsuba']}, Dr.Jit {versions['drjit']}, {place['variant']}, "
        f"{place['threads']} threads, {place['platform']}."
    )


def study_of(name: str) -> Study:
    """Return the study of one of ``BENCHMARKS``."""
    return import_module(f"svu_mi.bench.{name}").STUDY


def run_bench(
    bench: BenchRun, names: Sequence[str], selection: Selection, command: str = ""
) -> dict[str, Any]:
    """Run benchmarks, one after another, and write bench.json, bench.md and the plots.

    Tables of all that is known so far are written after each case.

    Args:
        bench: where and how.
        names: of ``BENCHMARKS``.
        selection: what of them is run.
        command: as the user gave it, for the record.

    Returns:
        What bench.json holds: how it was run, ``settings``, and a record by name
        (``Study.run``).

    Raises:
        OptionError: an unknown benchmark, or no case.
        SvuError: that of the first case of a benchmark, if all its cases failed.
        OutputError: the folder cannot be written.
    """
    require_known(names, BENCHMARKS, "benchmark")
    chosen = {name: study_of(name) for name in names}
    places = {study.runs_on for study in chosen.values()}
    if not selection.cases and "cases" in places:
        raise OptionError("There is no object and light to run; change --objects or --lights.")
    if selection.capture is None and "capture" in places:
        raise OptionError("There is no capture to run on; give its folder.")
    prepare_folder(bench.folder)
    record = {**provenance_record(command), "settings": bench.sizes}
    studies: dict[str, Study] = {}
    for name, study in chosen.items():
        studies[name] = study

        def report(measured: Record, name: str = name) -> None:
            record[name] = measured
            write(bench, record, studies)

        report(study.run(bench, selection, report))
        draw(bench, record, studies)
    return record


def write(bench: BenchRun, record: Record, studies: dict[str, Study]) -> None:
    """Write bench.json and bench.md with the results so far."""
    write_manifest(bench.folder / "bench.json", record)
    shared = any(s.runs_on == "cases" and not s.own_sizes for s in studies.values())
    sizes = [_sizes(bench)] if shared else []
    parts = ["# Benchmark", provenance(record), *sizes]
    parts += [study.markdown(record[name]) for name, study in studies.items() if name in record]
    write_text(bench.folder / "bench.md", "\n\n".join(parts))
    for name, study in studies.items():
        for file, write_file in study.files.items() if name in record else ():
            write_file(bench.folder / file, record[name])


def draw(bench: BenchRun, record: Record, studies: dict[str, Study]) -> None:
    """Draw the plots of all benchmarks with results; some show several of them."""
    finished = {name: record[name] for name in studies if record[name]["cells"]}
    with bench.progress.stage("Drawing plots"):
        for name in finished:
            for file, plot in studies[name].plots.items():
                if (figure := plot(finished)) is not None:
                    save(figure, bench.folder, file)


def _sizes(bench: BenchRun) -> str:
    size = bench.sizes
    return (
        f"{size.views} photographs of {size.film} x {size.film} with {size.spp} samples per "
        f"pixel, {size.texels} x {size.texels} texels, reference on {size.reference_texels} "
        f"texels with {size.reference_spp} samples."
    )
