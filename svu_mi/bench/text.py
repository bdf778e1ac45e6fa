"""Numbers and tables as text."""

from __future__ import annotations

from collections.abc import Sequence

UNITS = ((86400, "d"), (3600, "h"), (60, "min"))


def number(value: float | None, digits: int = 2) -> str:
    """Return a rounded number, nothing for None."""
    return "" if value is None else f"{value:.{digits}f}"


def seconds(value: float) -> str:
    """Return a time in the unit that suits it, with two or three digits."""
    for unit, name in UNITS:
        if value >= 2 * unit:
            return f"{value / unit:.3g} {name}"
    return f"{value:.2g} s" if value < 10 else f"{value:.3g} s"


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(value: object) -> str:
    return " ".join(str(value).replace("|", "\\|").split())
