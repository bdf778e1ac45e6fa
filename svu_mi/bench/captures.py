"""Photographs of a cell: rendered once, read again afterwards."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from svu_mi.bench.cells import Cell
from svu_mi.bench.sizes import Sizes
from svu_mi.bench.store import Store, key_of
from svu_mi.capture import Capture, load_capture, render_capture
from svu_mi.capture import folder as capture_folder
from svu_mi.progress import Progress
from svu_mi.results.record import digest_of, is_as_written
from svu_mi.spacing import evenly_spaced

MARK = "bench"  # bench.json in the capture's folder: the key it was rendered under


def capture_of(cell: Cell, sizes: Sizes, folder: Path, progress: Progress) -> Capture:
    """Render a cell's photographs into a folder, or read them if they are there.

    Args:
        cell: object and light.
        sizes: number and size of the photographs.
        folder: of the capture.
        progress: shows what is going on.

    Raises:
        SceneError: the scene cannot be rendered.
        OutputError: the folder cannot be written.
    """
    key = key_of(
        contents(cell), cell.defines, sizes.views, sizes.film, sizes.spp, sizes.seed
    )
    store = Store(folder)
    if store.load(MARK, key) is not None and is_as_written(folder, capture_folder.FILE):
        with progress.stage(f"Loading {cell.title}"):
            return load_capture(folder)
    store.path(MARK).unlink(missing_ok=True)
    with progress.stage(f"Rendering {cell.title}", sizes.views) as stage:
        capture = render_capture(
            cell.scene, sizes.spp, sizes.seed, folder=folder, views=sizes.views,
            resolution=(sizes.film, sizes.film), defines=cell.defines,
            progress=stage.update,
        )  # fmt: skip
    store.save(MARK, key, {"cell": cell.name, "settings": sizes.shared})
    return capture


def contents(cell: Cell) -> list[tuple[str, str]]:
    """Return digests of the scene, of all that lies beside it, of lights and of files given."""
    folders = (cell.scene.parent, cell.scene.parent.parent / "lights")
    beside = sorted(path for folder in folders for path in folder.rglob("*"))
    given = map(Path, cell.defines.values())
    return [(path.name, digest_of(path)) for path in (*beside, *given) if path.is_file()]


def some_views(capture: Capture, count: int) -> Capture:
    """Return the capture with ``count`` of its views, evenly spread over their order."""
    return chosen_views(capture, evenly_spaced(capture.count, count))


def chosen_views(capture: Capture, indices: Iterable[int]) -> Capture:
    """Return the capture with the views of these indices, in this order."""
    names = ["sensors", "images", "masks", "exposures", "names", "unusable", "used"]
    names += [name for name in ("files", "clipped", "rounding") if getattr(capture, name)]
    chosen = [int(index) for index in indices]
    views: dict[str, Any] = {
        name: tuple(getattr(capture, name)[i] for i in chosen) for name in names
    }
    return replace(capture, **views)
