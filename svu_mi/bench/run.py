"""Run a benchmark and write what it found."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from functools import partial
from typing import Any

from svu_mi.bench.accuracy import Bench, run_cell
from svu_mi.bench.cells import Cell
from svu_mi.bench.checks import run_checks
from svu_mi.bench.failures import Failures
from svu_mi.bench.guidance import draw_guidance, run_guidance
from svu_mi.bench.plots import draw_plots
from svu_mi.bench.recovery import draw_recovery, run_recovery
from svu_mi.bench.recovery.options import Options
from svu_mi.bench.speed import run_speed
from svu_mi.bench.summary import summarize
from svu_mi.bench.tables import write_tables
from svu_mi.bench.variants import Variant, available
from svu_mi.errors import OptionError
from svu_mi.files import prepare_folder
from svu_mi.output import environment_record, write_manifest
from svu_mi.settings import require_known

WHAT = ("accuracy", "checks", "speed", "recovery", "guidance", "all")


def run_bench(
    bench: Bench,
    cells: Sequence[Cell],
    what: str = "all",
    *,
    variants: Sequence[Variant] | None = None,
    recovery: Options | None = None,
    command: str = "",
) -> dict[str, Any]:
    """Run cells, then run times, and write bench.json, bench.md and the plots.

    A cell that cannot be run, because of its object or light, is reported and left out.

    Args:
        bench: where and how.
        cells: objects x lights; run times are measured on the first.
        what: one of ``WHAT``; ``all`` is all but ``recovery`` and ``guidance``.
        variants: estimators; all that this version knows by default.
        recovery: what of the recovery benchmark is run.
        command: as the user gave it, for the record.

    Returns:
        What bench.json holds: ``cells``, ``summary``, ``checks``, ``speed``, ``recovery``,
        ``guidance``, ``failed``, and how it was run.

    Raises:
        OptionError: an unknown ``what``, or no cell.
        SvuError: that of the first cell, if every cell failed.
        OutputError: the folder cannot be written.
    """
    require_known([what], WHAT, "benchmark")
    if not cells:
        raise OptionError("There is no object under any light to run.")
    prepare_folder(bench.folder)
    variants = available() if variants is None else tuple(variants)
    record: dict[str, Any] = {
        **how_it_was_run(command),
        "settings": bench.sizes,
        **{part: [] for part in ("cells", "failed", "checks")},
        **dict.fromkeys(("speed", "recovery", "guidance")),
    }
    if what in ("accuracy", "all"):
        record["cells"], record["failed"] = _all_cells(bench, cells, variants)
        bad = {failure["cell"] for failure in record["failed"]}
        cells = [cell for cell in cells if cell.title not in bad]
        _write(bench, record)
    if what in ("checks", "all"):
        record["checks"] = run_checks(bench, cells, variants)
        _write(bench, record)
    if what in ("speed", "all"):
        record["speed"] = run_speed(bench, cells[0], variants)
        _write(bench, record)
    # Each takes as long as all the others: never part of them.
    finished = partial(_finished, bench, record)
    if what == "recovery":
        run_recovery(bench, cells, recovery, finished=partial(finished, what))
    if what == "guidance":
        run_guidance(bench, cells, finished=partial(finished, what))
    return record


def how_it_was_run(command: str) -> dict[str, Any]:
    """Return the part of a record that says with which command, when and where."""
    return {
        "command": command,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "environment": environment_record(),
    }


def _finished(bench: Bench, record: dict[str, Any], name: str, found: Any) -> None:
    record[name] = found
    _write(bench, record)


def _write(bench: Bench, record: dict[str, Any]) -> None:
    """Write all that is known so far; a later part may fail."""
    record["summary"] = summarize(record["cells"])
    with bench.progress.stage("Writing tables and plots"):
        write_manifest(bench.folder / "bench.json", record)
        write_tables(bench.folder / "bench.md", record)
        draw_plots(bench.folder, record)
        if record["recovery"]:
            draw_recovery(bench.folder, record["recovery"])
        if record["guidance"]:
            draw_guidance(bench.folder, record["guidance"])


def _all_cells(
    bench: Bench, cells: Sequence[Cell], variants: Sequence[Variant]
) -> tuple[list[dict[str, Any]], list[dict[str, str]]]:
    done, failures = [], Failures()
    for cell in cells:
        with failures.leave_out(cell.title):
            done.append(run_cell(bench, cell, variants))
    failures.raise_unless(done)
    return done, failures.found
