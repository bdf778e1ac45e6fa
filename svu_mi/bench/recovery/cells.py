"""On what recovery is measured: cells of three groups."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from svu_mi import scenes
from svu_mi.bench.cells import DIRECT, Cell, chosen_cells, data_cells, own_cells
from svu_mi.capture.picture import quantized, srgb
from svu_mi.errors import OptionError
from svu_mi.files import prepare_folder, replacing
from svu_mi.formats.textures import write_pictures
from svu_mi.parameters import NAMES
from svu_mi.scenes import make_assets, meshes, textures

Group = Literal["even", "repeated", "varied"]
GROUPS: tuple[Group, ...] = ("even", "repeated", "varied")

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

OWN_LIGHTS = ("window", "overcast", "studio")  # those that are images
SHARING_LIGHT = "window"  # of our own objects in the sharing groups
# Objects of a --data folder whose materials repeat, and objects that are full of detail.
REPEATED_DATA, VARIED_DATA = ("chess_rook_white", "chess_king_black"), ("flight_helmet", "lantern")


@dataclass(frozen=True)
class Task:
    """One cell of the benchmark.

    Attributes:
        group: ``even``: photographs from everywhere; ``repeated``: from one side mostly, of an
            object whose few materials repeat; ``varied``: the same, where nothing repeats.
        cell: object and the light of the photographs.
        relit: the same object under a light not used for recovery.
    """

    group: Group
    cell: Cell
    relit: Cell

    @property
    def name(self) -> str:
        """Folder of its results."""
        return f"{self.group}__{self.cell.name}"

    @property
    def title(self) -> str:
        """For people."""
        return self.cell.title


def even_tasks(cells: Sequence[Cell], data: Path | None, workspace: Path) -> tuple[Task, ...]:
    """Return a task per cell; its other light is the next of all that the object has.

    Args:
        cells: objects x lights.
        data: folder the cells come from, None for the scenes of svu_mi.
        workspace: for objects that have to be converted.
    """
    return tuple(Task("even", cell, _relit(cell, data, workspace)) for cell in cells)


def sharing_tasks(data: Path | None, workspace: Path, *, quick: bool) -> tuple[Task, ...]:
    """Return the tasks that sharing is judged by, groups ``repeated`` and ``varied``.

    Our own objects, the knot (three materials, worn), and those of a data folder that are
    known to repeat, or not to, if they are there.

    Args:
        data: folder of objects and environments, or None.
        workspace: our own objects are written into its ``objects``.
        quick: one object of our own under one light.
    """
    found: list[Task] = []
    found.append(_own(REPEATED, SHARING_LIGHT, workspace))
    if not quick:
        found.append(_own(CONTINUOUS, SHARING_LIGHT, workspace))
        (knot,) = own_cells(["knot"], [SHARING_LIGHT])
        found.append(Task("repeated", knot, _relit(knot, None, workspace)))
    if data is not None and not quick:
        for group, names in (("repeated", REPEATED_DATA), ("varied", VARIED_DATA)):
            for cell in _present(data, workspace, names):
                found.append(Task(group, cell, _relit(cell, data, workspace)))  # type: ignore[arg-type]
    return tuple(sorted(found, key=lambda task: GROUPS.index(task.group)))


def _own(name: str, light: str, workspace: Path) -> Task:
    folder = own_object(name, workspace / "objects")
    others = [one for one in OWN_LIGHTS if one != light]

    def cell(sky: str) -> Cell:
        image = scenes.FOLDER / "lights" / f"{sky}.exr"
        defines = {"object": str(folder), "environment": str(image), **DIRECT}
        return Cell(name, sky, scenes.path("object"), defines)

    group: Group = "repeated" if name == REPEATED else "varied"
    return Task(group, cell(light), cell(others[0]))


def _present(data: Path, workspace: Path, names: Sequence[str]) -> list[Cell]:
    """Return cells, under the first light of the folder, of the named objects that it has."""
    found = []
    for name in names:
        try:
            found.append(data_cells(data, workspace, [name])[0])
        except OptionError:
            continue
    return found


def _relit(cell: Cell, data: Path | None, workspace: Path) -> Cell:
    """Return the same object under the light after the cell's, in the order of all lights."""
    around = chosen_cells(data, workspace, [cell.object])
    lights = [one.light for one in around]
    if len(lights) < 2:
        raise OptionError(
            f"{cell.title}: there is no second light to relight the object with; add another "
            "image to envmaps/."
        )
    return around[(lights.index(cell.light) + 1) % len(lights)]


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
