"""Figures that recovery has to reach, each with what was measured."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from svu_mi.bench.bars import Bar
from svu_mi.bench.recovery.rows import PATH, PATH_SHARING, SH, SH_PAPER, SH_PATH, SH_SHARING, Row

Record = dict[str, Any]


def find_bars(record: Record) -> list[Record]:
    """Return the bars that a record has figures for.

    Args:
        record: what ``run_recovery`` returns.
    """
    cells = record["cells"]
    bars = [*_accuracy(cells), *_sharing(cells), *_start(cells)]
    if record["costs"]:
        bars += _costs(record["costs"])
    return [bar.record() for bar in bars]


def paired(
    cells: list[Record], group: str, row: Row, base: Row, value: Callable[[Record], float]
) -> list[tuple[float, float]]:
    """Return (value of a row, value of another) for every cell of a group that has both."""
    return [
        (value(cell["rows"][row.label]), value(cell["rows"][base.label]))
        for cell in cells
        if cell["group"] == group and row.label in cell["rows"] and base.label in cell["rows"]
    ]


def average(row: Record) -> float:
    """Return the average texture PSNR of a row, in dB."""
    return row["psnr"]["average"]


def seconds(row: Record) -> float:
    """Return the warm run time of a row."""
    return row["seconds"]


def gain(cells: list[Record], group: str, row: Row, base: Row) -> list[float]:
    """Return how many dB a row is better than another, per cell of a group."""
    return [a - b for a, b in paired(cells, group, row, base, average)]


def ratio(cells: list[Record], row: Row, base: Row) -> float:
    """Return the time of a row as a part of another's: the median over even cells."""
    return float(np.median([a / b for a, b in paired(cells, "even", row, base, seconds)]))


def _accuracy(cells: list[Record]) -> list[Bar]:
    bars = []
    if found := gain(cells, "even", SH, PATH):
        bars += [
            Bar("SH (ours) over path, average texture PSNR, mean over cells", _mean(found), -0.5,
                "dB", least=True),
            Bar("SH (ours): time, as a part of path's", ratio(cells, SH, PATH), 1 / 15, ""),
        ]  # fmt: skip
    if found := gain(cells, "even", SH, SH_PAPER):
        bars += [
            Bar("SH (ours) over SH (paper), average texture PSNR, mean", _mean(found), 0.0, "dB",
                least=True),
            Bar("SH (ours): time, as a part of SH (paper)'s", ratio(cells, SH, SH_PAPER), 1.0, ""),
        ]  # fmt: skip
    return bars


def _sharing(cells: list[Record]) -> list[Bar]:
    bars = []
    for row, base, least in ((SH_SHARING, SH, 1.5), (PATH_SHARING, PATH, 0.5)):
        if found := gain(cells, "repeated", row, base):
            bars.append(
                Bar(f"{row.label} over {base.label}, repeated materials seen unevenly, mean",
                    _mean(found), least, "dB", least=True)
            )  # fmt: skip
        if found := gain(cells, "varied", row, base):
            bars.append(
                Bar(f"{row.label} over {base.label}, nothing repeated, worst cell", min(found),
                    -0.1, "dB", least=True)
            )  # fmt: skip
    return bars


def _start(cells: list[Record]) -> list[Bar]:
    if not (found := gain(cells, "even", SH_PATH, PATH)):
        return []
    return [
        Bar("SH + path (one epoch) over path, average texture PSNR, mean", _mean(found), 0.0, "dB",
            least=True),
        Bar("SH + path: time, as a part of path's", ratio(cells, SH_PATH, PATH), 1 / 3, ""),
    ]  # fmt: skip


def _costs(costs: Record) -> list[Bar]:
    few, many = costs["views"]
    bars = [
        *(Bar(f"what sharing ({name}) adds to a path step", found["part"], 0.05, "")
          for name, found in costs["sharing"].items()),
        Bar(f"SH descent step, {many['views']} views over {few['views']}",
            many["seconds"] / few["seconds"], 1.1, "times"),
    ]  # fmt: skip
    for method, found in costs["long"].items():
        label = f"{method}, {found['steps']} steps"
        bars.append(Bar(f"{label}: kernels compiled after the start", found["compiled"], 0, ""))
        if found["grown"] is not None:
            # The allocator of the C library gives pages back late: noise of a few MiB.
            bars.append(Bar(f"{label}: growth of resident memory", found["grown"], 8.0, "MiB"))
    return bars


def _mean(values: list[float]) -> float:
    return float(np.mean(values))
