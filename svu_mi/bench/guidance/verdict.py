"""How many views a strategy needs, and whether the difference to another is luck."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from svu_mi.bench.guidance.sizes import Sizes
from svu_mi.bench.kernels.bars import Bar

Record = dict[str, Any]
FEWER = 1.4  # times as many views as the judged strategy that farthest-point sampling may need
LUCK = 0.01
SECONDS, TIMES, LINEAR = 1.0, 200.0, 1.25  # per added view, over refitting, of the exponent


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


def mean_gain(marks: tuple[int, ...], values: list[float]) -> float:
    """Return the mean over added views of what a curve is above its start, by trapezoids."""
    places = np.array([0, *marks], float)
    return float(np.trapezoid(np.asarray(values) - values[0], places) / places[-1])


def mean_curve(runs: list[Record], strategy: str, name: str = "psnr") -> list[float]:
    """Return the mean over runs of a strategy's curve above the start."""
    curves = [np.asarray(run["curves"][strategy][name]) for run in runs]
    return np.mean([curve - curve[0] for curve in curves], axis=0).tolist()


def compare(runs: list[Record], sizes: Sizes, name: str = "psnr") -> list[Record]:
    """Compare the first strategy with every other, pairwise over cells.

    Starts of one cell are no independent samples: they are averaged first.

    Returns:
        Per other strategy ``strategy``, ``difference`` of mean gains, ``p`` of a paired t-test,
        ``cells``, and in how many of them the first is better.
    """
    first, *others = sizes.strategies
    sign = -1.0 if name == "entropy" else 1.0
    found = []
    for other in others:
        by_cell: dict[str, list[float]] = {}
        for run in runs:
            gains = [mean_gain(sizes.marks, run["curves"][s][name]) for s in (first, other)]
            by_cell.setdefault(run["cell"], []).append(sign * (gains[0] - gains[1]))
        differences = [float(np.mean(values)) for values in by_cell.values()]
        enough = len(differences) > 1
        found.append({
            "strategy": other, "difference": float(np.mean(differences)),
            "p": float(stats.ttest_1samp(differences, 0).pvalue) if enough else float("nan"),
            "cells": len(differences), "better": sum(d > 0 for d in differences),
        })  # fmt: skip
    return found


def find_bars(record: Record, sizes: Sizes) -> list[Record]:
    """Return the bars that a record has figures for."""
    bars = [*_curves(record["runs"], sizes), *_speed(record["speed"])]
    return [bar.record() for bar in bars]


def _curves(runs: list[Record], sizes: Sizes) -> list[Bar]:
    if not runs:
        return []
    needed = {
        s: views_needed(sizes.marks, mean_curve(runs, s), sizes.step) for s in sizes.strategies
    }
    first = sizes.strategies[0]
    bars = []
    if "farthest" in needed:
        what = f"views that farthest needs for +{sizes.step:g} dB, mean curve, over {first}'s"
        bars.append(Bar(what, needed["farthest"] / needed[first], FEWER, "times", least=True))
    for found in compare(runs, sizes):
        if found["strategy"] in ("coverage", "random"):
            what = f"{first} over {found['strategy']}: mean gain of texture PSNR"
            bars.append(Bar(what, found["difference"], 0.0, "dB", least=True))
            bars.append(Bar(f"{what}: p of a paired t-test over cells", found["p"], LUCK, ""))
    return bars


def _speed(speed: Record | None) -> list[Bar]:
    if not speed:
        return []
    bars = []
    for row in speed["methods"]:
        bars.append(Bar(f"{row['label']}: time per added view", row["per_view"], SECONDS, "s"))
        for axis in ("candidates", "texels"):
            bars.append(
                Bar(f"{row['label']}: time grows with {axis} to the power of",
                    row["exponents"][axis], LINEAR, "")
            )  # fmt: skip
    times = speed["refitting"]["times"]
    bars.append(Bar("refitting every candidate, over one step", times, TIMES, "times", least=True))
    return bars
