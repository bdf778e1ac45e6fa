"""What the accuracy benchmark found, as Markdown tables."""

from __future__ import annotations

from functools import partial

from svu_mi.bench.experiment import Record
from svu_mi.bench.text import Column, columns, digits, seconds

KINDS = ("estimator", "sanity", "reference")


def _mean(found: Record) -> str:
    return f"{found['mean']:.2f}"


def _interval(found: Record) -> str:
    if found["low"] is None:
        return _mean(found)
    return f"{found['mean']:.2f} ({found['low']:.2f} to {found['high']:.2f})"


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
SETS = (("plain", "whole cells"), ("fractional", "fractional"), ("size", "part of the grid"))


def accuracy_tables(record: Record) -> list[str]:
    """Return the tables of a record.

    Args:
        record: of ``svu bench accuracy``.
    """
    if not record["cells"]:
        return []
    judged = [row for row in record["summary"] if row["kind"] != "sanity"]
    errors = [(row["label"], name, figures)
              for row in judged for name, figures in row["parameters"].items()]  # fmt: skip
    return [
        f"{len(record['cells'])} cells (object / light). Correlation of the entropy with that of "
        "the reference, which assumes a noise of 8 % of "
        "the mean radiance, as `fixed` does: mean over cells, and a 95 % bootstrap interval over "
        "objects. That of the reference is between two halves of its "
        "samples. AUSE: area between the sparsification curves by entropy and by true error of "
        "the most probable cell, over that of a random order: 0 perfect, 1 chance. Seconds are "
        "warm, mean over cells.",
        columns(AGREEMENT, record["summary"]),
        "## Credible sets against the true parameters",
        "How often the highest-density set holds the truth's cell. A set of whole cells holds at "
        "least its level, so even a calibrated posterior exceeds it; with the last cells taken "
        "in with the fitting probability it does not.",
        columns(_sets(judged), judged),
        "## Error of the most probable cell",
        columns(ERRORS, errors),
        "## Pearson correlation by cell",
        "The halves are those of the reference's samples: the correlation of their entropies, "
        "and the part of their posteriors that they have in common.",
        columns(_by_cell(record), record["cells"]),
    ]


def _sets(judged: list[Record]) -> list[Column]:
    def share(row: Record, level: str, name: str) -> float:
        return row["credible"][level][name]

    return [
        Column("posterior", lambda row: row["label"]),
        *(
            Column(f"{float(level):.0%} {title}", partial(share, level=level, name=name),
                   lambda value: f"{value:.0%}")
            for level in judged[0]["credible"] for name, title in SETS
        ),
    ]  # fmt: skip


def _by_cell(record: Record) -> list[Column]:
    def pearson(cell: Record, part: str, label: str) -> float:
        return cell[part][label]["pearson"]

    labels = {kind: [row["label"] for row in record["summary"] if row["kind"] == kind]
              for kind in KINDS}  # fmt: skip
    return [
        Column("object / light", lambda cell: f"{cell['object']} / {cell['light']}"),
        *(
            Column(label, partial(pearson, part=part, label=label), digits(2))
            for part, kind in (("rows", "estimator"), ("sanity", "sanity"))
            for label in labels[kind]
        ),
        Column("reference's halves", lambda cell: cell["reference"]["split_half"], digits(3)),
        Column("their shared mass", lambda cell: cell["reference"]["half_overlap"], digits(3)),
    ]  # fmt: skip
