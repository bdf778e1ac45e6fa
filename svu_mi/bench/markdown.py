"""Numbers, Markdown tables, bars, and how plots look."""

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
    """Return a rounded number, nothing for None."""
    return "" if value is None else f"{value:.{digits}f}"


def seconds(value: float | None) -> str:
    """Return a time in the unit that suits it, with two or three digits; nothing for None."""
    if value is None:
        return ""
    for unit, name in UNITS:
        if value >= 2 * unit:
            return f"{value / unit:.3g} {name}"
    return f"{value:.2g} s" if value < 10 else f"{value:.3g} s"


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_cell(case) for case in line) + " |" for line in lines)


def _cell(value: object) -> str:
    return " ".join(str(value).replace("|", "\\|").split())


@dataclass(frozen=True)
class Column:
    """A column of a table: its head, its value in a record, and the format.

    Attributes:
        head: of the column.
        value: of a record; None leaves the case empty.
        show: makes text of a value.
    """

    head: str
    value: Callable[[Any], Any]
    show: Callable[[Any], str] = str

    def text(self, record: Any) -> str:
        """Return the case of a record."""
        value = self.value(record)
        return "" if value is None else self.show(value)


def tabulate(wanted: Sequence[Column], records: Iterable[Any]) -> str:
    """Return a Markdown table with a line per record."""
    rows = [[column.text(record) for column in wanted] for record in records]
    return table([column.head for column in wanted], rows)


def digits(count: int) -> Callable[[float], str]:
    """Return a function that formats numbers with ``count`` decimals."""
    return lambda value: f"{value:.{count}f}"


def left_out(title: str, record: dict[str, Any]) -> list[str]:
    """Return a Markdown table of failures; empty without any."""
    rows = [[failed["cell"], failed["reason"]] for failed in record["failed"]]
    return [f"## {title}", table(("cell", "reason"), rows)] if rows else []


@dataclass(frozen=True)
class Bar:
    """A figure that a release has to reach.

    Attributes:
        what: was measured.
        value: measured.
        limit: the bar.
        unit: of both.
        least: whether the value has to reach the limit, rather than stay below it.
    """

    what: str
    value: float
    limit: float
    unit: str = ""
    least: bool = False

    @property
    def holds(self) -> bool:
        """True if the bar is met; NaN meets none."""
        return self.value >= self.limit if self.least else self.value <= self.limit

    def record(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {"what": self.what, "value": self.value, "limit": self.limit, "unit": self.unit,
                "least": self.least, "holds": self.holds}  # fmt: skip


BAR_COLUMNS = (
    Column("what", lambda bar: bar["what"]),
    Column("measured", lambda bar: f"{bar['value']:.3g} {bar['unit']}".strip()),
    Column("bar", lambda bar: f"{'>=' if bar['least'] else '<='} {bar['limit']:g} {bar['unit']}"
           .strip()),
    Column("holds", lambda bar: "yes" if bar["holds"] else "**no**"),
)  # fmt: skip


def bar_table(bars: Sequence[dict[str, Any]], quick: bool = False, note: str = "") -> list[str]:
    """Return a Markdown table of bars; empty without any.

    Args:
        bars: the records.
        quick: whether sizes were small.
        note: of how it was measured.
    """
    if quick:
        note += " Quick sizes, which the bars are not meant for."
    parts = ["## Bars", note.strip(), tabulate(BAR_COLUMNS, bars)]
    return [part for part in parts if part] if bars else []


DPI = 120
INK, FAINT = "#26262b", "#8a8a93"
COLORS = ("#2f6fb5", "#d1702a", "#3f9a5a", "#9a4fb0", "#b3404a", "#7a6a2f", "#30343a", "#2a9d9b")
MARKS = "osD^vPX*"
TICKS = ((1e-3, "1 ms"), (1e-2, "10 ms"), (0.1, "0.1 s"), (1, "1 s"), (10, "10 s"), (60, "1 min"),
         (600, "10 min"), (3600, "1 h"), (36000, "10 h"), (864000, "10 d"))  # fmt: skip


def save(figure: Figure, folder: Path, name: str) -> Path:
    """Write a figure into a folder, and return the PNG file.

    Raises:
        OutputError: the file cannot be written.
    """
    path = folder / f"{name}.png"
    save_figure(figure, path)
    return path


def page(width: float, height: float) -> Figure:
    """Return an empty figure; sizes in inches."""
    return new_figure(width, height, DPI, layout="constrained")


def tidy(axes: Axes) -> None:
    """Give axes the look of all plots: a grid, and no frame above and to the right."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e6e6ea", linewidth=0.8)
    axes.set_axisbelow(True)


def time_axis(axes: Axes, times: list[float]) -> None:
    """Show run times on a log axis with units."""
    low, high = min(times) / 3, max(times) * 3
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    ticks = [(value, name) for value, name in TICKS if low < value < high]
    axes.set_xticks([value for value, _ in ticks], [name for _, name in ticks])
    axes.minorticks_off()
