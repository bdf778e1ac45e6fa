"""Formats of numbers, Markdown tables, bars, and the style of plots."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from svu_mi.output.style import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


UNITS = ((86400, "d"), (3600, "h"), (60, "min"))


def number(value: float | None, digits: int = 2) -> str:
    """Return a rounded number; an empty string for None."""
    return "" if value is None else f"{value:.{digits}f}"


def seconds(value: float | None) -> str:
    """Return a time with two or three digits, in s, min, h or d; an empty string for None."""
    if value is None:
        return ""
    for unit, name in UNITS:
        if value >= 2 * unit:
            return f"{value / unit:.3g} {name}"
    return f"{value:.2g} s" if value < 10 else f"{value:.3g} s"


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_cell(value) for value in line) + " |" for line in lines)


def _cell(value: object) -> str:
    return " ".join(str(value).replace("|", "\\|").split())


@dataclass(frozen=True)
class Column:
    """A column of a table: head, value in a record, and format.

    Attributes:
        head: Head of the column.
        value: Returns the value of a record; None for an empty cell.
        show: Formats a value.
    """

    head: str
    value: Callable[[Any], Any]
    show: Callable[[Any], str] = str

    def text(self, record: Any) -> str:
        """Return the cell of a record."""
        value = self.value(record)
        return "" if value is None else self.show(value)


def tabulate(wanted: Sequence[Column], records: Iterable[Any]) -> str:
    """Return a Markdown table with one line per record."""
    rows = [[column.text(record) for column in wanted] for record in records]
    return table([column.head for column in wanted], rows)


def digits(count: int) -> Callable[[float], str]:
    """Return a function that formats numbers with ``count`` decimals."""
    return lambda value: f"{value:.{count}f}"


def failed_cases(title: str, record: dict[str, Any]) -> list[str]:
    """Return a Markdown table of failed cases; an empty list without failures."""
    rows = [[failed["cell"], failed["reason"]] for failed in record["failed"]]
    return [f"## {title}", table(("case", "reason"), rows)] if rows else []


@dataclass(frozen=True)
class Bar:
    """A limit that a measured value of a release has to meet.

    Attributes:
        what: Name of the value.
        value: Measured value.
        limit: Upper limit, or lower limit if ``least``.
        unit: Unit of value and limit.
        least: True for a lower limit.
    """

    what: str
    value: float
    limit: float
    unit: str = ""
    least: bool = False

    @property
    def holds(self) -> bool:
        """True if the value is within the limit; False for NaN."""
        return self.value >= self.limit if self.least else self.value <= self.limit

    def record(self) -> dict[str, Any]:
        """Return the bar as JSON values."""
        return {"what": self.what, "value": self.value, "limit": self.limit, "unit": self.unit,
                "least": self.least, "holds": self.holds}  # fmt: skip


BAR_COLUMNS = (
    Column("value", lambda bar: bar["what"]),
    Column("measured", lambda bar: f"{bar['value']:.3g} {bar['unit']}".strip()),
    Column("bar", lambda bar: f"{'>=' if bar['least'] else '<='} {bar['limit']:g} {bar['unit']}"
           .strip()),
    Column("met", lambda bar: "yes" if bar["holds"] else "**no**"),
)  # fmt: skip


def bar_table(bars: Sequence[dict[str, Any]], quick: bool = False, note: str = "") -> list[str]:
    """Return a Markdown table of bars; an empty list without bars.

    Args:
        bars: Results of ``Bar.record``.
        quick: True for small sizes.
        note: Description of how the bars are measured.
    """
    if quick:
        note += " Quick sizes, to which the bars do not apply."
    parts = ["## Bars", note.strip(), tabulate(BAR_COLUMNS, bars)]
    return [part for part in parts if part] if bars else []


DPI = 120
INK, FAINT = "#26262b", "#8a8a93"
COLORS = ("#2f6fb5", "#d1702a", "#3f9a5a", "#9a4fb0", "#b3404a", "#7a6a2f", "#30343a", "#2a9d9b")
MARKS = "osD^vPX*"
TICKS = ((1e-3, "1 ms"), (1e-2, "10 ms"), (0.1, "0.1 s"), (1, "1 s"), (10, "10 s"), (60, "1 min"),
         (600, "10 min"), (3600, "1 h"), (36000, "10 h"), (864000, "10 d"))  # fmt: skip


def save(figure: Figure, folder: Path, name: str) -> Path:
    """Write a figure into a folder; return the PNG file.

    Raises:
        OutputError: The file cannot be written.
    """
    path = folder / f"{name}.png"
    save_figure(figure, path)
    return path


def page(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches."""
    return new_figure(width, height, DPI, layout="constrained")


def tidy(axes: Axes) -> None:
    """Style axes: a grid, and no frame above and to the right."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e6e6ea", linewidth=0.8)
    axes.set_axisbelow(True)


def time_axis(axes: Axes, times: list[float]) -> None:
    """Make the horizontal axis logarithmic, with ticks of run times."""
    low, high = min(times) / 3, max(times) * 3
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    ticks = [(value, name) for value, name in TICKS if low < value < high]
    axes.set_xticks([value for value, _ in ticks], [name for _, name in ticks])
    axes.minorticks_off()
