"""Figures of many cells as one row per estimator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from svu_mi.metrics import mean_over_objects

Record = dict[str, Any]


def summarize(cells: Sequence[Record]) -> list[Record]:
    """Return one row per map: estimators, the simple maps, and the reference itself.

    Means are over cells, their intervals over objects (``metrics.mean_over_objects``).

    Args:
        cells: records of ``accuracy.run_cell``.

    Returns:
        Rows with ``label``, ``kind`` (``main``, ``switch``, ``sanity`` or ``reference``),
        ``pearson`` and ``spearman`` as ``{mean, low, high, objects}`` and, except for the
        simple maps, means of ``mean_entropy``, ``seconds``, ``ause``, ``ause_relative``,
        ``credible`` and ``parameters``.
    """
    if not cells:
        return []
    objects = [cell["object"] for cell in cells]
    rows = [
        {
            "label": label,
            "kind": "main" if first["main"] else "switch",
            **_agreement([cell["variants"][label] for cell in cells], objects),
            **_means([cell["variants"][label] for cell in cells]),
        }
        for label, first in cells[0]["variants"].items()
    ]
    rows += [
        {
            "label": label, "kind": "sanity",
            **_agreement([cell["sanity"][label] for cell in cells], objects),
        }
        for label in cells[0]["sanity"]
    ]  # fmt: skip
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

    def mean(value: Callable[[Record], float]) -> float:
        return float(np.mean([value(record) for record in records]))

    first = records[0]
    return {
        **{
            name: mean(lambda r, name=name: r[name])  # type: ignore[misc]
            for name in ("mean_entropy", "seconds", "ause", "ause_relative")
        },
        "credible": {
            level: {
                name: mean(lambda r, level=level, name=name: r["credible"][level][name])  # type: ignore[misc]
                for name in ("plain", "fractional", "size")
            }
            for level in first["credible"]
        },
        "parameters": {
            parameter: {
                name: mean(lambda r, p=parameter, name=name: r["parameters"][p][name])  # type: ignore[misc]
                for name in figures
            }
            for parameter, figures in first["parameters"].items()
        },
    }
