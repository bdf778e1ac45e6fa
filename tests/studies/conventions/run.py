"""Write right captures, import them wrongly, check them, and count how often that was found."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from studies.conventions.cases import CASES, OUTCOMES, Case, outcome
from studies.conventions.photographs import IMPORTERS, WAYS, Way
from studies.conventions.visible import SEED, VIEWS, looks, shows
from studies.conventions.written import Written, write
from svu_mi.bench.experiment import Bench, Experiment, OnCell, Record
from svu_mi.bench.study import Asked
from svu_mi.bench.text import table
from svu_mi.capture import Capture, load_capture
from svu_mi.checking.run import find_mistakes
from svu_mi.formats.importing import import_capture
from svu_mi.formats.reading import ReadOptions, read_source
from svu_mi.settings import require_known

# Of the photographs: views, pixels per side, samples per pixel; --quick has fewer.
SIZES: dict[str, Any] = {"views": 24, "film": 128, "spp": 64}
QUICK: dict[str, Any] = {"views": 16, "film": 96, "spp": 32}


@dataclass(frozen=True)
class Spoiled(OnCell):
    """A cell whose right captures are imported with mistakes, and checked.

    Attributes:
        rows: ways in which photographs come.
    """

    rows: Sequence[Named]

    def settings(self, row: Named | None) -> Any:
        return super().settings(row), self.bench.quick

    def head(self) -> Record:
        """Return ``cell``, and of each case whether it is ``visible``: of a matt object with the
        base colour that is given."""
        with tempfile.TemporaryDirectory(prefix="svu-conventions-") as temporary:
            form = Way("transforms")
            written = write(self.capture, form.format, Path(temporary))
            plain = imported_with(written, Case(), form, Path(temporary) / "imported")
        right, again = looks(plain), looks(plain, SEED + VIEWS)
        visible = [shows(right, again, looks(case.made(plain))) for case in CASES]
        return {"cell": self.title, "visible": visible}

    def measure(self, row: Named) -> Record:
        """Return ``checks``: what ``checked`` returns."""
        return {"checks": checked(self.capture, row.label)}

    @cached_property
    def capture(self) -> Capture:
        """The photographs."""
        sizes = QUICK if self.bench.quick else SIZES
        return self.bench.capture(self.cell, "conventions", **sizes)


@dataclass(frozen=True)
class Named:
    """A way in which photographs come, by its name in ``WAYS``."""

    label: str


def experiment(bench: Bench, asked: Asked) -> Experiment:
    """Return what is measured: every cell of ``asked``, photographed in the ways that are its rows
    (all by default; with ``quick``, as the importers give them).

    Raises:
        OptionError: an unknown way.
    """
    require_known(asked.rows, WAYS, "row")
    ways = tuple(asked.rows) or (IMPORTERS if bench.quick else tuple(WAYS))
    rows = [Named(way) for way in ways]
    return Experiment("conventions", (Spoiled(bench, cell, rows) for cell in asked.cells), True)


def checks_of(record: Record) -> list[Record]:
    """Return all checks of a record, each with its ``cell`` and whether it is ``visible``."""
    return [
        {"cell": cell["cell"], **check, "visible": seen}
        for cell in record["cells"] for row in cell["rows"].values()
        for check, seen in zip(row["checks"], cell["visible"], strict=True)
    ]  # fmt: skip


def checked(capture: Capture, name: str, cases: Sequence[Case] = CASES) -> list[dict[str, Any]]:
    """Write a right capture, import it with every mistake, and check what comes out.

    Args:
        capture: with masks, in a folder of its own.
        name: how the photographs come, one of ``WAYS``.
        cases: mistakes.

    Returns:
        A record per check: ``photographs``, ``group``, ``fixes``, ``outcome`` and ``said``, the
        sentences.
    """
    way, found = WAYS[name], []
    with tempfile.TemporaryDirectory(prefix="svu-conventions-") as temporary:
        folder = Path(temporary)
        written = write(capture, way.format, folder)
        for case in cases:
            imported = imported_with(written, case, way, folder / "imported")
            findings, _ = find_mistakes(imported)
            found.append({
                "photographs": name, "group": case.group, "fixes": case.fixes,
                "outcome": outcome(findings, case), "said": [one.sentence for one in findings],
            })  # fmt: skip
    return found


def imported_with(written: Written, case: Case, way: Way, folder: Path) -> Capture:
    """Import a capture with a mistake, and load it.

    Args:
        written: the files.
        case: the mistake.
        way: how the photographs come.
        folder: of the import; an earlier one is replaced.
    """
    source = read_source(written.path, ReadOptions(format=way.format))
    import_capture(source, folder, replace(written.options, fixes=case.mistakes))
    return way.changed(load_capture(folder))


def conventions_tables(rows: Sequence[dict[str, Any]]) -> str:
    """Return Markdown tables: kinds of mistakes, and objects, x ways that photographs come.

    Args:
        rows: what ``checks_of`` returns.
    """
    told = [row for row in rows if row["visible"] or row["group"] == "nothing wrong"]
    wrong = [row for row in rows if row["group"] != "nothing wrong"]
    return (
        f"Captures that were imported wrongly, and checked, in percent: {' / '.join(OUTCOMES)}.\n\n"
        + _counts(told, "group")
        + "\n\nMistakes by object and light.\n\n"
        + _counts([row for row in wrong if row["visible"]], "cell")
        + "\n\nMistakes that change no picture of the object; silence is right.\n\n"
        + _counts([row for row in wrong if not row["visible"]], "cell")
    )


def _counts(rows: Sequence[dict[str, Any]], heading: str) -> str:
    """Return a table of outcomes with a line per value of a field."""
    columns = list(dict.fromkeys(row["photographs"] for row in rows))
    lines = []
    for value in dict.fromkeys(row[heading] for row in rows):
        of = [row for row in rows if row[heading] == value]
        shares = (_share([row for row in of if row["photographs"] == one]) for one in columns)
        lines.append([value, *shares, len(of)])
    return table([heading, *columns, "checks"], lines)


def _share(rows: Sequence[dict[str, Any]]) -> str:
    counted = Counter(row["outcome"] for row in rows)
    return " / ".join(f"{100 * counted[one] / len(rows):.0f}" for one in OUTCOMES) if rows else ""
