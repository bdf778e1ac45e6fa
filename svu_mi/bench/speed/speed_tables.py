"""Tables and plots of the speed benchmark."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.markdown import (
    COLORS,
    INK,
    Column,
    digits,
    number,
    page,
    seconds,
    table,
    tabulate,
    tidy,
)

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
    Column("variable", lambda row: SCALED[row[0]]),
    Column("estimator", lambda row: row[1]),
    Column("value", lambda row: row[2]["value"]),
    Column("time", lambda row: row[2]["seconds"], seconds),
    Column("Pearson", lambda row: row[2]["pearson"], digits(3)),
)


KERNELS = (
    Column("estimator", lambda line: line[0]),
    Column("stage", lambda line: line[1]),
    Column("time in kernels", lambda line: line[2]["seconds"], seconds),
    Column("us per texel", lambda line: 1e6 * line[2]["seconds"] / line[3], digits(3)),
    Column("kernels", lambda line: line[2]["launched"]),
    Column("operations", lambda line: line[2]["operations"]),
)
GATHER = (
    Column("rays", lambda line: line[0]),
    Column("million rays per second", lambda line: line[1]["rays_per_second"] / 1e6, digits(1)),
    Column("time in kernels", lambda line: line[1]["kernel"]["median"], seconds),
    Column("wall-clock time", lambda line: line[1]["wall"]["median"], seconds),
    Column("unoccluded rays", lambda line: line[1]["free"], lambda value: f"{value:,}"),
)


def speed_tables(record: Record) -> list[str]:
    """Return the tables of a record of ``svu bench speed``."""
    if not record["cells"]:
        return []
    (case,) = record["cells"]
    points = [(what, label, point) for what in SCALED
              for label, curve in case["rows"][what].items() for point in curve]  # fmt: skip
    return [
        *_stages(case),
        f"## Run time and agreement: {case['cell']}",
        "Pearson correlation with the reference posterior of the same photographs. The reference "
        "is compared with the reference with most samples.",
        tabulate(CURVES, points),
        *_brute(case["rows"]["brute"]),
        *_kernels(case),
        *_gather(case["rows"]["gather"]),
        *_whole_way(case),
    ]


def _stages(case: Record) -> list[str]:
    variants = case["rows"]["estimators"]
    stages = dict.fromkeys(stage for figures in variants.values() for stage in figures["warm"])
    rows: list[list[object]] = [
        [stage, *(seconds(value) for figures in variants.values() for value in
                  (figures["warm"].get(stage), figures["cold"]["timings"].get(stage)))]
        for stage in stages
    ]  # fmt: skip
    total, kernels = ["all"], ["kernels compiled"]
    for figures in variants.values():
        total += [seconds(figures["warm_seconds"]), seconds(figures["cold"]["seconds"])]
        kernels += ["0", str(figures["cold"]["kernels"])]
    heads = [f"{label}, {how}" for label in variants for how in ("warm", "cold")]
    repeats = next(iter(variants.values()))["repeats"]
    return [
        f"## Run time: {case['cell']}, {case['texels']} texels of {case['resolution']} x "
        f"{case['resolution']}, {case['views']} photographs of {case['film']} x {case['film']}",
        f"Warm: median of {repeats} runs. Cold: one new process with an empty kernel cache.",
        table(("stage", *heads), [*rows, total, kernels]),
    ]


def _brute(brute: Record) -> list[str]:
    return [
        "## Path-traced posterior of all texels (extrapolated)",
        f"{brute['pairs']:,} visible (texel, view) pairs x {brute['psi']} psi x {brute['spp']} "
        f"samples / {brute['rays_per_second']:.3g} rays per second = "
        f"**{seconds(brute['seconds'])}**, or {seconds(brute['linear_seconds'])} with 32 psi, "
        f"which suffice for direct light. Measured rate, warm: "
        f"{brute['sample_rays']:,} rays in {seconds(brute['sample_seconds'])}.",
    ]


def _kernels(case: Record) -> list[str]:
    lines = [
        (label, stage, figures, case["texels"])
        for label, variant in case["rows"]["estimators"].items()
        for stage, figures in variant["kernels"].items() if figures["operations"]
    ]  # fmt: skip
    return ["## Kernels", "Seconds in kernels, warm, without inner stages.",
            tabulate(KERNELS, lines)]  # fmt: skip


def _gather(gather: Record) -> list[str]:
    return [
        f"## Visibility pass: {gather['texels']:,} texels, {gather['views']} views, "
        f"{gather['triangles']:,} triangles",
        f"{gather['rays']:,} visibility rays remain after all cheaper tests. They are traced in "
        f"the visibility pass (survey), and alone; the pass reaches {gather['ratio']:.0%} of the "
        "faster of both rates.",
        tabulate(GATHER, list(gather["ways"].items())),
    ]


def _whole_way(case: Record) -> list[str]:
    methods = case["rows"]["whole_way"]
    stages = dict.fromkeys(
        stage for figures in methods.values() for stage in figures["warm"]["stages"]
    )
    rows = [
        [stage, *(seconds(value) for figures in methods.values() for value in (
            figures["warm"]["stages"].get(stage, {}).get("median"),
            figures["cold"]["stages"].get(stage)))]
        for stage in stages
    ]  # fmt: skip
    rows.append(["all", *(seconds(value) for figures in methods.values() for value in (
        figures["warm"]["seconds"]["median"], figures["cold"]["seconds"]))])  # fmt: skip
    for name, key, show in (("with start and imports", "process_seconds", seconds),
                            ("resident memory (MiB)", "peak_mib", _whole),
                            ("estimated (MiB)", "formula_mib", _whole)):  # fmt: skip
        rows.append([name, *(text for figures in methods.values()
                             for text in ("", show(figures["cold"][key])))])  # fmt: skip
    heads = [f"{name}, {how}" for name in methods for how in ("warm", "cold")]
    return ["## From files to entropy.exr", table(("stage", *heads), rows)]


def _whole(value: float | None) -> str:
    return number(value, 0)


def scaling(records: Record) -> Figure:
    """Plot the error over the run time for four variables."""
    (case,) = records["speed"]["cells"]
    figure = page(11, 7)
    for place, (what, title) in enumerate(SCALED.items(), 1):
        axes = figure.add_subplot(2, 2, place)
        for index, (label, curve) in enumerate(case["rows"][what].items()):
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
    figure.suptitle(case["cell"], fontsize=10, color=INK)
    return figure


def _from_zero(axes: Axes) -> None:
    """Start both axes at 0, with space for the label of the last point."""
    lines = [line.get_xydata() for line in axes.get_lines()]
    if lines:
        right, top = np.concatenate(lines).max(axis=0)
        axes.set(xlim=(0, 1.12 * right or 1), ylim=(0, 1.2 * top or 1))
