"""Figures of many cells as one row per estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.metrics import mean_over_objects

AVERAGED = ("mean_entropy", "seconds", "ause", "ause_relative", "credible", "parameters")


def summarize(cells: Sequence[Record]) -> list[Record]:
    """Return one row per map: estimators, the simple maps, and the reference itself.

    Means are over cells, their intervals over objects (``metrics.mean_over_objects``).

    Args:
        cells: what ``Compared`` has found.

    Returns:
        Rows with ``label``, ``kind`` (``estimator``, ``sanity`` or ``reference``),
        ``pearson`` and ``spearman`` as ``{mean, low, high, objects}`` and, except for the
        simple maps, means of ``mean_entropy``, ``seconds``, ``ause``, ``ause_relative``,
        ``credible`` and ``parameters``.
    """
    if not cells:
        return []
    objects = [cell["object"] for cell in cells]
    rows = []
    for label in cells[0]["rows"]:
        found = [cell["rows"][label] for cell in cells]
        figures = {**_agreement(found, objects), **_means(found)}
        rows.append({"label": label, "kind": "estimator", **figures})
    for label in cells[0]["sanity"]:
        found = [cell["sanity"][label] for cell in cells]
        rows.append({"label": label, "kind": "sanity", **_agreement(found, objects)})
    return [*rows, _of_reference([cell["reference"] for cell in cells], objects)]


def _of_reference(references: list[Record], objects: list[str]) -> Record:
    halves = [found["split_half"] for found in references]
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
    """Return means over cells of everything that a posterior is judged by."""
    return {name: mean_of([record[name] for record in records]) for name in AVERAGED}


def mean_of(values: Sequence[Any]) -> Any:
    """Return the mean of numbers; of records, the means of what they hold, by name."""
    if isinstance(values[0], dict):
        return {name: mean_of([value[name] for value in values]) for name in values[0]}
    return float(np.mean(values))
