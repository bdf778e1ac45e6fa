"""Run the benchmark of Stanford-ORB, capture by capture; what is finished is kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from studies.command import write_study
from studies.orb.dataset import own_dataset
from studies.orb.options import FULL, QUICK, Options
from studies.orb.setting import Setting
from studies.orb.tables import orb_tables, write_csv
from svu_mi.bench.accuracy import Bench
from svu_mi.bench.failures import Failures
from svu_mi.formats.stanford_orb import find_captures

Record = dict[str, Any]


def write_orb_results(folder: Path, record: Record) -> None:
    """Write orb.json, orb.md and orb.csv.

    Raises:
        OutputError: a file cannot be written.
    """
    write_study(folder, "orb", record, "Stanford-ORB", orb_tables(record))
    write_csv(folder / "orb.csv", record)


def run_orb(
    bench: Bench, options: Options, *, finished: Callable[[Record], None] | None = None
) -> Record:
    """Recover the textures of every capture, and compare pictures of them with photographs.

    A capture that cannot be read is reported and left out.

    Args:
        bench: where, and how large.
        options: what is run.
        finished: called with the record so far after each capture.

    Returns:
        ``captures``: what ``Setting.head`` says of each, and ``rows`` by label, each with what
        ``Setting.judge`` returns; ``failed``; ``sizes``; ``quick``; whether the set was
        ``rendered``.

    Raises:
        OptionError: there is no such capture or row.
        SvuError: that of the first capture, if everything failed.
        OutputError: the folder cannot be written.
    """
    rows = options.chosen_rows()
    sizes = options.sizes or (QUICK if bench.quick else FULL)
    data = own_dataset(bench) if options.data is None else options.data
    failures = Failures()
    record: Record = {"captures": [], "failed": failures.found, "sizes": sizes,
                      "quick": bench.quick, "rendered": options.data is None}  # fmt: skip
    for path in options.chosen_captures(find_captures(data)):
        setting = Setting(bench, path, options, sizes)
        with failures.leave_out(path.name):
            found = {}
            for row in rows:
                with bench.progress.stage(f"{path.name}: {row.label}"):
                    found[row.label] = setting.recall(row)
            head = next(iter(found.values()))["capture"]
            record["captures"].append({**head, "rows": found})
        if finished is not None and record["captures"]:
            finished(record)
    failures.raise_unless(record["captures"])
    return record
