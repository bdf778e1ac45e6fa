"""Bars, tables and the plot of the recovery benchmark."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.markdown import (
    COLORS,
    INK,
    MARKS,
    Bar,
    Column,
    columns,
    digits,
    page,
    seconds,
    table,
    tidy,
    time_axis,
)
from svu_mi.bench.recovery.methods import PATH, ROWS, SH, SH_PAPER, SH_PATH, Row
from svu_mi.parameters import NAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


Line = tuple[str, Sequence[Record]]  # a label, and the records that its figures are means of


def _mean_at(*path: str) -> Callable[[Line], float | None]:
    """Return what takes the mean of a figure that records hold at a path of names.

    Where no record has it, there is none.
    """

    def mean(line: Line) -> float | None:
        values: list[Any] = [reduce(_entry, path, record) for record in line[1]]
        found = [value for value in values if value is not None]
        return float(np.mean(found)) if found else None

    return mean


def _entry(record: Any, name: str) -> Any:
    return None if record is None else record.get(name)


MEANS = (
    Column("recovery", lambda line: line[0]),
    *(Column(name.replace("_", " ").replace("color", "colour"), _mean_at("psnr", name),
             digits(2)) for name in NAMES),
    Column("average", _mean_at("psnr", "average"), digits(2)),
    Column("average, hardly seen", _mean_at("psnr_hardly_seen", "average"), digits(2)),
    Column("relit, HDR", _mean_at("relit", "psnr_hdr"), digits(2)),
    Column("relit, LDR", _mean_at("relit", "psnr_ldr"), digits(2)),
    Column("relit, SSIM", _mean_at("relit", "ssim"), digits(3)),
    Column("time", _mean_at("seconds"), seconds),
    Column("error with entropy, Pearson", _mean_at("entropy_correlation"), digits(2)),
)  # fmt: skip


def recovery_tables(record: Record) -> list[str]:
    """Return the tables of a record.

    Args:
        record: of ``svu bench recovery``.
    """
    cells = record["cells"]
    if not cells:
        return []
    rows = [row for row in ROWS if any(row.label in cell["rows"] for cell in cells)]
    return [
        "PSNR of textures over the texels that a photograph shows, in dB; relit: pictures under "
        "another light with recovered and with true textures, pixels of the object only, PSNR of "
        "radiance and of tone-mapped values. Times are warm, by the clock. Direct light.",
        f"{len(cells)} cells (object / light): {', '.join(map(title_of, cells))}; "
        f"{cells[0]['views']} photographs.",
        columns(MEANS, _lines(cells, rows)),
        _by_cell(cells, rows),
    ]


def title_of(cell: Record) -> str:
    """Return ``object / light`` of a cell."""
    return f"{cell['object']} / {cell['light']}"


def _lines(cells: list[Record], rows: list[Row]) -> list[Line]:
    """Means over cells; a row that not all cells have says how many it is the mean of."""
    lines: list[Line] = []
    for row in rows:
        found = [cell["rows"][row.label] for cell in cells if row.label in cell["rows"]]
        label = row.label if len(found) == len(cells) else f"{row.label} ({len(found)} cells)"
        lines.append((label, found))
    ceiling = [{"relit": cell["truth_relit"]} for cell in cells]
    return [*lines, ("true textures at this resolution", ceiling)]


def _by_cell(cells: list[Record], rows: list[Row]) -> str:
    """Average PSNR and time of every cell and row."""
    lines = []
    for cell in cells:
        found = [cell["rows"].get(row.label) for row in rows]
        lines.append([title_of(cell), *("" if one is None else f"{one['psnr']['average']:.2f}, "
                              f"{seconds(one['seconds'])}" for one in found)])  # fmt: skip
    return table(("cell", *(row.label for row in rows)), lines)


def draw_recovery(found: Record) -> Figure:
    """Draw run time against average texture PSNR, every cell small, their mean large, from the
    records of all benchmarks."""
    cells, figure = found["recovery"]["cells"], page(6.5, 4.8)
    axes = figure.add_subplot()
    times: list[float] = []
    for number, row in enumerate(ROWS):
        having = [cell["rows"][row.label] for cell in cells if row.label in cell["rows"]]
        if not having:
            continue
        color, mark = COLORS[number % len(COLORS)], MARKS[number % len(MARKS)]
        took = [one["seconds"] for one in having]
        good = [one["psnr"]["average"] for one in having]
        axes.plot(took, good, mark, color=color, markersize=3.5, alpha=0.35)
        axes.plot([float(np.mean(took))], [float(np.mean(good))], mark, color=color, markersize=10,
                  markeredgecolor="white", label=row.label, zorder=3)  # fmt: skip
        times += took
    time_axis(axes, times)
    axes.set(xlabel="run time, kernels compiled", ylabel="average texture PSNR (dB)")
    axes.set_title(f"{len(cells)} cells (small) and their mean", fontsize=10, color=INK)
    axes.legend(frameon=False, fontsize=8)
    tidy(axes)
    return figure
