"""Numerical stability: the kernels against double precision, at the ends of every axis.

An axis is a quantity driven to both of its ends (radiance, number of views, size of the
mesh, ...). Each of its cases compares what single precision kernels return with the equations
in double precision (``oracle``), or with what must not change. A bound follows from the
arithmetic; an error above it is a defect, and so is a NaN, or an entropy outside [0, 1].
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from extremes import angular, fits, meshes, scenes, spectra
from extremes.cases import Axis, Found
from svu_mi.bench.markdown import table
from svu_mi.errors import SvuWarning
from svu_mi.files import prepare_folder
from svu_mi.progress import Progress

AXES: tuple[Axis, ...] = (
    *fits.AXES, *spectra.AXES, *angular.AXES, *scenes.AXES, *meshes.AXES,
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """What an axis found.

    Attributes:
        axis: its name.
        range: its ends.
        compared: what with what.
        cases: how many.
        error: the largest.
        bound: of that one.
        ratio: the largest of errors over their bounds; at most 1, or the axis is not stable.
        nan: number of NaN.
        low: smallest entropy, None without any.
        high: largest entropy.
        failed: cases with a NaN, an entropy outside [0, 1] or an error above its bound, and
            what they raised.
    """

    axis: str
    range: str
    compared: str
    cases: int
    error: float
    bound: float
    ratio: float
    nan: int
    low: float | None
    high: float | None
    failed: tuple[str, ...]


def measure(axis: Axis, folder: Path, quick: bool) -> Row:
    """Run the cases of an axis; one that raises counts as an infinite error."""
    error, bound, ratio, nan, count = 0.0, 0.0, 0.0, 0, 0
    low, high = math.inf, -math.inf
    failed = []
    for name, run in axis.cases(folder, quick):
        count += 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", SvuWarning)
                found = run()
        except Exception as problem:  # whatever it is, the other cases still count
            name = f"{name}: {type(problem).__name__}: {problem}"
            found = Found(np.full(1, np.inf), 0.0, np.zeros(0))
        here, its_bound, its_ratio = _worst(found)
        if here >= error:
            error, bound = here, its_bound
        ratio = max(ratio, its_ratio)
        lost = int(np.isnan(found.errors).sum() + np.isnan(found.entropy).sum())
        nan += lost
        least, most = _range(found.entropy)
        low, high = min(low, least), max(high, most)
        if lost or its_ratio > 1 or least < 0 or most > 1:
            failed.append(name)
    some = low <= high
    return Row(
        axis.name, axis.range, axis.compared, count, error, bound, ratio, nan,
        low if some else None, high if some else None, tuple(failed),
    )  # fmt: skip


def _worst(found: Found) -> tuple[float, float, float]:
    """Largest error and its bound, and the largest ratio of the two."""
    if not found.errors.size:
        return 0.0, 0.0, 0.0
    errors = np.where(np.isnan(found.errors), np.inf, found.errors)
    bounds = np.broadcast_to(np.asarray(found.bounds, np.float64), errors.shape)
    ratio = np.where(errors > 0, errors / np.maximum(bounds, 1e-300), 0.0)
    k = int(errors.argmax())
    return float(errors[k]), float(bounds[k]), float(ratio.max())


def _range(entropy: np.ndarray) -> tuple[float, float]:
    """Smallest and largest entropy that is a number; infinity and its negative without any."""
    numbers = entropy[~np.isnan(entropy)]
    return (float(numbers.min()), float(numbers.max())) if numbers.size else (math.inf, -math.inf)


def run_stability(folder: Path, progress: Progress, quick: bool = False) -> dict[str, Any]:
    """Drive every axis to its ends.

    Args:
        folder: for meshes of the captures; made if missing.
        progress: shows what is going on.
        quick: fewer cases of each, in a minute.

    Returns:
        ``rows``: a dictionary of each ``Row``; ``stable``: whether no case failed.

    Raises:
        OutputError: the folder cannot be written.
    """
    prepare_folder(folder)
    rows = []
    for axis in AXES:
        with progress.stage(f"Stability: {axis.name}"):
            rows.append(measure(axis, folder, quick))
    return {
        "quick": quick,
        "stable": not any(row.failed for row in rows),
        "rows": [asdict(row) for row in rows],
    }


HEADS = ("axis", "range", "compared", "cases", "worst error", "its bound",
         "largest part of a bound", "NaN", "H from", "to")  # fmt: skip


def stability_table(record: dict[str, Any]) -> str:
    """Return a Markdown table of what ``run_stability`` found, and what is not stable."""
    rows: Sequence[dict[str, Any]] = record["rows"]
    lines = [
        [
            row["axis"], row["range"], row["compared"], row["cases"], _figure(row["error"]),
            _figure(row["bound"]), _figure(row["ratio"]), row["nan"],
            _figure(row["low"]), _figure(row["high"]),
        ]
        for row in rows
    ]  # fmt: skip
    bad = [f"* {row['axis']}: {case}" for row in rows for case in row["failed"]]
    text = table(HEADS, lines)
    return text if not bad else "\n".join([text, "", "Not stable:", "", *bad])


def _figure(value: float | None) -> str:
    """Two digits, small and large numbers as powers of ten."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.2g}"
