"""Style and layout of PNG pages: colours, margins, headings, titles, axes, colour bars.

``write_page`` lays out blocks of panels under a heading. HTML pages use the same colours; their
layout is in ``templates/page.css``.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.core.io.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

Panel = tuple[str, Callable[[Any], Any]]  # title, function that draws into axes
DPI = 100
# Upper end of standard deviations; the uniform prior has 0.29, the prior of metallic 0.46.
WIDEST_SD = 0.3
LEFT, RIGHT = 0.018, 0.985  # margins of a page
COLORMAP, VIEWS_COLORMAP, GREY = "viridis", "magma", "gray"
VALUES_COLORMAP = "copper"  # for parameters; without grey (unseen) and yellow (uncertain)
DENSITY_COLORMAP = DIFFERENCE_COLORMAP = "magma"  # posteriors, differences of pictures
INFORMATION_GAIN_COLORS = ("#c6c6cc", "#f6c06b", "#e8743b", "#b3243f", "#5b0f3a")  # grey: no gain
SETTLED_COLORS = ("#414487", "#22a884", "#e3d523")  # determined, roughly determined, uncertain
MARK = (0.91, 0.27, 0.235)  # true values and selections
BEFORE, AFTER = (1.0, 0.25, 0.2), (0.1, 0.85, 0.35)  # outlines of a mesh, as captured, corrected
UNSEEN = (0.55, 0.55, 0.58)  # grey: in no colormap but GREY, and darker than the page
OUTSIDE = (0.95, 0.95, 0.96)  # without surface
INK, FAINT, RULE = "#26262b", "#6f6f78", "#c4c4cb"
ENTROPY_ENDS = "0 = certain, 1 = no information"
LONGEST = 18  # characters of the name of a photograph
TEXT = 9  # points: tick labels and legends
PNG_LEVEL = 3  # half the time of Pillow's default 6, for 10 % more bytes
BELOW = (0.0, -0.075, 1.0, 0.035)  # place of a colour bar, relative to its axes


def new_figure(width: float, height: float, dpi: float = DPI, **options: Any) -> "Figure":
    """Return an empty figure of ``width`` x ``height`` inches; ``options`` are matplotlib's."""
    # Imported here: matplotlib takes half a second. pyplot and its global state are not used.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white", **options)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: "Figure", path: str | Path) -> None:
    """Write a figure as PNG, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):  # names from elsewhere may contain a $
        text.set_parse_math(False)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", pil_kwargs={"compress_level": PNG_LEVEL})


def heading(figure: "Figure", text: str, notes: Sequence[str] = ()) -> None:
    """Write the title of a page, and notes in a line below."""
    height = figure.get_size_inches()[1]
    same: Any = {"va": "center"}
    figure.text(LEFT, 1 - 0.36 / height, text, size=19, weight="bold", color=INK, **same)
    line = "   ·   ".join(notes)
    figure.text(LEFT, 1 - 0.73 / height, line, size=11.5, color=FAINT, **same)


@dataclass(frozen=True, kw_only=True)
class Block:
    """Panels in the cells of a grid, row by row.

    Attributes:
        panels: Titles, and functions that draw into axes; None leaves a cell empty.
        shape: Number of rows and columns.
        box: Left, right, bottom and top, as fractions of the page.
        space: Gaps between columns and between rows, as fractions of a cell.
        anchor: Side of the cell at which smaller pictures are placed.
    """

    panels: Iterable[Panel | None]
    shape: tuple[int, int] = (1, 1)
    box: tuple[float, float, float, float]
    space: tuple[float, float] = (0.1, 0.1)
    anchor: str = "C"


def write_page(
    path: str | Path, size: tuple[float, float], text: str, notes: Sequence[str],
    blocks: Iterable[Block],
) -> None:  # fmt: skip
    """Write a page as PNG: a heading, notes, and blocks of panels; ``size`` is in inches.

    Raises:
        OutputError: the file cannot be written.
    """
    figure = new_figure(*size)
    heading(figure, text, notes)
    for block in blocks:
        left, right, bottom, top = block.box
        grid = figure.add_gridspec(
            *block.shape, left=left, right=right, bottom=bottom, top=top, wspace=block.space[0],
            hspace=block.space[1],
        )  # fmt: skip
        for k, panel in enumerate(block.panels):
            if panel is None:
                continue
            axes = figure.add_subplot(grid[k])
            axes.set_anchor(block.anchor)
            title(axes, panel[0])
            panel[1](axes)
    save_figure(figure, path)


def title(axes: "Axes", text: str, pad: float = 6) -> None:
    """Write a title over the left end of axes."""
    # With a given y, matplotlib does not measure all ticks of the figure.
    axes.set_title(text, loc="left", y=1.0, size=11.5, color=INK, pad=pad)


def photograph_title(name: str) -> str:
    """Return the title of a picture of a photograph; of long names, the end is shown."""
    return f"Photograph {name if len(name) <= LONGEST else f'…{name[1 - LONGEST :]}'}"


def caption(axes: "Axes", text: str) -> None:
    """Write a smaller title over the middle of axes."""
    axes.set_title(text, loc="center", y=1.0, size=10, color=INK, pad=4)


def labels(axes: "Axes", across: str = "", up: str = "", size: float = TEXT) -> None:
    """Write the labels of both axes."""
    axes.set_xlabel(across, size=size, color=FAINT)
    axes.set_ylabel(up, size=size, color=FAINT)


def legend(axes: "Axes", size: float = TEXT, **options: Any) -> None:
    """Draw a legend without a frame; ``options`` are matplotlib's."""
    axes.legend(fontsize=size, frameon=False, labelcolor=INK, **options)


def write_centered(axes: "Axes", text: str) -> None:
    """Write a text in the centre of empty axes."""
    same: Any = {"ha": "center", "va": "center", "transform": axes.transAxes}
    axes.text(0.5, 0.5, text, color=FAINT, size=11, **same)


def minimal_axes(axes: "Axes") -> None:
    """Draw faint lower and left axes only."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(RULE)
    axes.tick_params(labelsize=9, color=RULE, labelcolor=INK, length=3)


def frame_map(axes: "Axes") -> None:
    """Draw a faint frame around a map, without ticks."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color(RULE)


def draw_image(axes: "Axes", image: np.ndarray) -> None:
    """Draw a picture without axes."""
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])  # saves matplotlib from making ticks that it does not draw
    axes.set_axis_off()


def scalar_mappable(
    limits: tuple[float, float], colormap: "str | Colormap" = COLORMAP
) -> "ScalarMappable":
    """Return a mapping of numbers to colours, also for a colour bar."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return ScalarMappable(Normalize(*limits), colormap)


def colors(
    values: np.ndarray, limits: tuple[float, float] = (0, 1), colormap: "str | Colormap" = COLORMAP
) -> np.ndarray:
    """Return the screen colours of numbers of any shape, (..., 3) float32."""
    drawn = scalar_mappable(limits, colormap)
    return np.array(drawn.get_cmap()(drawn.norm(values))[..., :3], np.float32)


def css(color: Sequence[float]) -> str:
    """Return a colour as a CSS hex code."""
    return "#" + "".join(f"{round(255 * float(value)):02x}" for value in color)


def css_colors(values: np.ndarray, colormap: str = COLORMAP) -> list[str]:
    """Return the CSS colours of numbers in [0, 1]."""
    return [css(color) for color in colors(values, colormap=colormap)]


def css_gradient(colormap: str) -> str:
    """Return a colormap as the stops of a CSS gradient."""
    return ", ".join(css_colors(np.linspace(0, 1, 9), colormap))


def color_bar(
    axes: "Axes", drawn: Any, label: str = "",
    place: tuple[float, float, float, float] | None = BELOW, size: float = TEXT,
    ticks: Sequence[float] = (),
) -> Any:  # fmt: skip
    """Draw and return the colour bar of an image or a ``scalar_mappable``.

    ``place`` is left, bottom, width and height as fractions of the axes; None fills them.
    """
    figure: Any = axes.figure
    inside = axes if place is None else axes.inset_axes(place)
    upright = place is not None and place[2] <= place[3]
    bar = figure.colorbar(drawn, cax=inside, orientation="vertical" if upright else "horizontal")
    if ticks:
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.outline.set_visible(False)
    bar.set_label(label, size=size, color=FAINT)
    bar.ax.tick_params(labelsize=size, color=FAINT, labelcolor=INK, length=3)
    return bar
