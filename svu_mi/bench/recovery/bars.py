"""Figures that recovery has to reach, each with what was measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.recovery.rows import PATH, SH, SH_PAPER, SH_PATH, Row
from svu_mi.bench.text import Bar


def paired(
    cells: Sequence[Record], row: Row, base: Row, value: Callable[[Record], Any]
) -> list[tuple[Any, Any]]:
    """Return (value of a row, value of another) for every cell that has both."""
    return [
        (value(cell["rows"][row.label]), value(cell["rows"][base.label]))
        for cell in cells
        if row.label in cell["rows"] and base.label in cell["rows"]
    ]


def gain(cells: Sequence[Record], row: Row, base: Row) -> list[float]:
    """Return how many dB a row's average texture PSNR is above another's, per cell."""
    return [a - b for a, b in paired(cells, row, base, lambda found: found["psnr"]["average"])]


def mean_gain(cells: Sequence[Record], row: Row, base: Row) -> float:
    """Return the mean of ``gain``; NaN without any."""
    found = gain(cells, row, base)
    return float(np.mean(found)) if found else float("nan")


def time_ratio(cells: Sequence[Record], row: Row, base: Row) -> float:
    """Return the time of a row as a part of another's, the median over cells; NaN without any."""
    found = [a / b for a, b in paired(cells, row, base, lambda found: found["seconds"])]
    return float(np.median(found)) if found else float("nan")


@dataclass(frozen=True)
class Claim:
    """What one way of recovery has to reach in comparison with another.

    Attributes:
        row, base: the two ways.
        what: is compared, said in words.
        value: the figure.
        limit: its bar.
        unit: of both.
        least: whether the figure has to reach the bar, rather than stay below it.
    """

    row: Row
    base: Row
    what: str
    value: Callable[[Sequence[Record], Row, Row], float]
    limit: float
    unit: str = ""
    least: bool = False

    def bar(self, cells: Sequence[Record]) -> Bar:
        """Return the bar; its value is NaN if no cell has both rows."""
        what = f"{self.row.label} over {self.base.label}, {self.what}"
        value = self.value(cells, self.row, self.base)
        return Bar(what, value, self.limit, self.unit, self.least)


def gains(row: Row, base: Row, limit: float) -> Claim:
    """Return the claim that a row gains so many dB at least, in the mean over cells."""
    words = "average texture PSNR, mean over cells"
    return Claim(row, base, words, mean_gain, limit, "dB", True)


CLAIMS = (
    gains(SH, PATH, -0.5),
    Claim(SH, PATH, "time, part", time_ratio, 1 / 15),
    gains(SH, SH_PAPER, 0.0),
    Claim(SH, SH_PAPER, "time, part", time_ratio, 1.0),
    gains(SH_PATH, PATH, 0.0),
    Claim(SH_PATH, PATH, "time, part", time_ratio, 1 / 3),
)


def find_bars(record: Record) -> list[Bar]:
    """Return the bars that a record has figures for.

    Args:
        record: of ``svu bench recovery``.
    """
    bars = [claim.bar(record["cells"]) for claim in CLAIMS]
    return [bar for bar in bars if not np.isnan(bar.value)]
