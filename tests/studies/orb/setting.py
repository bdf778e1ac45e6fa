"""One capture of the benchmark, and how a way of recovery is measured on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from studies.orb.options import Options, OrbRow, OrbSizes, object_of
from studies.orb.plots import draw_pictures
from studies.orb.targets import Target, judge_albedo, judge_pictures
from svu_mi.bench.experiment import Bench, Record, file_name
from svu_mi.bench.recovery.measure import figures, run_warm
from svu_mi.bench.store import Store
from svu_mi.capture import Capture, load_capture
from svu_mi.files import prepare_folder
from svu_mi.formats.importing import ImportOptions, import_capture
from svu_mi.formats.stanford_orb import Split, read_orb, read_views
from svu_mi.pipeline import estimate
from svu_mi.recovery.textures import Textures, uniform
from svu_mi.surface import Texels, texels

PLACE = "orb"  # folder of finished results


@dataclass(frozen=True)
class Setting:
    """A capture, loaded only when a result is missing.

    Attributes:
        bench: where and how.
        path: folder of the capture in the data set.
        options: what is run.
        sizes: how large.
    """

    bench: Bench
    path: Path
    options: Options
    sizes: OrbSizes

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def title(self) -> str:
        return self.path.name

    @property
    def rows(self) -> Sequence[OrbRow]:
        return self.options.chosen_rows()

    def settings(self, row: OrbRow | None) -> Any:
        return self._source, asdict(self.sizes), row and asdict(row)

    def measure(self, row: OrbRow) -> Record:
        """Recover textures, and compare pictures of them with photographs."""
        timed = run_warm(row, self.capture, self.grid, self.sizes.recovery)
        return {**figures(timed), **self.judge(timed.result.textures, row.label)}

    def judge(self, textures: Textures, label: str) -> Record:
        """Return the figures of textures: ``light``, ``view`` and ``albedo``.

        Args:
            textures: of the object.
            label: for the pictures.
        """
        spp = self.sizes.spp
        relit, seen = (
            [target.picture(self.capture, textures, spp) for target in targets]
            for targets in (self.novel, self.test)
        )
        light = judge_pictures(self.novel, relit, scaled=True)
        view = judge_pictures(self.test, seen, scaled=False)
        shown = [("another light", self.novel[0], relit[0], light, True),
                 ("another view", self.test[0], seen[0], view, False)]  # fmt: skip
        draw_pictures(self._folder / f"{file_name(label)}.png", label, shown)
        albedo = judge_albedo(self.test, self.capture, textures)
        return {"light": light, "view": view, "albedo": albedo}

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the split ``train``, imported once."""
        folder = self._folder / "capture"
        store = Store(self._folder)

        def imported() -> Record:
            source = read_orb(self.path, environment_view=self.options.environment_view)
            shrink = max(1.0, max(source.frames[0].size) / self.sizes.film)
            return {"notes": import_capture(source, folder, ImportOptions(shrink=shrink))}

        settings = self._source, self.sizes.film
        self.bench.recall(store, "import", f"Importing {self.name}", settings, imported)
        return load_capture(folder)

    @cached_property
    def grid(self) -> Texels:
        return texels(self.capture.mesh, self.sizes.texels)

    @cached_property
    def novel(self) -> Sequence[Target]:
        """The object in other places."""
        return self._targets("novel")

    @cached_property
    def test(self) -> Sequence[Target]:
        """The object in this place, from other sides."""
        return self._targets("test")

    def head(self) -> Record:
        """What holds for all rows: counts, entropy, and what a grey object reaches."""
        counts = {"novel": len(self.novel), "test": len(self.test)}
        with self.bench.progress.stage(f"{self.path.name}: entropy"):
            found = estimate(self.capture, self.grid)
        seen = np.array(found.coverage) > 0
        entropy = np.array(found.entropy)[seen]
        grey = uniform(self.grid, 0.5).but(metallic=uniform(self.grid, 0.0).metallic)
        return {
            "name": self.path.name,
            "object": object_of(self.path.name),
            "photographs": self.capture.count,
            **counts,
            "texels": self.grid.count,
            "seen": int(seen.sum()),
            "entropy": float(entropy.mean()),
            "entropy_seconds": sum(found.timings.values()),
            "grey": self.judge(grey, "grey"),
        }

    @property
    def _folder(self) -> Path:
        return prepare_folder(self.bench.folder / PLACE / self.name)

    @property
    def _source(self) -> tuple[str, str | None]:
        return str(self.path.resolve()), self.options.environment_view

    def _targets(self, split: Split) -> Sequence[Target]:
        views = read_views(self.path, split)
        with self.bench.progress.stage(f"{self.path.name}: reading {split}", len(views)) as stage:
            found = []
            for view in views:
                found.append(Target.of(view, self.sizes.film))
                stage.update(len(found), len(views))
        return found
