"""One capture of the benchmark, and how a way of recovery is measured on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from studies.orb.options import Options, OrbRow, OrbSizes, object_of
from studies.orb.plots import draw_pictures
from studies.orb.targets import Target, judge_albedo, judge_pictures
from svu_mi.bench.accuracy import Bench
from svu_mi.bench.recovery.measure import figures, run_warm
from svu_mi.bench.store import Store, code_and_machine, key_of
from svu_mi.capture import Capture, load_capture
from svu_mi.formats.importing import ImportOptions, import_capture
from svu_mi.formats.stanford_orb import Split, read_orb, read_views
from svu_mi.pipeline import estimate
from svu_mi.recovery.textures import Textures, uniform
from svu_mi.surface import Texels, texels

Record = dict[str, Any]
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

    @cached_property
    def store(self) -> Store:
        return Store(self.bench.folder / PLACE / self.path.name)

    def recall(self, row: OrbRow) -> Record:
        """Return the record of a row, from disk if it is there."""
        key = key_of(self._source, asdict(self.sizes), asdict(row), code_and_machine())
        return self.store.recall(row.slug, key, lambda: self.measure(row), fresh=self.bench.fresh)

    def measure(self, row: OrbRow) -> Record:
        """Recover textures, and compare pictures of them with photographs."""
        head = self.head  # first: what is wrong with the data is said before any long work
        timed = run_warm(row, self.capture, self.grid, self.sizes.recovery)
        return {
            "capture": head,
            **figures(timed),
            **self.judge(timed.result.textures, row.label, row.slug),
        }

    def judge(self, textures: Textures, label: str, name: str) -> Record:
        """Return the figures of textures: ``light``, ``view`` and ``albedo``.

        Args:
            textures: of the object.
            label: for the pictures.
            name: of the file with pictures.
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
        draw_pictures(self.store.folder / f"{name}.png", label, shown)
        albedo = judge_albedo(self.test, self.capture, textures)
        return {"light": light, "view": view, "albedo": albedo}

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the split ``train``, imported once."""
        folder = self.store.folder / "capture"
        key = key_of(self._source, self.sizes.film, code_and_machine())
        if self.store.load("import", key) is None or self.bench.fresh:
            source = read_orb(self.path, environment_view=self.options.environment_view)
            shrink = max(1.0, max(source.frames[0].size) / self.sizes.film)
            with self.bench.progress.stage(f"Importing {self.path.name}", len(source.frames)) as s:
                notes = import_capture(
                    source, folder, ImportOptions(shrink=shrink), progress=s.update
                )
            self.store.save("import", key, {"notes": notes})
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

    @cached_property
    def head(self) -> Record:
        """What holds for all rows: counts, entropy, and what a grey object reaches."""
        counts = {"novel": len(self.novel), "test": len(self.test)}
        with self.bench.progress.stage(f"{self.path.name}: entropy"):
            found = estimate(self.capture, self.grid)
        seen = np.array(found.coverage) > 0
        entropy = np.array(found.entropy)[seen]
        grey = replace(uniform(self.grid, 0.5), metallic=uniform(self.grid, 0.0).metallic)
        return {
            "name": self.path.name,
            "object": object_of(self.path.name),
            "photographs": self.capture.count,
            **counts,
            "texels": self.grid.count,
            "seen": int(seen.sum()),
            "entropy": float(entropy.mean()),
            "entropy_seconds": sum(found.timings.values()),
            "grey": self.judge(grey, "grey", "grey"),
        }

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
