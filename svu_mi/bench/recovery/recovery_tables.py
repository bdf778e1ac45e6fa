"""Bars, tables and plot of the recovery benchmark."""

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
    digits,
    page,
    seconds,
    table,
    tabulate,
    tidy,
    time_axis,
)
from svu_mi.bench.recovery.methods import PATH, ROWS, SH, SH_PAPER, SH_PATH, RecoveryMethod
from svu_mi.parameters import NAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def paired(
    cases: Sequence[Record],
    row: RecoveryMethod,
    base: RecoveryMethod,
    value: Callable[[Record], Any],
) -> list[tuple[Any, Any]]:
    """Return (value of ``row``, value of ``base``) for each case that has both."""
    return [
        (value(case["rows"][row.label]), value(case["rows"][base.label]))
        for case in cases
        if row.label in case["rows"] and base.label in case["rows"]
    ]


def psnr_gaps(cases: Sequence[Record], row: RecoveryMethod, base: RecoveryMethod) -> list[float]:
    """Return average texture PSNR of ``row`` minus ``base`` in dB, per case."""
    return [a - b for a, b in paired(cases, row, base, lambda figures: figures["psnr"]["average"])]


def mean_psnr_gap(cases: Sequence[Record], row: RecoveryMethod, base: RecoveryMethod) -> float:
    """Return the mean of ``psnr_gaps``; NaN without cases."""
    differences = psnr_gaps(cases, row, base)
    return float(np.mean(differences)) if differences else float("nan")


def time_ratio(cases: Sequence[Record], row: RecoveryMethod, base: RecoveryMethod) -> float:
    """Return time of ``row`` / time of ``base``, median over cases; NaN without cases."""
    ratios = [a / b for a, b in paired(cases, row, base, lambda figures: figures["seconds"])]
    return float(np.median(ratios)) if ratios else float("nan")


@dataclass(frozen=True)
class MethodComparison:
    """A bar on the comparison of two recovery methods.

    Attributes:
        row: First method.
        base: Method that it is compared with.
        title: Name of the value.
        value: Returns the value.
        limit: Upper limit, or lower limit if ``least``.
        unit: Unit of value and limit.
        least: True for a lower limit.
    """

    row: RecoveryMethod
    base: RecoveryMethod
    title: str
    value: Callable[[Sequence[Record], RecoveryMethod, RecoveryMethod], float]
    limit: float
    unit: str = ""
    least: bool = False

    def bar(self, cases: Sequence[Record]) -> Bar:
        """Return the bar; its value is NaN if no case has both rows."""
        title = f"{self.row.label} over {self.base.label}, {self.title}"
        value = self.value(cases, self.row, self.base)
        return Bar(title, value, self.limit, self.unit, self.least)


def psnr_comparison(row: RecoveryMethod, base: RecoveryMethod, limit: float) -> MethodComparison:
    """Return a bar: lower limit of the mean PSNR of ``row`` minus ``base``."""
    title = "average texture PSNR, mean over cases"
    return MethodComparison(row, base, title, mean_psnr_gap, limit, "dB", True)


COMPARISONS = (
    psnr_comparison(SH, PATH, -0.5),
    MethodComparison(SH, PATH, "ratio of times", time_ratio, 1 / 15),
    psnr_comparison(SH, SH_PAPER, 0.0),
    MethodComparison(SH, SH_PAPER, "ratio of times", time_ratio, 1.0),
    psnr_comparison(SH_PATH, PATH, 0.0),
    MethodComparison(SH_PATH, PATH, "ratio of times", time_ratio, 1 / 3),
)


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of a record of ``svu bench recovery`` whose methods were run."""
    bars = [claim.bar(record["cells"]) for claim in COMPARISONS]
    return [bar for bar in bars if not np.isnan(bar.value)]


Line = tuple[str, Sequence[Record]]  # label and records of a table row


def _mean_at(*path: str) -> Callable[[Line], float | None]:
    """Return a function that averages the entry at nested keys ``path`` over records of a line."""

    def mean(line: Line) -> float | None:
        values: list[Any] = [reduce(_entry, path, record) for record in line[1]]
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known else None

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
    """Return the tables of a record of ``svu bench recovery``."""
    cases = record["cells"]
    if not cases:
        return []
    rows = [row for row in ROWS if any(row.label in case["rows"] for case in cases)]
    return [
        "PSNR of textures over visible texels, in dB. Relit: pictures of the object under another "
        "light with recovered and with true textures, PSNR of radiance and of tone-mapped values. "
        "Wall-clock times with compiled kernels. Direct light.",
        f"{len(cases)} cases (object / light): {', '.join(map(title_of, cases))}; "
        f"{cases[0]['views']} photographs.",
        tabulate(MEANS, _lines(cases, rows)),
        _by_case(cases, rows),
    ]


def title_of(case: Record) -> str:
    """Return ``object / light`` of a case."""
    return f"{case['object']} / {case['light']}"


def _lines(cases: list[Record], rows: list[RecoveryMethod]) -> list[Line]:
    """Return table lines of methods (with the number of cases if not all) and true textures."""
    lines: list[Line] = []
    for row in rows:
        measured = [case["rows"][row.label] for case in cases if row.label in case["rows"]]
        label = row.label if len(measured) == len(cases) else f"{row.label} ({len(measured)} cases)"
        lines.append((label, measured))
    ceiling = [{"relit": case["truth_relit"]} for case in cases]
    return [*lines, ("true textures at this resolution", ceiling)]


def _by_case(cases: list[Record], rows: list[RecoveryMethod]) -> str:
    """Return a table of the average PSNR and time of every case and row."""
    lines = []
    for case in cases:
        measured = [case["rows"].get(row.label) for row in rows]
        lines.append([title_of(case), *("" if one is None else f"{one['psnr']['average']:.2f}, "
                              f"{seconds(one['seconds'])}" for one in measured)])  # fmt: skip
    return table(("case", *(row.label for row in rows)), lines)


def draw_recovery(records: Record) -> Figure:
    """Plot average texture PSNR over run time: small marks are cases, large ones means."""
    cases, figure = records["recovery"]["cells"], page(6.5, 4.8)
    axes = figure.add_subplot()
    times: list[float] = []
    for number, row in enumerate(ROWS):
        having = [case["rows"][row.label] for case in cases if row.label in case["rows"]]
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
    axes.set(xlabel="run time with compiled kernels", ylabel="average texture PSNR (dB)")
    axes.set_title(f"{len(cases)} cases (small) and their mean (large)", fontsize=10, color=INK)
    axes.legend(frameon=False, fontsize=8)
    tidy(axes)
    return figure
