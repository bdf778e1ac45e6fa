"""What the speed benchmark found, as Markdown tables and as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.plots import COLORS, INK, page, tidy
from svu_mi.bench.text import Column, columns, digits, seconds, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCALED = {
    "degree": "degree l*",
    "grid": "nodes per axis",
    "views": "views",
    "reference_spp": "samples of the reference",
}
CURVES = (
    Column("what", lambda row: SCALED[row[0]]),
    Column("estimator", lambda row: row[1]),
    Column("value", lambda row: row[2]["value"]),
    Column("time", lambda row: row[2]["seconds"], seconds),
    Column("Pearson", lambda row: row[2]["pearson"], digits(3)),
)


def speed_tables(record: Record) -> list[str]:
    """Return the tables of a record.

    Args:
        record: of ``svu bench speed``.
    """
    if not record["cells"]:
        return []
    (cell,) = record["cells"]
    points = [(what, label, point) for what in SCALED
              for label, curve in cell["rows"][what].items() for point in curve]  # fmt: skip
    return [
        *_stages(cell),
        f"## Run time against agreement: {cell['cell']}",
        "Pearson correlation with the reference posterior of the same photographs; for the "
        "reference itself, with its largest number of samples.",
        columns(CURVES, points),
        *_brute(cell["rows"]["brute"]),
    ]


def _stages(cell: Record) -> list[str]:
    variants = cell["rows"]["estimators"]
    stages = dict.fromkeys(stage for found in variants.values() for stage in found["warm"])
    rows: list[list[object]] = [
        [stage, *(seconds(value) for found in variants.values() for value in
                  (found["warm"].get(stage), found["cold"]["timings"].get(stage)))]
        for stage in stages
    ]  # fmt: skip
    total, kernels = ["all"], ["kernels compiled"]
    for found in variants.values():
        total += [seconds(found["warm_seconds"]), seconds(found["cold"]["seconds"])]
        kernels += ["0", str(found["cold"]["kernels"])]
    heads = [f"{label}, {how}" for label in variants for how in ("warm", "cold")]
    repeats = next(iter(variants.values()))["repeats"]
    return [
        f"## Run time: {cell['cell']}, {cell['texels']} texels of {cell['resolution']} x "
        f"{cell['resolution']}, {cell['views']} photographs of {cell['film']} x {cell['film']}",
        f"Warm: median of {repeats}. Cold: one new process with an empty kernel cache.",
        table(("stage", *heads), [*rows, total, kernels]),
    ]


def _brute(brute: Record) -> list[str]:
    return [
        "## Path-traced posterior of all texels (extrapolated)",
        f"{brute['pairs']:,} visible (texel, view) pairs x {brute['psi']} psi x {brute['spp']} "
        f"samples / {brute['rays_per_second']:.3g} rays per second = "
        f"**{seconds(brute['seconds'])}**, or {seconds(brute['linear_seconds'])} with the 32 psi "
        f"that are enough for direct light. The rate is measured, warm: "
        f"{brute['sample_rays']:,} rays in {seconds(brute['sample_seconds'])}.",
    ]


def scaling(found: Record) -> Figure:
    """Draw four ways to spend time, each with the agreement that it buys."""
    (cell,) = found["speed"]["cells"]
    figure = page(11, 7)
    for place, (what, title) in enumerate(SCALED.items(), 1):
        axes = figure.add_subplot(2, 2, place)
        for index, (label, curve) in enumerate(cell["rows"][what].items()):
            points = [row for row in curve if row["pearson"] is not None]
            if not points:
                continue
            x, y = [row["seconds"] for row in points], [1 - row["pearson"] for row in points]
            axes.plot(x, y, "-o", color=COLORS[index], markersize=4, linewidth=1.2, label=label)
            for row, at, error in zip(points, x, y, strict=True):
                axes.annotate(f"{row['value']}", (at, error), xytext=(4, 4), fontsize=8,
                              textcoords="offset points", color=INK)  # fmt: skip
        axes.set_title(title, fontsize=10, color=INK)
        axes.set_xlabel("seconds")
        axes.set_ylabel("1 - Pearson")
        _from_zero(axes)
        if axes.get_legend_handles_labels()[1]:
            axes.legend(frameon=False, fontsize=8, loc="best")
        tidy(axes)
    figure.suptitle(cell["cell"], fontsize=10, color=INK)
    return figure


def _from_zero(axes: Axes) -> None:
    """Start both axes at 0 and leave room for labels beside the last point."""
    lines = [line.get_xydata() for line in axes.get_lines()]
    if lines:
        right, top = np.concatenate(lines).max(axis=0)
        axes.set(xlim=(0, 1.12 * right or 1), ylim=(0, 1.2 * top or 1))
