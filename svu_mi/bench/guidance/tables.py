"""What ``run_guidance`` found, as Markdown tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from svu_mi.bench.bars import bar_table
from svu_mi.bench.failures import left_out
from svu_mi.bench.guidance.verdict import compare, mean_curve, mean_gain, views_needed
from svu_mi.bench.text import number, seconds, table

Record = dict[str, Any]


def guidance_tables(record: Record) -> str:
    """Return the tables of a record.

    Args:
        record: what ``run_guidance`` returns.
    """
    parts = []
    if record["bars"]:
        parts += ["## Bars", bar_table(record["bars"])]
    if record["quick"]:
        parts.append("Quick sizes, which the bars are not meant for.")
    if record["runs"]:
        parts += _curves(record["runs"], record["sizes"])
    if record["speed"]:
        parts += _speed(record["speed"])
    parts += left_out("Left out of guidance", record)
    return "\n\n".join(parts)


def _curves(runs: list[Record], sizes: Any) -> list[str]:
    strategies, marks = sizes.strategies, sizes.marks
    heads = ("strategy", *(f"+{mark}" for mark in marks), f"views for +{sizes.step:g} dB")
    rows = [
        [s, *(f"{v:+.2f}" for v in mean_curve(runs, s)[1:]),
         _needed(views_needed(marks, mean_curve(runs, s), sizes.step), marks)]
        for s in strategies
    ]  # fmt: skip
    bits = [[s, *(f"{v:+.3f}" for v in mean_curve(runs, s, "entropy")[1:])] for s in strategies]
    parts = [
        "## Views to photograph next",
        f"{len(runs)} starts of {sizes.start} photographs. Average texture PSNR, recovered by SH, "
        "above that of the start (dB), by the number of added views; means over objects. Texels "
        "that any view sees count, also before they are seen.",
        table(heads, rows),
        "Mean entropy, relative to the start's.",
        table(("strategy", *(f"+{mark}" for mark in marks)), bits),
    ]
    for name, what in (("psnr", "PSNR (dB)"), ("entropy", "entropy (positive: lower)")):
        rows = [
            [f["strategy"], f["other"], f"{f['difference']:+.3f}", f"{f['p']:.2g}",
             f"{f['better']} of {f['objects']}"]
            for f in compare(runs, sizes, name)
        ]  # fmt: skip
        parts += [
            f"Mean gain in {what} of one strategy over another; paired t-test over objects.",
            table(("strategy", "over", "difference", "p", "better for"), rows),
        ]
    return [*parts, *_cells(runs, sizes)]


def _cells(runs: list[Record], sizes: Any) -> list[str]:
    """Mean gain of PSNR in every cell, starts averaged."""
    rows = []
    for cell in dict.fromkeys(run["cell"] for run in runs):
        own = [run for run in runs if run["cell"] == cell]
        gains = [
            np.mean([mean_gain(sizes.marks, run["curves"][s]["psnr"]) for run in own])
            for s in sizes.strategies
        ]
        rows.append([cell, *(f"{gain:+.2f}" for gain in gains)])
    return ["Mean gain of PSNR over all added views, by cell (dB).",
            table(("cell", *sizes.strategies), rows)]  # fmt: skip


def _speed(speed: Record) -> list[str]:
    rows = [
        [row["label"], point["candidates"], point["texels"], number(point["hypotheses"], 1),
         seconds(point["prepare"]), seconds(point["first"]), seconds(point["later"])]
        for row in speed["methods"] for point in row["points"]
    ]  # fmt: skip
    refit = speed["refitting"]
    return [
        "## Time per added view",
        f"{speed['photographs']} photographs; warm, medians. Prepare: once, all views of all "
        "texels; first: every candidate; later: what the view before has changed.",
        table(("method", "candidates", "texels", "truths", "prepare", "first", "later"), rows),
        f"Refitting one candidate for one truth takes {seconds(refit['seconds'])} (fits, spectra, "
        f"posterior; kernels compiled); all {refit['evaluations']} would take "
        f"{seconds(refit['seconds'] * refit['evaluations'])}, {refit['times']:.0f} times as long "
        f"as the step by rank-1 changes ({seconds(refit['step'])}). With one fit per candidate, "
        f"as spectra of truths follow from that of the light: {seconds(refit['once'])}, "
        f"{refit['once'] / refit['step']:.0f} times as long.",
    ]


def _needed(value: float, marks: tuple[int, ...]) -> str:
    return number(value, 1) if np.isfinite(value) else f"> {marks[-1]}"
