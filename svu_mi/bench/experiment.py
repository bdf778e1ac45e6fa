"""Experiments: rows measured on cases, with finished results cached.

Results are stored under a key of their settings and of the code, so that an interrupted run
continues where it stopped. Failed cases are skipped with a warning.
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
HEAD = "head"  # file of the entries that all rows of a case share


class ExperimentRow(Protocol):
    """A measurement of a case."""

    @property
    def label(self) -> str:
        """Name in tables and plots, unique among the rows."""


class Subject(Protocol):
    """A case; its data are loaded when a record is missing."""

    @property
    def name(self) -> str:
        """Name of the folder of the case's records."""

    @property
    def title(self) -> str:
        """Name in progress bars and tables."""

    @property
    def rows(self) -> Sequence[Any]:
        """Measurements, an ``ExperimentRow`` each."""

    def settings(self, row: Any | None) -> Any:
        """Return the inputs of a row (None: of ``head``) as JSON, for its cache key."""

    def head(self) -> Record:
        """Measure the entries that all rows share."""

    def measure(self, row: Any) -> Record:
        """Measure a row."""


@dataclass(frozen=True)
class BenchRun:
    """Folder, sizes and options of a run of benchmarks.

    Attributes:
        folder: Folder of all results.
        sizes: Problem sizes.
        progress: Progress display.
        quick: True for small sizes, to which bars do not apply.
        fresh: Measure finished rows again.
        keep: Reuse results of other versions of the code.
        stored: Gather existing results of any version without measuring.
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
            case: Object and light.
            name: Name of the folder of the photographs.
            **sizes: Fields of ``sizes`` to replace.

        Raises:
            SceneError: The scene cannot be rendered.
            OutputError: The folder cannot be written.
        """
        folder = self.folder / "cells" / case.name / name
        return capture_of(case, replace(self.sizes, **sizes), folder, self.progress)

    def recall(
        self, store: Store, name: str, title: str, settings: Any, measure: Callable[[], Record]
    ) -> Record | None:
        """Return the cached record, or measure it; with ``stored``, None if missing.

        Args:
            store: Cache of the record.
            name: File name of the record.
            title: Title of the measurement for the progress display.
            settings: Inputs of the measurement as JSON, without the code.
            measure: Returns the record.
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
    """Row that calls a function with the subject.

    Attributes:
        label: Name of the row.
        measure: Returns the record of a subject.
    """

    label: str
    measure: Callable[[Any], Record]


@dataclass(frozen=True)
class CaseSubject:
    """An object under a light; its results depend on all shared sizes.

    Attributes:
        bench: Folder, sizes and options of the run.
        case: Object and light.
    """

    bench: BenchRun
    case: Case

    @property
    def name(self) -> str:
        """Name of the folder of the case's records."""
        return self.case.name

    @property
    def title(self) -> str:
        """Object and light."""
        return self.case.title

    def settings(self, row: Any | None) -> Any:
        shared = self.bench.sizes.shared
        return str(self.case.scene), self.case.defines, shared, row and row.label

    def head(self) -> Record:
        """Return ``cell``, the object and light."""
        return {"cell": self.title}

    def measure(self, row: Any) -> Record:
        """Measure a row."""
        return row.measure(self)

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the case."""
        return self.bench.capture(self.case)

    @cached_property
    def layout(self) -> Texels:
        """Texels of the object."""
        return texels(self.capture.mesh, self.bench.sizes.texels)

    @cached_property
    def truth(self) -> TrueTextures:
        """True textures of the object."""
        return TrueTextures.of(self.capture, self.layout)


@dataclass(frozen=True)
class Experiment:
    """Rows measured on cases.

    Attributes:
        name: Folder of finished records.
        subjects: Cases; each is released when it is finished.
        whole: Skip a case if one of its rows fails.
    """

    name: str
    subjects: Iterable[Subject]
    whole: bool = False

    def run(self, bench: BenchRun, report: Callable[[Record], None] | None = None) -> Record:
        """Measure all rows of all cases without a cached record; skip failures with a warning.

        Args:
            bench: Folder, sizes and options of the run.
            report: Callback with the partial record after each case.

        Returns:
            ``cells``: a record per case, with the entries of ``head`` and ``rows`` by label;
            ``failed``: skipped cases (``cell``) and errors (``reason``); ``code``: digests of
            the code of all rows; ``quick``.

        Raises:
            SvuError: The first error, if all cases failed.
            OutputError: The folder cannot be written.
        """
        failures = Failures()
        record: Record = {"cells": [], "failed": failures.records, "code": [],
                          "quick": bench.quick}  # fmt: skip
        codes: set[str] = set()
        for subject in self.subjects:
            with failures.skip(subject.title):
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
        """Return the record of a case; None without rows."""
        store = Store(bench.folder / self.name / subject.name)
        recall = partial(bench.recall, store)
        head = recall(HEAD, subject.title, subject.settings(None), subject.head)
        if head is None:
            return None
        rows: dict[str, Record] = {}
        for row in subject.rows:
            title = f"{subject.title}: {row.label}"
            measure = partial(subject.measure, row)
            with failures.skip(title, whole=self.whole):
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
        records: Records with ``cell`` and ``reason``.
        first: First error.
    """

    records: list[dict[str, str]] = field(default_factory=list)
    first: SvuError | None = None

    @contextmanager
    def skip(self, title: str, *, whole: bool = False) -> Iterator[None]:
        """Record an error in the ``with`` block and warn; raise it again if ``whole``."""
        try:
            yield
        except SvuError as error:
            if whole:
                raise
            self.first = self.first or error
            self.records.append({"cell": title, "reason": str(error)})
            warnings.warn(f"{title} is skipped: {error}", SvuWarning, stacklevel=4)


def file_name(label: str) -> str:
    """Return the file name of a label: ``sh_with_path`` for ``SH + path``."""
    words = "".join(c if c.isalnum() else " " for c in label.replace("+", "with"))
    return "_".join(words.lower().split())


def _stripped(record: Record) -> Record:
    return {name: value for name, value in record.items() if name not in ("key", "code")}
