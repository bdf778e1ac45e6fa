"""Tables and plots of the accuracy benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.bench.correlation import mean_over_objects
from svu_mi.bench.experiment import Record
from svu_mi.bench.markdown import (
    COLORS,
    FAINT,
    INK,
    MARKS,
    Column,
    digits,
    page,
    seconds,
    tabulate,
    tidy,
    time_axis,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


KINDS = ("estimator", "sanity", "reference")


def _mean(correlation: Record) -> str:
    return f"{correlation['mean']:.2f}"


def _interval(correlation: Record) -> str:
    if correlation["low"] is None:
        return _mean(correlation)
    return f"{correlation['mean']:.2f} ({correlation['low']:.2f} to {correlation['high']:.2f})"


AGREEMENT = (
    Column("map", lambda row: row["label"]),
    Column("Pearson", lambda row: row["pearson"], _interval),
    Column("Spearman", lambda row: row["spearman"], _mean),
    Column("mean entropy", lambda row: row.get("mean_entropy"), digits(2)),
    Column("AUSE", lambda row: row.get("ause_relative"), digits(2)),
    Column("time", lambda row: row["seconds"] if row["kind"] == "estimator" else None, seconds),
)
ERRORS = (
    Column("posterior", lambda row: row[0]),
    Column("parameter", lambda row: row[1]),
    Column("bias", lambda row: row[2]["bias"], lambda value: f"{value:+.3f}"),
    Column("MAE", lambda row: row[2]["mae"], digits(3)),
    Column("RMSE", lambda row: row[2]["rmse"], digits(3)),
    Column("rho(error, entropy)", lambda row: row[2]["entropy_correlation"], digits(3)),
    Column("AUSE", lambda row: row[2]["ause_relative"], digits(3)),
)
SETS = (("plain", "whole cells"), ("fractional", "fractional"), ("size", "share of the grid"))


def accuracy_tables(record: Record) -> list[str]:
    """Return the tables of a record of ``svu bench accuracy``."""
    if not record["cells"]:
        return []
    judged = [row for row in record["summary"] if row["kind"] != "sanity"]
    errors = [(row["label"], name, figures)
              for row in judged for name, figures in row["parameters"].items()]  # fmt: skip
    return [
        f"{len(record['cells'])} cases (object / light). Correlation of the entropy with the "
        "path-traced reference, which assumes noise of 8 % of the mean radiance, as `fixed` does: "
        "mean over cases, and a 95 % bootstrap interval over objects. The row of the reference "
        "compares two halves of its samples. AUSE: area between the sparsification curves by "
        "entropy and by true error of the most probable cell, divided by the area for a random "
        "order (0 perfect, 1 random). Times are with compiled kernels, mean over cases.",
        tabulate(AGREEMENT, record["summary"]),
        "## Credible sets and the true parameters",
        "Share of highest-density sets that contain the cell of the truth. A set of whole cells "
        "has at least its level, so that a calibrated posterior exceeds it. With fractional sets, "
        "in which the last cell counts in part, it does not.",
        tabulate(_sets(judged), judged),
        "## Error of the most probable cell",
        tabulate(ERRORS, errors),
        "## Pearson correlation by case",
        "The last columns compare two halves of the reference's samples: the correlation of their "
        "entropies, and the common mass of their posteriors.",
        tabulate(_by_case(record), record["cells"]),
    ]


def agreement_lines(record: Record) -> list[str]:
    """Return one line of text per map: its correlation with the reference."""
    return [f"{row['label']}: Pearson {row['pearson']['mean']:.2f}"
            + " (assumes other noise than the reference)" * (row["label"] in OTHER_NOISE)
            for row in record["summary"] if row["pearson"] is not None]  # fmt: skip


def _sets(judged: list[Record]) -> list[Column]:
    def share(row: Record, mass: str, name: str) -> float:
        return row["credible"][mass][name]

    return [
        Column("posterior", lambda row: row["label"]),
        *(
            Column(f"{float(mass):.0%} {title}", partial(share, mass=mass, name=name),
                   lambda value: f"{value:.0%}")
            for mass in judged[0]["credible"] for name, title in SETS
        ),
    ]  # fmt: skip


def _by_case(record: Record) -> list[Column]:
    def pearson(case: Record, part: str, label: str) -> float:
        return case[part][label]["pearson"]

    labels = {kind: [row["label"] for row in record["summary"] if row["kind"] == kind]
              for kind in KINDS}  # fmt: skip
    return [
        Column("object / light", lambda case: f"{case['object']} / {case['light']}"),
        *(
            Column(label, partial(pearson, part=part, label=label), digits(2))
            for part, kind in (("rows", "estimator"), ("sanity", "sanity"))
            for label in labels[kind]
        ),
        Column("halves of the reference", lambda case: case["reference"]["split_half"], digits(3)),
        Column("common mass", lambda case: case["reference"]["half_overlap"], digits(3)),
    ]  # fmt: skip


AVERAGED = ("mean_entropy", "seconds", "ause", "ause_relative", "credible", "parameters")


def summarize(cases: Sequence[Record]) -> list[Record]:
    """Return a row for each estimator, each simple map, and the reference.

    Means are over cases, intervals over objects (``mean_over_objects``).

    Args:
        cases: Records of the cases.

    Returns:
        Rows with ``label``, ``kind`` (``estimator``, ``sanity`` or ``reference``),
        ``pearson`` and ``spearman`` as ``{mean, low, high, objects}`` and, except for simple
        maps, means of ``mean_entropy``, ``seconds``, ``ause``, ``ause_relative``, ``credible``
        and ``parameters``.
    """
    if not cases:
        return []
    objects = [case["object"] for case in cases]
    rows = []
    for label in cases[0]["rows"]:
        records = [case["rows"][label] for case in cases]
        figures = {**_agreement(records, objects), **_means(records)}
        rows.append({"label": label, "kind": "estimator", **figures})
    for label in cases[0]["sanity"]:
        records = [case["sanity"][label] for case in cases]
        rows.append({"label": label, "kind": "sanity", **_agreement(records, objects)})
    return [*rows, _of_reference([case["reference"] for case in cases], objects)]


def _of_reference(references: list[Record], objects: list[str]) -> Record:
    halves = [reference["split_half"] for reference in references]
    known = all(half is not None for half in halves)
    return {
        "label": "reference",
        "kind": "reference",
        "pearson": asdict(mean_over_objects(halves, objects)) if known else None,
        "spearman": None,
        **_means(references),
    }


def _agreement(records: list[Record], objects: list[str]) -> Record:
    return {
        name: asdict(mean_over_objects([record[name] for record in records], objects))
        for name in ("pearson", "spearman")
    }


def _means(records: list[Record]) -> Record:
    """Return the means over cases of all entries in ``AVERAGED``."""
    return {name: mean_of([record[name] for record in records]) for name in AVERAGED}


def mean_of(values: Sequence[Any]) -> Any:
    """Return the mean of numbers, or of each entry of records."""
    if isinstance(values[0], dict):
        return {name: mean_of([value[name] for value in values]) for name in values[0]}
    return float(np.mean(values))


MAX_CASES = 6  # rows of the scatter plot
OTHER_NOISE = ("angular default", "angular fast")  # estimate the noise that the reference assumes


def _styles(rows: list[Record]) -> dict[str, tuple[str, str]]:
    """Return colour and mark of the estimators, the same in every plot."""
    labels = [row["label"] for row in rows if row["kind"] == "estimator"]
    return {one: (COLORS[k % len(COLORS)], MARKS[k % len(MARKS)]) for k, one in enumerate(labels)}


def time_error(records: Record) -> Figure:
    """Plot the error (1 - Pearson correlation) over the run time for all texels."""
    record = records["accuracy"]
    rows, figure = record["summary"], page(9, 5.4)
    axes = figure.add_subplot()
    styles = _styles(rows)
    estimators = [row for row in rows if row["kind"] == "estimator"]
    for row in estimators:
        error, (color, mark) = 1 - row["pearson"]["mean"], styles[row["label"]]
        low, high = row["pearson"]["low"], row["pearson"]["high"]
        spread = None if low is None else [[max(0, high - 1 + error)], [1 - low - error]]
        axes.errorbar(row["seconds"], error, spread, fmt=mark, color=color, markersize=9,
                      capsize=3, elinewidth=1, zorder=3, label=row["label"]
                      + " (other noise)" * (row["label"] in OTHER_NOISE))  # fmt: skip
    times = _reference_points(axes, records) + [row["seconds"] for row in estimators]
    time_axis(axes, times)
    for row in rows:
        if row["kind"] == "sanity":
            error = 1 - row["pearson"]["mean"]
            axes.axhline(error, color=FAINT, linestyle="--", linewidth=1)
            axes.annotate(f"{row['label']} alone", (0.01, error), color=FAINT, fontsize=8,
                          xycoords=("axes fraction", "data"), va="bottom")  # fmt: skip
    axes.set_ylim(bottom=0)
    axes.set_xlabel("run time for all texels (compiled kernels)")
    axes.set_ylabel("error: 1 - Pearson correlation with the reference")
    count = len(record["cells"])
    of = f"Mean over {count} cases" if count > 1 else "One case"
    if any(row["pearson"]["low"] is not None for row in estimators):
        of += "; bars: 95 % over objects"
    axes.set_title(of, fontsize=10, color=INK)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    tidy(axes)
    return figure


def _reference_points(axes: Axes, records: Record) -> list[float]:
    """Plot the reference by number of samples, and brute force; return their times in seconds.

    Times are extrapolated from the texels of the reference to all texels.
    """
    cases, times = records["accuracy"]["cells"], []
    texels = float(np.mean([case["texels"] / case["reference"]["texels"] for case in cases]))
    halves = [case["reference"]["split_half"] for case in cases]
    if all(half is not None for half in halves):
        times.append(float(np.mean([case["reference"]["seconds"] for case in cases])) * texels)
        axes.plot(times, 1 - np.mean(halves), "*", color=INK, markersize=13,
                  label="reference, half of its samples")  # fmt: skip
    if "speed" in records:
        parts = records["speed"]["cells"][0]["rows"]
        curve = parts["reference_spp"]["reference"]
        points = [row for row in curve if row["pearson"] is not None]
        axes.plot([row["seconds"] * texels for row in points],
                  [1 - row["pearson"] for row in points], "-o", color=INK, markersize=4,
                  linewidth=1, label="reference with fewer samples (one case)")  # fmt: skip
        brute = parts["brute"]["seconds"]
        times += [row["seconds"] * texels for row in points] + [brute]
        axes.axvline(brute, color=INK, linestyle=":", linewidth=1.2)
        axes.annotate(f"all psi path traced: {seconds(brute)} (extrapolated)", (brute, 0.5),
                      xycoords=("data", "axes fraction"), fontsize=8, rotation=90, ha="right",
                      va="center", color=INK)  # fmt: skip
    return times


def scatter(records: Record) -> Figure:
    """Plot the entropy of each estimator over the entropy of the reference, by case."""
    record = records["accuracy"]
    styles, cases = _styles(record["summary"]), record["cells"][:MAX_CASES]
    figure = page(2.6 * max(len(styles), 1) + 0.6, 2.4 * len(cases) + 0.9)
    grid = figure.subplots(len(cases), max(len(styles), 1), squeeze=False, sharex=True,
                           sharey=True)  # fmt: skip
    for line, case in zip(grid, cases, strict=True):
        for axes, (label, (color, _)) in zip(line, styles.items(), strict=False):
            row = case["rows"][label]
            box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
            axes.plot([0, 1], [0, 1], color=FAINT, linewidth=0.8)
            axes.plot(case["reference"]["entropy"], row["entropy"], ".", color=color,
                      markersize=2.5, alpha=0.5)  # fmt: skip
            axes.text(0.04, 0.94, f"{row['pearson']:.2f}", transform=axes.transAxes, va="top",
                      bbox=box)  # fmt: skip
            if case is cases[0]:
                axes.set_title(label, fontsize=9, color=INK)
            axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
            tidy(axes)
        line[0].set_ylabel(f"{case['object']}\n{case['light']}", fontsize=9)
    figure.supxlabel("entropy of the reference", fontsize=9)
    return figure


def curves(records: Record) -> Figure:
    """Plot sparsification curves by parameter, mean over cases."""
    record = records["accuracy"]
    styles = _styles(record["summary"])
    names = list(dict.fromkeys(
        name for label in styles for name in record["cells"][0]["rows"][label]["parameters"]
    ))  # fmt: skip
    figure = page(3.9 * max(len(names), 1), 3.8)
    grid = figure.subplots(1, max(len(names), 1), squeeze=False)[0]
    for axes, name in zip(grid, names, strict=False):
        axes.axhline(1, color=FAINT, linewidth=0.8, linestyle="--")
        for label, (color, _) in styles.items():
            drawn = [case["rows"][label]["sparsification"].get(name)
                     for case in record["cells"]]  # fmt: skip
            if not all(drawn):
                continue
            removed = np.mean([curve["removed"] for curve in drawn], axis=0)
            for key, line in (("by_uncertainty", "-"), ("oracle", ":")):
                mean = np.mean([curve[key] for curve in drawn], axis=0)
                axes.plot(removed, mean, line, color=color, linewidth=1.4,
                          label=label if line == "-" else None)  # fmt: skip
        axes.set(title=name, xlabel="removed texels, most uncertain first", xlim=(0, 1))
        axes.set_ylim(bottom=0)
        tidy(axes)
    grid[0].set_ylabel("remaining error / total error")
    if grid[0].get_legend_handles_labels()[1]:
        grid[0].legend(frameon=False, fontsize=7, loc="lower left", title="(dotted: oracle)",
                       title_fontsize=7)  # fmt: skip
    return figure
