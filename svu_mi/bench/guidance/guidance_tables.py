"""Bars, tables, significance and plot of the guidance benchmark."""

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


# Bars of the ratio of views, farthest-point sampling over ours, by kind of the initial set.
FEWER = {"even": 1.4, "one-sided": 1.2}
AGREES = 0.8  # bar of the mean correlation of expected and measured changes
SIGNIFICANT = 0.01  # bar of p


def views_needed(marks: tuple[int, ...], psnr: list[float], step: float) -> float:
    """Return the interpolated number of added views after which the gain stays above ``step``.

    Args:
        marks: Numbers of added views.
        psnr: PSNR in dB at 0 and at each mark.
        step: Gain in dB.

    Returns:
        Number of views; NaN if the last gain is below ``step``.
    """
    places, over = [0, *marks], np.asarray(psnr) - psnr[0] - step
    if over[-1] < 0:
        return float("nan")
    last = int(np.flatnonzero(over < 0)[-1])
    part = -over[last] / (over[last + 1] - over[last])
    return float(places[last] + part * (places[last + 1] - places[last]))


def mean_increase(marks: tuple[int, ...], values: list[float]) -> float:
    """Return the mean increase of a curve above its first value, by the trapezoidal rule."""
    places = np.array([0, *marks], float)
    return float(np.trapezoid(np.asarray(values) - values[0], places) / places[-1])


def object_curves(runs: list[Record], strategy: str, name: str = "psnr") -> np.ndarray:
    """Return the curves of a strategy minus their first values, (objects, 1 + marks).

    Runs of one object are averaged, because they are not independent samples.
    """
    by_object: dict[str, list[np.ndarray]] = {}
    for run in runs:
        curve = np.asarray(run["rows"][strategy][name])
        by_object.setdefault(run["object"], []).append(curve - curve[0])
    return np.array([np.mean(curves, axis=0) for curves in by_object.values()])


def mean_curve(runs: list[Record], strategy: str, name: str = "psnr") -> list[float]:
    """Return the mean of ``object_curves`` over objects."""
    return object_curves(runs, strategy, name).mean(axis=0).tolist()


def compare(runs: list[Record], sizes: GuidanceSizes, name: str = "psnr") -> list[Record]:
    """Compare each judged strategy with every other one, by paired tests over objects.

    Returns:
        Per pair: ``strategy``, ``other``, ``difference`` of mean gains, ``p`` of a paired t-test
        (two-sided, not corrected for the number of pairs), number of ``objects``, and number of
        objects for which ``strategy`` is ``better``.
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
    """Return the ratio of the numbers of views that ``other`` and ``first`` need for a gain.

    The ratio is a lower bound if ``other`` never gains ``step``, and NaN if ``first`` does not.
    """
    needed, others = (
        views_needed(sizes.marks, mean_curve(runs, s), sizes.step) for s in (first, other)
    )
    return (sizes.marks[-1] if np.isnan(others) else others) / needed


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of a record of ``svu bench guidance``."""
    runs, sizes = record["cells"], record["sizes"].guidance
    bars = []
    for kind in dict.fromkeys(run["kind"] for run in runs):
        own = [run for run in runs if run["kind"] == kind]
        for first in sizes.judged:
            title = f"{kind} starts: views for +{sizes.step:g} dB, farthest over {first}"
            ratio = views_ratio(own, sizes, first, "farthest")
            bars.append(Bar(title, ratio, FEWER[kind], least=True))
        agreement = float(np.mean([run["agreement"]["correlation"] for run in own]))
        title = f"{kind} starts: correlation of expected and measured change of entropy, mean"
        bars.append(Bar(title, agreement, AGREES, least=True))
    for comparison in compare(runs, sizes) if runs else ():
        if comparison["other"] in ("coverage", "random"):
            title = f"{comparison['strategy']} over {comparison['other']}: mean gain of PSNR"
            bars.append(Bar(title, comparison["difference"], 0.0, "dB", least=True))
            bars.append(
                Bar(f"{title}: p of a paired t-test over objects", comparison["p"], SIGNIFICANT)
            )
    return bars


COMPARED = (
    Column("strategy", lambda row: row["strategy"]),
    Column("over", lambda row: row["other"]),
    Column("difference", lambda row: row["difference"], lambda value: f"{value:+.3f}"),
    Column("p", lambda row: row["p"], lambda value: f"{value:.2g}"),
    Column("better for", lambda row: f"{row['better']} of {row['objects']}"),
)


def guidance_tables(record: Record) -> list[str]:
    """Return the tables of a record of ``svu bench guidance``."""
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
        f"{len(runs)} initial sets of {sizes.start} photographs. Gain in average PSNR (dB) of "
        "textures recovered by SH, by number of added views; means over objects. All texels that "
        "any candidate shows are included.",
        table(("strategy", *marks, f"views for +{sizes.step:g} dB"), gains),
        "Change of the mean entropy since the initial set.",
        table(("strategy", *marks), entropies),
    ]
    for name, title in (("psnr", "PSNR (dB)"), ("entropy", "entropy (positive: lower)")):
        parts += [
            f"Mean gain in {title} of one strategy over another; paired t-test over objects.",
            tabulate(COMPARED, compare(runs, sizes, name)),
        ]
    return [*parts, *_cases(runs, sizes)]


def _cases(runs: list[Record], sizes: GuidanceSizes) -> list[str]:
    """Return a table with each case's mean gain of PSNR, averaged over its initial sets."""
    rows = []
    for case in dict.fromkeys(run["cell"] for run in runs):
        own = [run for run in runs if run["cell"] == case]
        gains = [
            np.mean([mean_increase(sizes.marks, run["rows"][s]["psnr"]) for run in own])
            for s in sizes.strategies
        ]
        rows.append([case, *(f"{gain:+.2f}" for gain in gains)])
    return ["Mean gain of PSNR over all added views, by case (dB).",
            table(("case", *sizes.strategies), rows)]  # fmt: skip


def _needed(value: float, sizes: GuidanceSizes) -> str:
    return number(value, 1) if np.isfinite(value) else f"> {sizes.marks[-1]}"


def draw_guidance(records: Record) -> Figure:
    """Plot PSNR and entropy of every strategy by number of added views."""
    runs, sizes = records["guidance"]["cells"], records["guidance"]["sizes"].guidance
    figure = page(12.0, 4.6)
    left, right = figure.subplots(1, 2)
    _curves(left, runs, sizes, "psnr", "gain in average texture PSNR (dB)")
    left.axhline(sizes.step, color=INK, linewidth=0.6, linestyle=":")
    _curves(right, runs, sizes, "entropy", "change of the mean entropy")
    left.legend(frameon=False, fontsize=8)
    return figure


def _curves(axes: Axes, runs: list[Record], sizes: GuidanceSizes, name: str, label: str) -> None:
    """Plot the mean curves over objects, with standard errors as bands."""
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
    axes.set_title(f"{len(runs)} initial sets of {sizes.start} photographs", fontsize=10, color=INK)
    tidy(axes)
