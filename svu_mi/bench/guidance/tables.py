"""What the guidance benchmark found, as Markdown tables."""

from __future__ import annotations

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.guidance.verdict import compare, mean_curve, mean_gain, views_needed
from svu_mi.bench.sizes import GuidanceSizes
from svu_mi.bench.text import Column, columns, number, table

COMPARED = (
    Column("strategy", lambda found: found["strategy"]),
    Column("over", lambda found: found["other"]),
    Column("difference", lambda found: found["difference"], lambda value: f"{value:+.3f}"),
    Column("p", lambda found: found["p"], lambda value: f"{value:.2g}"),
    Column("better for", lambda found: f"{found['better']} of {found['objects']}"),
)


def guidance_tables(record: Record) -> list[str]:
    """Return the tables of a record.

    Args:
        record: of ``svu bench guidance``.
    """
    runs, sizes = record["cells"], record["sizes"].guidance
    if not runs:
        return []
    marks = [f"+{mark}" for mark in sizes.marks]
    gains = [
        [s, *(f"{v:+.2f}" for v in mean_curve(runs, s)[1:]),
         _needed(views_needed(sizes.marks, mean_curve(runs, s), sizes.step), sizes)]
        for s in sizes.strategies
    ]  # fmt: skip
    entropies = [[s, *(f"{v:+.3f}" for v in mean_curve(runs, s, "entropy")[1:])]
                 for s in sizes.strategies]  # fmt: skip
    parts = [
        f"{len(runs)} starts of {sizes.start} photographs. Average texture PSNR, recovered by SH, "
        "above that of the start (dB), by the number of added views; means over objects. Texels "
        "that any view sees count, also before they are seen.",
        table(("strategy", *marks, f"views for +{sizes.step:g} dB"), gains),
        "Mean entropy, relative to the start's.",
        table(("strategy", *marks), entropies),
    ]
    for name, what in (("psnr", "PSNR (dB)"), ("entropy", "entropy (positive: lower)")):
        parts += [
            f"Mean gain in {what} of one strategy over another; paired t-test over objects.",
            columns(COMPARED, compare(runs, sizes, name)),
        ]
    return [*parts, *_cells(runs, sizes)]


def _cells(runs: list[Record], sizes: GuidanceSizes) -> list[str]:
    """Mean gain of PSNR in every cell, starts averaged."""
    rows = []
    for cell in dict.fromkeys(run["cell"] for run in runs):
        own = [run for run in runs if run["cell"] == cell]
        gains = [
            np.mean([mean_gain(sizes.marks, run["rows"][s]["psnr"]) for run in own])
            for s in sizes.strategies
        ]
        rows.append([cell, *(f"{gain:+.2f}" for gain in gains)])
    return ["Mean gain of PSNR over all added views, by cell (dB).",
            table(("cell", *sizes.strategies), rows)]  # fmt: skip


def _needed(value: float, sizes: GuidanceSizes) -> str:
    return number(value, 1) if np.isfinite(value) else f"> {sizes.marks[-1]}"
