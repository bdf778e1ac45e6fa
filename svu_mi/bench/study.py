"""Studies: measurements, bars, tables and plots of benchmarks; their runs and files."""

from __future__ import annotations

import datetime
import json
import platform
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from svu_mi.bench import BENCHMARKS
from svu_mi.bench.cases import Case
from svu_mi.bench.compared_estimators import VARIANTS, Variant
from svu_mi.bench.experiment import BenchRun, Experiment, Record
from svu_mi.bench.markdown import Bar, bar_table, failed_cases, save
from svu_mi.bench.problem_sizes import ProblemSizes
from svu_mi.core.io.files import prepare_folder, write_text
from svu_mi.core.memory import physical_memory
from svu_mi.core.validation import require_known
from svu_mi.errors import OptionError
from svu_mi.output.run_record import environment_record, write_manifest

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Selection of cases, rows and data of a benchmark.

    Attributes:
        cases: Objects x lights.
        variants: Estimators; all by default.
        rows: Labels of recovery methods or parts of the paper; the usual ones by default.
        data: Folder with data; None for the scenes of svu_mi.
        objects: Names of objects or captures in ``data`` (Stanford-ORB).
        capture: Folder or scene of a real capture (``real``).
        every: Every n-th photograph of that capture is held out.
        environment_view: Test photograph whose environment map is the light (Stanford-ORB).
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
        title: Title of the tables.
        experiment: Returns the experiment of a run.
        tables: Returns the Markdown of a record.
        summary: Returns the record with entries computed from its cases.
        bars: Returns the bars of a record.
        note: Description of how the bars are measured.
        plots: Plots by file name. Each takes the records of all benchmarks by name, and returns
            None without results.
        lines: Returns the main results, for the terminal.
        files: Writers of additional files by name; each takes a path and the record.
        runs_on: Input: objects under lights, a real capture, or a data set with another layout.
        own_sizes: True if its photographs have sizes that ``ProblemSizes`` does not contain.
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
        """Measure all rows of all cases.

        Args:
            bench: Folder, sizes and options of the run.
            selection: Cases and rows.
            report: Callback with the partial record after each case.

        Returns:
            The result of ``Experiment.run``, with ``sizes``, ``bars`` and the entries of
            ``summary``.

        Raises:
            SvuError: Error of the first case, if all cases failed.
            OutputError: The folder cannot be written.
        """

        def finish(measured: Record) -> Record:
            return self.finish({**measured, "sizes": bench.sizes})

        finished = report and (lambda measured: report(finish(measured)))
        return finish(self.experiment(bench, selection).run(bench, finished))

    def finish(self, measured: Record) -> Record:
        """Return a record with the entries of ``summary`` and with ``bars``.

        Args:
            measured: result of ``Experiment.run``, with ``sizes``.
        """
        record = self.summary(measured)
        return {**record, "bars": [bar.record() for bar in self.bars(record)]}

    def markdown(self, record: Record) -> str:
        """Return all tables of a record."""
        parts = [
            f"# {self.title}", *bar_table(record["bars"], record["quick"], self.note),
            *self.tables(record), *failed_cases("Failed cases", record),
        ]  # fmt: skip
        if len(record["code"]) > 1:
            parts.append(f"Figures of {len(record['code'])} versions of the code.")
        return "\n\n".join(parts)


def provenance_record(command: str) -> Record:
    """Return the command, date and environment of a run."""
    memory = physical_memory()
    machine = {"cpu": cpu_name(), "memory_gib": None if memory is None else memory / 2**30}
    return {
        "command": command,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "environment": environment_record() | machine,
    }


def cpu_name() -> str:
    """Return the name of the CPU; an empty string if the system does not provide it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), "")


def provenance(record: Record) -> str:
    """Return a sentence with command, date and environment."""
    place = record["environment"]
    versions = place["versions"]
    return (
        f"`{record['command']}`, {record['date']}; svu_mi {versions['svu_mi']}, Mitsuba "
        f"{versions['mitsuba']}, Dr.Jit {versions['drjit']}, {place['variant']}, "
        f"{place['threads']} threads, {place['platform']}."
    )


def study_of(name: str) -> Study:
    """Return the study with a name in ``BENCHMARKS``."""
    return import_module(f"svu_mi.bench.{name}").STUDY


def run_bench(
    bench: BenchRun, names: Sequence[str], selection: Selection, command: str = ""
) -> dict[str, Record]:
    """Run benchmarks in turn, and write STUDY.json of each, bench.md and the plots.

    All files but the plots are updated after each case; plots are drawn at the end.

    Args:
        bench: Folder, sizes and options of the run.
        names: Names in ``BENCHMARKS``.
        selection: Cases and rows.
        command: Command line of the user, for the records.

    Returns:
        Records by name, with the content of their files: ``study``, ``command``, ``date``,
        ``environment``, and the entries of ``Study.run``.

    Raises:
        OptionError: Unknown benchmark, or no case.
        SvuError: Error of the first case, if all cases of a benchmark failed.
        OutputError: The folder cannot be written.
    """
    require_known(names, BENCHMARKS, "benchmark")
    chosen = {name: study_of(name) for name in names}
    places = {study.runs_on for study in chosen.values()}
    if not selection.cases and "cases" in places:
        raise OptionError("No object and light selected; change --objects or --lights.")
    if selection.capture is None and "capture" in places:
        raise OptionError("No capture given; add its folder to the command.")
    prepare_folder(bench.folder)
    records: dict[str, Record] = {}
    try:
        for name, study in chosen.items():
            about = {"study": name, **_provenance_of(bench, name, command)}

            def report(measured: Record, about: Record = about) -> None:
                records[about["study"]] = {**about, **measured}
                write(bench, records)

            report(study.run(bench, selection, report))
    finally:  # also of studies before one that fails
        draw(bench, records)
    return records


def _provenance_of(bench: BenchRun, name: str, command: str) -> Record:
    """Return the provenance of a study; for stored results, it is read from their file."""
    new, path = provenance_record(command), bench.folder / f"{name}.json"
    if not (bench.stored and path.is_file()):
        return new
    old = json.loads(path.read_text(encoding="utf-8"))
    return {key: old.get(key, value) for key, value in new.items()}


def write(bench: BenchRun, records: dict[str, Record]) -> None:
    """Write STUDY.json of each study and bench.md with the results so far."""
    studies = {name: study_of(name) for name in records}
    shared = any(s.runs_on == "cases" and not s.own_sizes for s in studies.values())
    parts = ["# Benchmark", *([_sizes(bench.sizes)] if shared else [])]
    for name, study in studies.items():
        record = without_folders(records[name])
        write_manifest(bench.folder / f"{name}.json", record)
        parts += [study.markdown(record), provenance(record)]
        for file, write_file in study.files.items():
            write_file(bench.folder / file, record)
    write_text(bench.folder / "bench.md", "\n\n".join(parts))


def read_record(path: Path) -> Record:
    """Read a record from its STUDY.json; its summary and bars are computed again."""
    record: Record = json.loads(path.read_text(encoding="utf-8"))
    sizes = ProblemSizes.read(record["sizes"])
    return study_of(record["study"]).finish({**record, "sizes": sizes})


FOLDERS = re.compile(r"(?<![\w./])/(?:[^/\s'\":;,]+/)*(?=[^/\s])")  # of absolute paths


def without_folders(value: Any) -> Any:
    """Return the record with absolute paths in its texts replaced by file names."""
    if isinstance(value, str):
        return FOLDERS.sub("", value)
    if isinstance(value, list):
        return [without_folders(item) for item in value]
    if isinstance(value, dict):
        return {key: without_folders(item) for key, item in value.items()}
    return value


def draw(bench: BenchRun, records: dict[str, Record]) -> None:
    """Draw the plots of all studies with results."""
    with bench.progress.stage("Drawing plots"):
        for file, figure in figures(records):
            save(figure, bench.folder, file)


def figures(records: dict[str, Record]) -> Iterator[tuple[str, Figure]]:
    """Yield (file name, plot) of all studies with results; some plots combine several studies."""
    finished = {name: record for name, record in records.items() if record["cells"]}
    for name in finished:
        for file, plot in study_of(name).plots.items():
            if (figure := plot(finished)) is not None:
                yield file, figure


def _sizes(size: ProblemSizes) -> str:
    return (
        f"{size.views} photographs of {size.film} x {size.film} with {size.spp} samples per "
        f"pixel, {size.texels} x {size.texels} texels, reference on {size.reference_texels} "
        f"texels with {size.reference_spp} samples."
    )
