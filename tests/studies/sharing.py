"""What sharing between alike texels gains, from photographs mostly from one side.

    PYTHONPATH=tests python -m studies.sharing [--quick] [--data FOLDER] [--rows A,B,...]

Objects whose few materials repeat, and objects where nothing does; svu_mi's own, and those of a
data folder that are known for it, if they are there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from studies.captures import uneven_views
from studies.command import Command, main
from svu_mi import scenes
from svu_mi.bench.cells import DIRECT, Cell, data_cells, own_cells
from svu_mi.bench.experiment import Bench, Experiment, Record
from svu_mi.bench.plots import COLORS, FAINT, INK, page, save, tidy
from svu_mi.bench.recovery.bars import Claim, gain, mean_gain, paired
from svu_mi.bench.recovery.measure import Recovered, under_another_light
from svu_mi.bench.recovery.rows import PATH, PATH_SHARING, SH, SH_SHARING, Row, find_row
from svu_mi.bench.recovery.tables import recovery_tables, title_of
from svu_mi.bench.study import Asked, Study
from svu_mi.bench.text import Bar, Column, columns
from svu_mi.capture import Capture
from svu_mi.capture.picture import quantized, srgb
from svu_mi.cli.bench import Names, names
from svu_mi.errors import OptionError
from svu_mi.files import prepare_folder, replacing
from svu_mi.formats.textures import write_pictures
from svu_mi.parameters import NAMES
from svu_mi.scenes import make_assets, meshes, textures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Group = Literal["repeated", "varied"]
TITLES: dict[str, str] = {"repeated": "Few materials that repeat", "varied": "Nothing repeats"}
WAYS = (SH, SH_SHARING, PATH, PATH_SHARING)
PAIRS = ((SH_SHARING, SH), (PATH_SHARING, PATH))
LEAST = {("repeated", SH): 1.5, ("repeated", PATH): 0.5, ("varied", SH): -0.1,
         ("varied", PATH): -0.1}  # fmt: skip
TRACED = 2  # cells of a group that paths are traced for, which takes long

# Objects of our own for sharing: one whose few materials repeat, one where nothing does.
REPEATED, CONTINUOUS = "mosaic", "drift"
# Base colour, roughness, metallic: far apart, none a perfect mirror.
TILES = (
    ((0.62, 0.58, 0.50), 0.85, 0.0),  # plaster
    ((0.05, 0.14, 0.45), 0.25, 0.0),  # glaze
    ((0.55, 0.06, 0.05), 0.45, 0.0),  # lacquer
    ((0.95, 0.72, 0.35), 0.30, 1.0),  # gold
    ((0.45, 0.46, 0.50), 0.55, 1.0),  # steel
)
COLUMNS, ROWS, SEED = 14, 10, 91640277

SHARING_LIGHT, OTHER_LIGHT = "window", "overcast"  # of our own objects; of pictures of them
OF_DATA: dict[Group, tuple[str, ...]] = {
    "repeated": ("chess_rook_white", "chess_king_black"), "varied": ("flight_helmet", "lantern")
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Views:
    """Photographs: so many around the object, of which ``front`` and ``back`` are taken."""

    dense: int = 80
    front: int = 36
    back: int = 5


FULL, QUICK = Views(), Views(dense=24, front=9, back=2)


@dataclass(frozen=True)
class Uneven(Recovered):
    """A cell that is photographed mostly from one side.

    Attributes:
        group: of the object.
        views: its photographs.
    """

    group: Group
    views: Views

    @property
    def name(self) -> str:
        return f"{self.group}__{self.cell.name}"

    def settings(self, row: Row | None) -> Any:
        return self.views, self.group, super().settings(row)

    def head(self) -> Record:
        """Return what ``Recovered.head`` returns, and the ``group``."""
        return {"group": self.group, **super().head()}

    @cached_property
    def capture(self) -> Capture:
        """The photographs."""
        dense = self.views.dense
        whole = self.bench.capture(self.cell, f"capture_{dense}_views", views=dense)
        return uneven_views(whole, self.views.front, self.views.back)


def experiment(bench: Bench, asked: Asked) -> Experiment:
    """Return what is measured: the rows of ``asked``, all of ``WAYS`` by default.

    Raises:
        OptionError: there is no such row.
    """
    rows = [find_row(label) for label in asked.rows] or list(WAYS)
    return Experiment("sharing", _subjects(bench, asked.data, rows))


def _subjects(bench: Bench, data: Path | None, rows: Sequence[Row]) -> Iterator[Uneven]:
    traced = dict.fromkeys(TITLES, 0 if bench.quick else TRACED)
    for group, cell, relit_as in cells(data, bench.folder, quick=bench.quick):
        kept = [row for row in rows if traced[group] or not row.traced]
        traced[group] -= traced[group] > 0
        yield Uneven(bench, cell, relit_as, kept, group, QUICK if bench.quick else FULL)


def cells(
    data: Path | None, workspace: Path, *, quick: bool
) -> list[tuple[Group, Cell, Callable[[], Cell]]]:
    """Return (group, cell, what returns the same object under another light).

    Our own objects, the knot (three materials, worn), and those of a data folder that are
    known to repeat, or not to, if they are there.

    Args:
        data: folder of objects and environments, or None.
        workspace: our own objects are written into its ``objects``.
        quick: one object of our own under one light.
    """
    found: list[tuple[Group, Cell, Callable[[], Cell]]] = [("repeated", *_own(REPEATED, workspace))]
    if not quick:
        (knot,) = own_cells(["knot"], [SHARING_LIGHT])
        found.append(("repeated", knot, partial(under_another_light, knot, None, workspace)))
        found.append(("varied", *_own(CONTINUOUS, workspace)))
    if data is not None and not quick:
        for group, chosen in OF_DATA.items():
            for cell in _present(data, workspace, chosen):
                found.append((group, cell, partial(under_another_light, cell, data, workspace)))
    return sorted(found, key=lambda one: list(TITLES).index(one[0]))


def _own(name: str, workspace: Path) -> tuple[Cell, Callable[[], Cell]]:
    folder = own_object(name, workspace / "objects")

    def cell(light: str) -> Cell:
        image = scenes.FOLDER / "lights" / f"{light}.exr"
        defines = {"object": str(folder), "environment": str(image), **DIRECT}
        return Cell(name, light, scenes.path("object"), defines)

    return cell(SHARING_LIGHT), partial(cell, OTHER_LIGHT)


def _present(data: Path, workspace: Path, names: Sequence[str]) -> list[Cell]:
    """Return cells, under the first light of the folder, of the named objects that it has."""
    found = []
    for name in names:
        try:
            found.append(data_cells(data, workspace, [name])[0])
        except OptionError:
            continue
    return found


def own_object(name: str, folder: Path) -> Path:
    """Write one of our objects as ``scenes/object`` reads it, unless it is there.

    Args:
        name: ``mosaic`` or ``drift``.
        folder: gets a folder of that name.

    Returns:
        That folder, absolute.
    """
    place = prepare_folder(folder / name).resolve()
    paint = {REPEATED: mosaic, CONTINUOUS: drift}[name]
    if not (place / "mesh.ply").exists():
        color, rough, metal = paint()
        pictures = (quantized(values) for values in (srgb(color), rough, metal))
        write_pictures(dict(zip(NAMES, pictures, strict=True)), place)
        with replacing(place / "mesh.ply") as temporary:  # last: a folder that has it is whole
            make_assets.write_mesh(temporary, meshes.vase())
    return place


def mosaic() -> textures.Material:
    """Tiles of five materials, in random order: (H, W, 3), (H, W), (H, W), all linear."""
    u, v = textures.coordinates()
    column = np.floor(np.clip(textures.along(u), 0, 1 - 1e-9) * COLUMNS).astype(int)
    row = np.floor(v * ROWS).astype(int)
    order = np.random.default_rng(SEED).integers(0, len(TILES), (ROWS, COLUMNS))[row, column]
    color = np.array([tile[0] for tile in TILES])[order]
    rough, metal = (np.array([tile[k] for tile in TILES])[order] for k in (1, 2))
    return color, rough, metal


def drift() -> textures.Material:
    """Smooth noise in every parameter, so that no two places are alike."""
    u, v = textures.coordinates()
    around = textures.along(u)
    fields = [textures.noise(SEED + k, 3, around, v) for k in range(5)]
    color = np.stack(fields[:3], axis=-1) * 0.8 + 0.08
    return color, 0.2 + 0.65 * fields[3], fields[4]


def worst_gain(cells: Sequence[Record], row: Row, base: Row) -> float:
    """Return the least ``gain``; NaN without any."""
    return min(gain(cells, row, base), default=float("nan"))


def find_bars(record: Record) -> list[Bar]:
    """Return the bars that a record has figures for."""
    bars = []
    for (group, base), least in LEAST.items():
        row = dict((base, row) for row, base in PAIRS)[base]
        own = [cell for cell in record["cells"] if cell["group"] == group]
        value = mean_gain if group == "repeated" else worst_gain
        what = f"{TITLES[group].lower()}, {'mean' if group == 'repeated' else 'worst cell'}"
        bars.append(Claim(row, base, what, value, least, "dB", True).bar(own))
    return [bar for bar in bars if not np.isnan(bar.value)]


def tables(record: Record) -> list[str]:
    """Return the tables of a record."""
    parts = []
    for group, title in TITLES.items():
        own = [cell for cell in record["cells"] if cell["group"] == group]
        if own:
            parts += [f"## {title}", *recovery_tables({**record, "cells": own}),
                      columns(_gains(), own)]  # fmt: skip
    return parts


def _gains() -> list[Column]:
    """What sharing gains, per cell, over all texels and over those hardly seen."""
    shown = [Column("object / light", title_of),
             Column("texels hardly seen", lambda cell: f"{cell['hardly_seen']:,}")]  # fmt: skip
    for row, base in PAIRS:
        shown += [
            Column(f"{row.label} over {base.label}", partial(_gain, row, base), _signed),
            Column("hardly seen", partial(_hardly, row, base), _signed),
        ]
    return shown


def _signed(value: float) -> str:
    return f"{value:+.2f}"


def _gain(row: Row, base: Row, cell: Record) -> float | None:
    return next(iter(gain([cell], row, base)), None)


def _hardly(row: Row, base: Row, cell: Record) -> float | None:
    for one, other in paired([cell], row, base, lambda found: found["psnr_hardly_seen"]):
        return one["average"] - other["average"] if one and other else None
    return None


def draw(record: Record) -> Figure:
    """Draw what sharing gains in each cell."""
    figure = page(6.5, 4.8)
    axes, found = figure.add_subplot(), record["cells"][::-1]
    colors = dict(zip((SH, PATH), COLORS, strict=False))
    for place, cell in enumerate(found):
        for k, (row, base) in enumerate(PAIRS):
            for value in gain([cell], row, base):
                axes.barh(place + 0.18 - 0.36 * k, value, height=0.34, color=colors[base])
    axes.set_yticks(range(len(found)), [f"{title_of(cell)} ({cell['group']})" for cell in found],
                    fontsize=8)  # fmt: skip
    axes.axvline(0, color=INK, linewidth=0.8)
    for (group, base), least in LEAST.items():
        color = colors[base] if group == "repeated" else FAINT
        axes.axvline(least, color=color, linewidth=0.8, linestyle=":")
    for base, color in colors.items():
        axes.plot([], [], "s", color=color, label=base.label)
    axes.legend(frameon=False, fontsize=8, title="dotted: bars", title_fontsize=7)
    axes.set_xlabel("gain of sharing, average texture PSNR (dB)")
    tidy(axes)
    return figure


STUDY = Study(title="Sharing between alike texels", experiment=experiment, tables=tables,
              bars=find_bars)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Sharing(Command):
    """What sharing gains where photographs are mostly from one side; draws sharing.png, too."""

    rows: Names = ""
    """Ways of recovery to run; without it SH and path tracing, with sharing and without."""

    def study(self) -> Study:
        """Return what is measured."""
        return STUDY

    def asked(self) -> Asked:
        """Return what of it is run."""
        return replace(super().asked(), rows=names(self.rows, "--rows"))

    def write(self, study: Study, record: Record) -> None:
        """Draw the gains, too."""
        super().write(study, record)
        save(draw(record), self.output, "sharing")


if __name__ == "__main__":
    raise SystemExit(main(Sharing))
