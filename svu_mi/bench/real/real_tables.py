"""Tables and plot of predicted photographs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.markdown import (
    COLORS,
    FAINT,
    MARKS,
    Column,
    digits,
    page,
    seconds,
    tabulate,
    tidy,
)
from svu_mi.bench.real.predictors import MASSES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _held(mass: float) -> Callable[[tuple[str, Record]], float | None]:
    return lambda row: row[1]["holds"].get(str(mass))


def _quantile(row: Record, q: float) -> float | None:
    return float(np.quantile(row["views"], q)) if row["views"] else None


PREDICTED = (
    Column("prediction", lambda row: row[0]),
    Column("photographs", lambda row: row[1]["scored"]),
    Column("R^2", lambda row: row[1]["r2"], digits(3)),
    Column("facing the camera", lambda row: row[1]["facing"], digits(3)),
    Column("steeper than 45 degrees", lambda row: row[1]["steep"], digits(3)),
    Column("median over photographs", lambda row: _quantile(row[1], 0.5), digits(3)),
    Column("10 % quantile", lambda row: _quantile(row[1], 0.1), digits(3)),
    Column("PSNR (dB)", lambda row: row[1]["psnr"], digits(1)),
    *(Column(f"{100 * mass:g} % intervals", _held(mass), digits(3)) for mass in MASSES),
    Column("time", lambda row: row[1]["seconds"], seconds),
)  # fmt: skip


def real_tables(record: Record) -> list[str]:
    """Return the tables of a record of ``svu bench real``."""
    parts = []
    for case in record["cells"]:
        parts += [_about(case), tabulate(PREDICTED, list(case["rows"].items())), _made_of(case)]
    return parts


def _about(case: Record) -> str:
    odd, (low, high) = case["odd"], case["gains"]
    fit = f"{len(odd)} do not fit the others: {', '.join(odd)}" if odd else "all fit"
    return (
        f"{case['cell']}: {case['left_out']} of {case['photographs']} photographs are held out and "
        f"predicted from the others ({fit}; gains {low:.2f} to {high:.2f}), at {case['texels']} "
        f"texels with enough photographs. Estimated in {seconds(case['seconds'])}. Gains of a "
        "held-out photograph are fitted to half of its texels, scores use the other half. Clipped "
        "pixels and photographs with few texels are not scored. R^2 is that of compressed radiance "
        "about the mean of each photograph; PSNR is that of sRGB values, where dark pixels count "
        "more, so the two may rank predictions differently. Columns with intervals: share that "
        "contains the pixel."
    )


def _made_of(case: Record) -> str:
    shares = case["metallic"]
    return (
        f"{shares['seen']} texels are visible in ten or more photographs. {shares['metallic']:.1%} "
        f"are metallic, {shares['open']:.1%} undecided and {shares['dielectric']:.1%} dielectric "
        f"(90 % interval above, across and below .5); {shares['reaches 1']:.1%} of the intervals "
        "reach beyond .9."
    )


def draw_real(records: dict[str, Record]) -> Figure | None:
    """Plot R^2 of every photograph and predictor, and the coverage of intervals.

    Args:
        records: Records of all benchmarks.
    """
    if "real" not in records or not records["real"]["cells"]:
        return None
    (case,) = records["real"]["cells"]
    figure = page(11, 4.6)
    views, held = figure.subplots(1, 2, width_ratios=(2, 1))
    for (label, row), color, mark in zip(case["rows"].items(), COLORS, MARKS, strict=False):
        views.plot(row["views"], mark, color=color, label=f"{label} ({row['r2']:.3f})", ms=5)
        if row["holds"]:
            parts = [row["holds"][str(mass)] for mass in MASSES]
            held.plot(MASSES, parts, mark + "-", color=color, label=label)
    views.set_ylim(max(min(-0.1, *(min(row["views"], default=0) for row in case["rows"].values())),
                       -1), 1)  # fmt: skip
    views.xaxis.get_major_locator().set_params(integer=True)
    views.set(xlabel="held-out photograph", ylabel="R² of its radiance",
              title=f"{case['cell']}: photographs predicted from the others")  # fmt: skip
    held.plot([0, 1], [0, 1], color=FAINT, lw=1, label="calibrated")
    held.set(xlabel="probability of an interval", ylabel="share that contains the pixel",
             xlim=(0.4, 1), ylim=(0.4, 1), title="Intervals of pixels")  # fmt: skip
    for axes in (views, held):
        tidy(axes)
        axes.legend(frameon=False, fontsize=9)
    return figure
