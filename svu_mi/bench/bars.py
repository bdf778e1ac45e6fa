"""Figures that a release has to reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from svu_mi.bench.text import table


@dataclass(frozen=True)
class Bar:
    """One measured figure and its limit.

    Attributes:
        what: was measured.
        value: found.
        limit: the bar.
        unit: of both.
        least: whether the value has to reach the limit, rather than stay below it.
    """

    what: str
    value: float
    limit: float
    unit: str
    least: bool = False

    @property
    def holds(self) -> bool:
        """Whether the bar is met; NaN meets none."""
        return self.value >= self.limit if self.least else self.value <= self.limit

    def record(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {"what": self.what, "value": self.value, "limit": self.limit, "unit": self.unit,
                "least": self.least, "holds": self.holds}  # fmt: skip


def bar_table(bars: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of what ``Bar.record`` returned."""
    rows = [
        [
            bar["what"], f"{bar['value']:.3g} {bar['unit']}".strip(),
            f"{'>=' if bar['least'] else '<='} {bar['limit']:g} {bar['unit']}".strip(),
            "yes" if bar["holds"] else "**no**",
        ]
        for bar in bars
    ]  # fmt: skip
    return table(("what", "measured", "bar", "holds"), rows)
