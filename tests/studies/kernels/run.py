"""How fast and how exact the kernels are, and the whole way from files to a map.

Each part has a file of its own: ``entropy``, ``fit``, ``gather``, ``end_to_end``,
``skipping`` and ``scaling``. This one says how large everything is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from studies.kernels.end_to_end import measure_end_to_end
from studies.kernels.entropy import measure_entropy
from studies.kernels.fit import CASES, Case, measure_fit
from studies.kernels.gather import fine_capture, large_enough, measure_gather
from studies.kernels.scaling import Range, measure_scaling
from studies.kernels.skipping import measure_skipping
from svu_mi.bench.captures import capture_of
from svu_mi.bench.cells import Cell, own_cells
from svu_mi.bench.experiment import Bench, Part, Record
from svu_mi.bench.sizes import Sizes
from svu_mi.bench.speed.measure import timed_setting
from svu_mi.bench.text import Bar
from svu_mi.capture import Capture

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


@dataclass(frozen=True)
class Kernels:
    """All kernels, and the whole way with the photographs of a cell.

    Everything is warm and synchronised: the median of several runs, with the least and the
    greatest. Compilation is measured in new processes with an empty kernel cache.

    Attributes:
        bench: where and how.
        cell: its photographs are used for the whole way, and, if its mesh is fine enough, for the
            gather; without it, photographs of our own are rendered.
    """

    bench: Bench
    cell: Cell | None = None

    name = "all"
    title = "Kernels"

    @property
    def rows(self) -> Sequence[Part]:
        return PARTS

    @property
    def sizes(self) -> KernelSizes:
        """How large everything is."""
        return QUICK if self.bench.quick else FULL

    def settings(self, row: Part | None) -> Any:
        del row
        return self.cell and self.cell.title, asdict(self.sizes)

    def head(self) -> Record:
        """Return the ``cell``."""
        return {"cell": self.cell and self.cell.title}

    def measure(self, row: Part) -> Record:
        """Measure one part."""
        return row.measure(self)

    @cached_property
    def capture(self) -> Capture | None:
        """Photographs of the cell."""
        return None if self.cell is None else timed_setting(self.bench, self.cell)[0]

    def entropy(self) -> Record:
        """Time the entropy."""
        return measure_entropy(self.sizes.texels, self.sizes.repeats)

    def fit(self) -> Record:
        """Time the SH fit."""
        return measure_fit(self.sizes.texels, self.sizes.repeats, self.sizes.fits)

    def gather(self) -> Record:
        """Time the gather."""
        sizes = self.sizes
        seen = self.capture if self.capture and large_enough(self.capture) else None
        seen = seen or fine_capture(sizes.views, sizes.film)
        return measure_gather(seen, sizes.resolution, sizes.repeats)

    def end_to_end(self) -> Record:
        """Time the way from files to entropy.exr."""
        sizes = self.sizes
        source = folder_of(self.capture) or folder_of(self._rendered(sizes.views, sizes.film))
        assert source is not None
        return measure_end_to_end(source, sizes.resolution, sizes.repeats, sizes.methods)

    def skipping(self) -> Record:
        """Time what can be skipped."""
        sizes = self.sizes
        return measure_skipping(
            sizes.views, sizes.skipping_film, sizes.resolution, sizes.repeats, sizes.methods
        )

    def scaling(self) -> Record:
        """Time more and more texels and views."""
        sizes = self.sizes
        small = self._rendered(sizes.scaled_views, sizes.scaled_film)
        return measure_scaling(small, sizes.scaled, sizes.repeats, sizes.methods)

    def _rendered(self, views: int, film: int) -> Capture:
        """Return photographs of our own, rendered once."""
        (cell,) = own_cells(["vase"], ["window"])
        photographs = Sizes(views=views, film=film, spp=self.sizes.spp)
        folder = self.bench.folder / "kernels" / f"vase_{views}_{film}"
        return capture_of(cell, photographs, folder, self.bench.progress)


PARTS = (
    Part("entropy", Kernels.entropy),
    Part("fit", Kernels.fit),
    Part("gather", Kernels.gather),
    Part("end_to_end", Kernels.end_to_end),
    Part("skipping", Kernels.skipping),
    Part("scaling", Kernels.scaling),
)


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of all parts."""
    names = [each.name for each in fields(Bar)]
    return [
        Bar(**{name: bar[name] for name in names})
        for cell in record["cells"] for part in cell["rows"].values()
        for bar in part.get("bars", ())
    ]  # fmt: skip


def folder_of(capture: Capture | None) -> Path | None:
    """Return the folder that a capture can be loaded from again, None if there is none."""
    if capture is None or capture.source is None:
        return None
    return capture.source if (capture.source / DESCRIPTION).is_file() else None
