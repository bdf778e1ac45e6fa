"""How fast and how exact the kernels are, and the whole way from files to a map.

Each part has a file of its own: ``entropy``, ``fit``, ``gather``, ``end_to_end``,
``skipping`` and ``scaling``. This one says how large everything is, and calls them in turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from studies.kernels.end_to_end import measure_end_to_end
from studies.kernels.entropy import measure_entropy
from studies.kernels.fit import CASES, Case, measure_fit
from studies.kernels.gather import fine_capture, large_enough, measure_gather
from studies.kernels.scaling import Range, measure_scaling
from studies.kernels.skipping import measure_skipping
from svu_mi.bench.accuracy import Bench
from svu_mi.bench.captures import capture_of
from svu_mi.bench.cells import Cell, own_cells
from svu_mi.bench.sizes import Sizes
from svu_mi.bench.speed import timed_setting
from svu_mi.bench.store import Store, code_and_machine, key_of
from svu_mi.capture import Capture
from svu_mi.progress import Progress

METHODS = ("angular", "spectrum")
DESCRIPTION = "capture.json"  # in a folder that can be loaded again


@dataclass(frozen=True, kw_only=True)
class KernelSizes:
    """Sizes of the measurements.

    Attributes:
        texels: of the kernels that need no capture.
        resolution: texels per side, of all that need one.
        views, film: photographs, and pixels per side of each.
        spp: samples per pixel of photographs that have to be rendered.
        repeats: warm runs, after two that do not count.
        fits: what the SH fit is timed with.
        scaled: sizes of the scaling curves.
        scaled_views, scaled_film: photographs of these.
        skipping_film: pixels per side of the photographs of a scene that needs little.
        methods: of ``estimate``.
    """

    texels: int = 512**2
    resolution: int = 512
    views: int = 60
    film: int = 512
    spp: int = 8
    repeats: int = 5
    fits: tuple[Case, ...] = CASES
    scaled: Range = field(default_factory=Range)
    scaled_views: int = 60
    scaled_film: int = 128
    skipping_film: int = 256
    methods: tuple[str, ...] = METHODS


FULL = KernelSizes()
QUICK = KernelSizes(
    texels=128**2, resolution=256, views=24, film=128, repeats=3,
    scaled=Range((64, 128, 256), (15, 60, 240), 96), scaled_views=24, skipping_film=96,
)  # fmt: skip


def run_kernels(
    folder: Path, progress: Progress, quick: bool, capture: Capture | None
) -> dict[str, Any]:
    """Measure kernels, the whole way, and scaling.

    Everything is warm and synchronised: the median of several runs, with the least and the
    greatest. Compilation is measured in new processes with an empty kernel cache.

    Args:
        folder: photographs of our own are kept here.
        progress: shows what is going on.
        quick: small sizes, for which the bars are not meant.
        capture: with a folder it was loaded from, it is used for the whole way, and, if its
            mesh is fine enough, for the gather.

    Returns:
        ``entropy``, ``fit``, ``gather``, ``end_to_end``, ``skipping`` and ``scaling``: what the
        files of these names return; ``bars``, all of theirs; and ``quick``.

    Raises:
        SvuEnvironmentError: a new process failed.
        OutputError: the folder cannot be written.
    """
    sizes = QUICK if quick else FULL
    record: dict[str, Any] = {"quick": quick}
    with progress.stage("Timing the entropy"):
        record["entropy"] = measure_entropy(sizes.texels, sizes.repeats)
    with progress.stage("Timing the SH fit"):
        record["fit"] = measure_fit(sizes.texels, sizes.repeats, sizes.fits)
    with progress.stage("Timing the gather"):
        seen = capture if capture and large_enough(capture) else None
        seen = seen or fine_capture(sizes.views, sizes.film)
        record["gather"] = measure_gather(seen, sizes.resolution, sizes.repeats)
    source = folder_of(capture) or _rendered(folder, progress, sizes.views, sizes.film, sizes)
    with progress.stage("Timing the way from files to entropy.exr"):
        record["end_to_end"] = measure_end_to_end(
            source, sizes.resolution, sizes.repeats, sizes.methods
        )
    with progress.stage("Timing what can be skipped"):
        record["skipping"] = measure_skipping(
            sizes.views, sizes.skipping_film, sizes.resolution, sizes.repeats, sizes.methods
        )
    small = _capture(folder, progress, sizes.scaled_views, sizes.scaled_film, sizes)
    with progress.stage("Timing more and more texels and views"):
        record["scaling"] = measure_scaling(small, sizes.scaled, sizes.repeats, sizes.methods)
    parts = (part for part in record.values() if isinstance(part, dict))
    record["bars"] = [bar for part in parts for bar in part.get("bars", ())]
    return record


def recall_kernels(bench: Bench, cell: Cell) -> dict[str, Any]:
    """Return what ``run_kernels`` finds with the photographs of a cell, from disk if it is there.

    Raises:
        SceneError: the cell cannot be rendered.
        OutputError: the folder cannot be written.
    """
    capture, _ = timed_setting(bench, cell)
    store = Store(bench.folder / "kernels")
    key = key_of(bench.quick, code_and_machine(), cell.title)
    compute = partial(run_kernels, store.folder, bench.progress, bench.quick, capture)
    return store.recall("kernels", key, compute, fresh=bench.fresh)


def folder_of(capture: Capture | None) -> Path | None:
    """Return the folder that a capture can be loaded from again, None if there is none."""
    if capture is None or capture.source is None:
        return None
    return capture.source if (capture.source / DESCRIPTION).is_file() else None


def _rendered(folder: Path, progress: Progress, views: int, film: int, sizes: KernelSizes) -> Path:
    """Return the folder of photographs of our own."""
    _capture(folder, progress, views, film, sizes)
    return _place(folder, views, film)


def _capture(
    folder: Path, progress: Progress, views: int, film: int, sizes: KernelSizes
) -> Capture:
    photographs = Sizes(views=views, film=film, spp=sizes.spp)
    (cell,) = own_cells(["vase"], ["window"])
    return capture_of(cell, photographs, _place(folder, views, film), progress)


def _place(folder: Path, views: int, film: int) -> Path:
    return folder / f"vase_{views}_{film}"
