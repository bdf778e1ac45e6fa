"""Draw rooms.svg, the import graph of the package: python notebooks/draw_rooms.py."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path(__file__).parent
PICTURE = FOLDER / "rooms.svg"
Graph = dict[str, set[str]]


def imports(node: ast.AST) -> Iterator[str]:
    """Yield the rooms that a module imports at run time."""
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("svu_mi"):
        yield from (f"{node.module}.{alias.name}".split(".")[1] for alias in node.names)
    for child in ast.iter_child_nodes(node):
        yield from imports(child)


def graph(package: Path = FOLDER.parent / "svu_mi") -> Graph:
    """Return the imports of each room: a folder of the package, or ``pipeline.py``."""
    files = {path.parent.name: path.parent.rglob("*.py") for path in package.glob("*/__init__.py")}
    files["pipeline"] = iter([package / "pipeline.py"])
    return {
        room: {other for path in paths for other in imports(ast.parse(path.read_text()))}
        & files.keys() - {room}
        for room, paths in files.items()
    }


def floor(room: str, below: Graph) -> int:
    """Return the length of the longest chain of imports below a room."""
    return 1 + max((floor(other, below) for other in below[room]), default=-1)


def arrows(below: Graph) -> list[tuple[str, str]]:
    """Return the transitive reduction of the import graph."""
    reached: Graph = {}
    for room in sorted(below, key=lambda room: floor(room, below)):
        reached[room] = below[room].union(*(reached[other] for other in below[room]))
    return sorted(
        (room, other)
        for room, others in below.items()
        for other in others - {far for near in others for far in reached[near]}
    )


def drawn(picture: Path = PICTURE) -> list[tuple[str, ...]]:
    """Return the arrows that the description of a picture lists."""
    words = re.search(r"<dc:description>([^<]*)", picture.read_text())
    return [tuple(pair.split()) for pair in words[1].split(",")] if words else []


def draw(picture: Path = PICTURE) -> None:
    """Draw the rooms, each above all rooms that it imports."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "svu_mi", "svg.fonttype": "none"})
    from matplotlib import pyplot

    below = graph()
    place: dict[str, tuple[float, int]] = {}
    for level in range(len(below)):
        rooms = sorted(room for room in below if floor(room, below) == level)
        for k, room in enumerate(rooms):
            place[room] = (1.5 * (k - (len(rooms) - 1) / 2), level)
    figure, axes = pyplot.subplots(figsize=(7, 7.5))
    for room, other in arrows(below):
        (x, y), (to_x, to_y) = place[room], place[other]
        style = {"arrowstyle": "-|>", "color": "0.45", "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (to_x, to_y + 0.27), (x, y - 0.27), arrowprops=style)
    for room, (x, y) in place.items():
        box = {"boxstyle": "round", "facecolor": "#e8eef7", "edgecolor": "0.5"}
        label = "pipeline.py" if room == "pipeline" else f"{room}/"
        axes.text(x, y, label, ha="center", va="center", fontsize=11, bbox=box)
    axes.set(xlim=(-3.2, 3.2), ylim=(-0.5, max(y for _, y in place.values()) + 0.5))
    axes.set_axis_off()
    words = ", ".join(" ".join(arrow) for arrow in arrows(below))
    figure.savefig(picture, bbox_inches="tight", metadata={"Description": words, "Date": None})


if __name__ == "__main__":
    draw()
