"""How often mistakes were found, as Markdown tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from svu_mi.bench.conventions.cases import OUTCOMES
from svu_mi.bench.text import table

Row = dict[str, Any]
NOTHING = "nothing wrong"


def conventions_tables(rows: Sequence[Row]) -> str:
    """Return Markdown tables: kinds of mistakes, and objects, x ways that photographs come.

    Args:
        rows: records of ``run_conventions``.
    """
    told = [row for row in rows if row["visible"] or row["group"] == NOTHING]
    wrong = [row for row in rows if row["group"] != NOTHING]
    return (
        f"Captures that were imported wrongly, and checked, in percent: {' / '.join(OUTCOMES)}.\n\n"
        + _counts(told, "group")
        + "\n\nMistakes by object and light.\n\n"
        + _counts([row for row in wrong if row["visible"]], "cell")
        + "\n\nMistakes that change no picture of the object; silence is right.\n\n"
        + _counts([row for row in wrong if not row["visible"]], "cell")
    )


def _counts(rows: Sequence[Row], heading: str) -> str:
    """Return a table of outcomes with a line per value of a field."""
    columns = list(dict.fromkeys(row["photographs"] for row in rows))
    lines = []
    for value in dict.fromkeys(row[heading] for row in rows):
        of = [row for row in rows if row[heading] == value]
        shares = (_share([row for row in of if row["photographs"] == one]) for one in columns)
        lines.append([value, *shares, len(of)])
    return table([heading, *columns, "checks"], lines)


def _share(rows: Sequence[Row]) -> str:
    counted = Counter(row["outcome"] for row in rows)
    return " / ".join(f"{100 * counted[one] / len(rows):.0f}" for one in OUTCOMES) if rows else ""
