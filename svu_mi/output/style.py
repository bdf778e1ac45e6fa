"""The look of all pages: colours, margins, titles and colour bars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from svu_mi.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 100
LEFT, RIGHT = 0.018, 0.985  # margins of a page
COLORMAP, VIEWS_COLORMAP, GREY = "viridis", "magma", "gray"
UNSEEN = (0.55, 0.55, 0.58)  # grey: in no colormap but GREY, and darker than the page
OUTSIDE = (0.95, 0.95, 0.96)
INK, FAINT, RULE = "#26262b", "#6f6f78", "#c4c4cb"
ENTROPY_ENDS = "0 = one material left, 1 = nothing known"
THIN_SPACE = "\u2009"
BELOW = (0.0, -0.075, 1.0, 0.035)  # place of a colour bar, in parts of its axes


def new_figure(width: float, height: float, dpi: float = DPI, **options: Any) -> Figure:
    """Return an empty figure of so many inches; ``options`` are matplotlib's."""
    # matplotlib takes half a second to import; and pyplot, with its global state, is not used.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white", **options)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def heading(figure: Figure, text: str, notes: Sequence[str], places: tuple[float, float]) -> None:
    """Write a page's title, and notes in a line below; places are heights on the page."""
    same: Any = {"va": "center", "parse_math": False}  # a $ in a name is a $
    figure.text(LEFT, places[0], text, size=19, weight="bold", color=INK, **same)
    figure.text(LEFT, places[1], "   ·   ".join(notes), size=11.5, color=FAINT, **same)


def spaced(number: int) -> str:
    """Write a whole number with a thin space between thousands."""
    return f"{number:_}".replace("_", THIN_SPACE)


def title(axes: Axes, text: str, pad: float = 6) -> None:
    """Write a title over the left end of axes."""
    axes.set_title(text, loc="left", size=11.5, color=INK, pad=pad, parse_math=False)


def subtitle(axes: Axes, text: str) -> None:
    """Write a line between axes and their title, which needs a ``pad`` of 21."""
    axes.annotate(
        text, (0, 1), xycoords="axes fraction", xytext=(0, 7), textcoords="offset points",
        size=9, color=FAINT, ha="left", va="bottom", annotation_clip=False,
    )  # fmt: skip


def plain(axes: Axes) -> None:
    """Draw axes below and on the left, faintly, and none elsewhere."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(RULE)
    axes.tick_params(labelsize=9, color=RULE, labelcolor=INK, length=3)


def framed(axes: Axes) -> None:
    """Draw a faint frame around a map, without ticks."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color(RULE)


def color_bar(
    figure: Figure, axes: Axes, drawn: Any, label: str = "",
    place: tuple[float, float, float, float] = BELOW, size: float = 9,
) -> Any:  # fmt: skip
    """Draw the scale of what was drawn, below its axes or at a place of them, and return it."""
    orientation = "horizontal" if place[2] > place[3] else "vertical"
    bar: Any = figure.colorbar(drawn, cax=axes.inset_axes(place), orientation=orientation)
    bar.outline.set_visible(False)
    bar.set_label(label, size=size, color=FAINT)
    bar.ax.tick_params(labelsize=size, color=FAINT, labelcolor=INK, length=3)
    return bar
