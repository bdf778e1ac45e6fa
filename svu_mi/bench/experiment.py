"""Experiments: rows measured on cases, with finished results cached.

What is finished is kept, under a key of its settings and of the code, so that an interrupted run
goes on where it stopped; what fails is skipped with a warning.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol

from svu_mi.bench.captures import TrueTextures, capture_of
from svu_mi.bench.cases import Case
from svu_mi.bench.problem_sizes import ProblemSizes
from svu_mi.bench.result_cache import Store, code_now, key_of
from svu_mi.capture.capture import Capture
from svu_mi.core.progress import Progress
from svu_mi.errors import SvuError, SvuWarning
from svu_mi.geometry.texels import Texels, texels

Record = dict[str, Any]
HEAD = "head"  # file of what holds for all rows of a case


class ExperimentRow(Protocol):
    """A measurement of a case."""

    @property
    def label(self) -> str:
        """The name in tables and plots, unique among the rows."""


class Subject(Protocol):
    """A case; it loads what it needs when a record is missing."""

    @property
    def name(self) -> str:
        """Folder of its records."""

    @property
    def title(self) -> str:
        """Name in progress bars and tables."""

    @property
    def rows(self) -> Sequence[Any]:
        """An ``ExperimentRow`` per measurement, in order."""

    def settings(self, row: Any | None) -> Any:
        """Inputs of a row (None: of ``head``), as JSON; a part of its cache key."""

    def head(self) -> Record:
        """Measure the entries that all rows have in common."""

    def measure(self, row: Any) -> Record:
        """Measure a row."""


@dataclass(frozen=True)
class BenchRun:
    """Where and how a benchmark runs.

    Attributes:
        folder: of all results.
        sizes: how large everything is.
        progress: shows what is going on.
        quick: whether the sizes are small ones, which bars are not meant for.
        fresh: measure again what is finished.
        keep: take up results of another version of the code.
        stored: measure nothing; only gather what is there, of any version.
    """

    folder: Path
    sizes: ProblemSizes = field(default_factory=ProblemSizes)
    progress: Progress = field(default_factory=Progress)
    quick: bool = False
    fresh: bool = False
    keep: bool = False
    stored: bool = False

    def capture(self, case: Case, name: str = "capture", **sizes: Any) -> Capture:
        """Return the photographs of a case, rendered once.

        Args:
            case: object and light.
            name: of their folder.
            **sizes: changes of ``sizes``.

        Raises:
            SceneError: the scene cannot be rendered.
            OutputError: the folder cannot be written.
        """
        folder = self.folder / "cells" / case.name / name
        return capture_of(case, replace(self.sizes, **sizes), folder, self.progress)

    def recall(
        self, store: Store, name: str, title: str, settings: Any, measure: Callable[[], Record]
    ) -> Record | None:
        """Return a finished record, or measure it; None if ``stored`` and missing.

        Args:
            store: where it is kept.
            name: of its file.
            title: of what is done.
            settings: that it depends on, beside the code.
            measure: what is done.
        """
        key, code = key_of(settings), code_now()
        record = None if self.fresh else store.load(name, key)
        if record is not None and (self.keep or self.stored or record["code"] == code):
            return record
        if self.stored:
            return None
        with self.progress.stage(title):
            return store.save(name, key, {"code": code, **measure()})


@dataclass(frozen=True)
class Measurement:
    """A row that calls a function of the subject.

    Attributes:
        label: its name.
        measure: what is measured of the subject.
    """

    label: str
    measure: Callable[[Any], Record]


@dataclass(frozen=True)
class CaseSubject:
    """An object under a light; its results depend on all shared sizes.

    Attributes:
        bench: where and how.
        case: object and light.
    """

    bench: BenchRun
    case: Case

    @property
    def name(self) -> str:
        """Folder of its records."""
        return self.case.name

    @property
    def title(self) -> str:
        """Object and light."""
        return self.case.title

    def settings(self, row: Any | None) -> Any:
        shared = self.bench.sizes.shared
        return str(self.case.scene), self.case.defines, shared, row and row.label

    def head(self) -> Record:
        """Return the ``cell``."""
        return {"cell": self.title}

    def measure(self, row: Any) -> Record:
        """Measure a part."""
        return row.measure(self)

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the case."""
        return self.bench.capture(self.case)

    @cached_property
    def layout(self) -> Texels:
        """Texels of its object."""
        return texels(self.capture.mesh, self.bench.sizes.texels)

    @cached_property
    def truth(self) -> TrueTextures:
        """True textures of its object."""
        return TrueTextures.of(self.capture, self.layout)


@dataclass(frozen=True)
class Experiment:
    """Rows measured on cases.

    Attributes:
        name: folder of finished records.
        subjects: the cases, each let go of when it is finished.
        whole: whether a case counts only with all of its rows.
    """

    name: str
    subjects: Iterable[Subject]
    whole: bool = False

    def run(self, bench: BenchRun, report: Callable[[Record], None] | None = None) -> Record:
        """Measure all unfinished rows of all cases.

        What cannot be run is left out, with a warning.

        Args:
            bench: where and how.
            report: called with the record so far after each case.

        Returns:
            ``cells``: a record each, what ``head`` says and ``rows`` by label; ``failed``: what
            was left out (``cell``) and why (``reason``); the number of ``versions`` of the code
            of the rest; ``quick``.

        Raises:
            SvuError: the first, if nothing could be run.
            OutputError: the folder cannot be written.
        """
        failures = Failures()
        record: Record = {"cells": [], "failed": failures.records, "code": [],
                          "quick": bench.quick}  # fmt: skip
        codes: set[str] = set()
        for subject in self.subjects:
            with failures.leave_out(subject.title):
                case_record = self._case(bench, subject, failures, codes)
                if case_record is not None:
                    record["cells"].append(case_record)
            record["code"] = sorted(codes)
            if report is not None and record["cells"]:
                report(record)
        if not record["cells"] and failures.first is not None:
            raise failures.first
        return record

    def _case(
        self, bench: BenchRun, subject: Subject, failures: Failures, codes: set[str]
    ) -> Record | None:
        """Return the record of a case; None without any row."""
        store = Store(bench.folder / self.name / subject.name)
        recall = partial(bench.recall, store)
        head = recall(HEAD, subject.title, subject.settings(None), subject.head)
        if head is None:
            return None
        rows: dict[str, Record] = {}
        for row in subject.rows:
            title = f"{subject.title}: {row.label}"
            measure = partial(subject.measure, row)
            with failures.leave_out(title, whole=self.whole):
                settings = subject.settings(row)
                row_record = recall(file_name(row.label), title, settings, measure)
                if row_record is not None:
                    rows[row.label] = _stripped(row_record)
                    codes.add(row_record["code"])
        return {**_stripped(head), "rows": rows} if rows else None


@dataclass
class Failures:
    """Errors of a run so far.

    Attributes:
        records: a record each, with ``cell`` and ``reason``.
        first: what was raised first.
    """

    records: list[dict[str, str]] = field(default_factory=list)
    first: SvuError | None = None

    @contextmanager
    def leave_out(self, what: str, *, whole: bool = False) -> Iterator[None]:
        """Keep an error of the block, warn, and go on after it; ``whole``: leave that to others."""
        try:
            yield
        except SvuError as error:
            if whole:
                raise
            self.first = self.first or error
            self.records.append({"cell": what, "reason": str(error)})
            warnings.warn(f"{what} is left out: {error}", SvuWarning, stacklevel=4)


def file_name(label: str) -> str:
    """Return a label as the name of a file: ``SH + path`` is ``sh_with_path``."""
    words = "".join(c if c.isalnum() else " " for c in label.replace("+", "with"))
    return "_".join(words.lower().split())


def _stripped(record: Record) -> Record:
    return {name: value for name, value in record.items() if name not in ("key", "code")}
