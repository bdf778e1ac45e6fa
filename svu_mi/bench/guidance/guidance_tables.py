"""Significance, bars, tables and the plot of the guidance benchmark."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from svu_mi.bench.experiment import Record
from svu_mi.bench.markdown import (
    COLORS,
    INK,
    MARKS,
    Bar,
    Column,
    number,
    page,
    table,
    tabulate,
    tidy,
)
from svu_mi.bench.problem_sizes import GuidanceSizes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Times as many views as the judged strategy that farthest-point sampling needs, by kind of start.
FEWER = {"even": 1.4, "one-sided": 1.2}
AGREES = 0.8  # mean correlation of forecasts with what photographs change
LUCK = 0.01


def views_needed(marks: tuple[int, ...], psnr: list[float], step: float) -> float:
    """Return the added views, interpolated, from which PSNR stays ``step`` dB over the start's.

    Args:
        marks: numbers of added views.
        psnr: at 0 and at each of them, dB.
        step: dB.

    Returns:
        NaN if the last value is below.
    """
    places, over = [0, *marks], np.asarray(psnr) - psnr[0] - step
    if over[-1] < 0:
        return float("nan")
    last = int(np.flatnonzero(over < 0)[-1])
    part = -over[last] / (over[last + 1] - over[last])
    return float(places[last] + part * (places[last + 1] - places[last]))


def mean_increase(marks: tuple[int, ...], values: list[float]) -> float:
    """Return the mean increase of a curve over its start, by the trapezoidal rule."""
    places = np.array([0, *marks], float)
    return float(np.trapezoid(np.asarray(values) - values[0], places) / places[-1])


def object_curves(runs: list[Record], strategy: str, name: str = "psnr") -> np.ndarray:
    """Return a strategy's curve above the start, (objects, 1 + marks).

    Starts and lights of one object are not independent samples: they are averaged.
    """
    by_object: dict[str, list[np.ndarray]] = {}
    for run in runs:
        curve = np.asarray(run["rows"][strategy][name])
        by_object.setdefault(run["object"], []).append(curve - curve[0])
    return np.array([np.mean(curves, axis=0) for curves in by_object.values()])


def mean_curve(runs: list[Record], strategy: str, name: str = "psnr") -> list[float]:
    """Return the mean over objects of ``object_curves``."""
    return object_curves(runs, strategy, name).mean(axis=0).tolist()


def compare(runs: list[Record], sizes: GuidanceSizes, name: str = "psnr") -> list[Record]:
    """Compare the judged strategies with every other, in pairs over objects.

    Returns:
        Per pair ``strategy`` and ``other``, ``difference`` of mean gains, ``p`` of a paired t-test
        (two-sided, not corrected for the number of pairs), ``objects``, and of how many of them
        the first is ``better``.
    """
    sign = -1.0 if name == "entropy" else 1.0
    gains = {
        s: np.array([sign * mean_increase(sizes.marks, c) for c in object_curves(runs, s, name)])
        for s in sizes.strategies
    }
    comparisons = []
    for first in sizes.judged:
        for other in (s for s in sizes.strategies if s not in sizes.judged):
            difference = gains[first] - gains[other]
            several = len(difference) > 1
            p = float(scipy.stats.ttest_1samp(difference, 0).pvalue) if several else float("nan")
            comparisons.append({
                "strategy": first, "other": other, "difference": float(difference.mean()),
                "p": p,
                "objects": len(difference), "better": int((difference > 0).sum()),
            })  # fmt: skip
    return comparisons


def views_ratio(runs: list[Record], sizes: GuidanceSizes, first: str, other: str) -> float:
    """Return how many times as many views another strategy needs on the mean curve.

    If it does not get there at all, at least so many; NaN if the first does not.
    """
    needed, others = (
        views_needed(sizes.marks, mean_curve(runs, s), sizes.step) for s in (first, other)
    )
    return (sizes.marks[-1] if np.isnan(others) else others) / needed


def find_bars(record: Record) -> list[Bar]:
    """Return the bars that a record has figures for.

    Args:
        record: of ``svu bench guidance``.
    """
    runs, sizes = record["cells"], record["sizes"].guidance
    bars = []
    for kind in dict.fromkeys(run["kind"] for run in runs):
        own = [run for run in runs if run["kind"] == kind]
        for first in sizes.judged:
            what = (f"{kind} starts: views that farthest needs for +{sizes.step:g} dB, mean curve, "
                    f"over {first}'s")  # fmt: skip
            times = views_ratio(own, sizes, first, "farthest")
            bars.append(Bar(what, times, FEWER[kind], "times", least=True))
        agreement = float(np.mean([run["agreement"]["correlation"] for run in own]))
        what = f"{kind} starts: correlation of expected and real change of entropy, mean"
        bars.append(Bar(what, agreement, AGREES, least=True))
    for comparison in compare(runs, sizes) if runs else ():
        if comparison["other"] in ("coverage", "random"):
            what = f"{comparison['strategy']} over {comparison['other']}: mean gain of texture PSNR"
            bars.append(Bar(what, comparison["difference"], 0.0, "dB", least=True))
            bars.append(Bar(f"{what}: p of a paired t-test over objects", comparison["p"], LUCK))
    return bars


COMPARED = (
    Column("strategy", lambda row: row["strategy"]),
    Column("over", lambda row: row["other"]),
    Column("difference", lambda row: row["difference"], lambda value: f"{value:+.3f}"),
    Column("p", lambda row: row["p"], lambda value: f"{value:.2g}"),
    Column("better for", lambda row: f"{row['better']} of {row['objects']}"),
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
            tabulate(COMPARED, compare(runs, sizes, name)),
        ]
    return [*parts, *_cases(runs, sizes)]


def _cases(runs: list[Record], sizes: GuidanceSizes) -> list[str]:
    """Mean gain of PSNR in every case, starts averaged."""
    rows = []
    for case in dict.fromkeys(run["cell"] for run in runs):
        own = [run for run in runs if run["cell"] == case]
        gains = [
            np.mean([mean_increase(sizes.marks, run["rows"][s]["psnr"]) for run in own])
            for s in sizes.strategies
        ]
        rows.append([case, *(f"{gain:+.2f}" for gain in gains)])
    return ["Mean gain of PSNR over all added views, by cell (dB).",
            table(("cell", *sizes.strategies), rows)]  # fmt: skip


def _needed(value: float, sizes: GuidanceSizes) -> str:
    return number(value, 1) if np.isfinite(value) else f"> {sizes.marks[-1]}"


def draw_guidance(records: Record) -> Figure:
    """Draw both curves of every strategy, from the records of all benchmarks."""
    runs, sizes = records["guidance"]["cells"], records["guidance"]["sizes"].guidance
    figure = page(12.0, 4.6)
    left, right = figure.subplots(1, 2)
    _curves(left, runs, sizes, "psnr", "average texture PSNR over the start's (dB)")
    left.axhline(sizes.step, color=INK, linewidth=0.6, linestyle=":")
    _curves(right, runs, sizes, "entropy", "mean entropy, relative to the start's")
    left.legend(frameon=False, fontsize=8)
    return figure


def _curves(axes: Axes, runs: list[Record], sizes: GuidanceSizes, name: str, label: str) -> None:
    """Mean over objects, and its standard error as a band."""
    places = [0, *sizes.marks]
    for k, strategy in enumerate(sizes.strategies):
        color, mark = COLORS[k % len(COLORS)], MARKS[k % len(MARKS)]
        curves = object_curves(runs, strategy, name)
        mean, error = curves.mean(axis=0), np.zeros(curves.shape[1])
        if len(curves) > 1:
            error = curves.std(axis=0, ddof=1) / np.sqrt(len(curves))
        style = {"color": color, "markersize": 5, "linewidth": 1.2}
        axes.plot(places, mean, mark + "-", label=strategy, **style)
        axes.fill_between(places, mean - error, mean + error, color=color, alpha=0.12, linewidth=0)
    axes.set(xlabel="photographs added", ylabel=label)
    axes.set_title(f"{len(runs)} starts of {sizes.start} photographs", fontsize=10, color=INK)
    tidy(axes)
