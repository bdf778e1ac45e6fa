"""``svu bench orb``: Stanford-ORB, by the rules of the data set.

Textures are recovered from every capture, and rendered pictures are compared with photographs.
``orb_targets`` reads these photographs, ``orb_metrics`` implements the rules, and ``dataset``
renders a small data set of svu_mi's scenes in the same layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.bench.experiment import BenchRun, Experiment, Record, file_name
from svu_mi.bench.orb.dataset import find_captures, own_dataset
from svu_mi.bench.orb.orb_tables import draw_pictures, orb_lines, orb_tables, write_csv
from svu_mi.bench.orb.orb_targets import Target, score_albedo, score_pictures
from svu_mi.bench.problem_sizes import RecoverySizes
from svu_mi.bench.recovery import methods as ways
from svu_mi.bench.recovery import recover_warm, run_figures
from svu_mi.bench.recovery.methods import RecoveryMethod
from svu_mi.bench.result_cache import Store
from svu_mi.bench.study import Selection, Study
from svu_mi.capture.capture import Capture
from svu_mi.capture.importers.import_capture import ImportOptions, import_capture
from svu_mi.capture.importers.stanford_orb import Split, read_orb, read_views
from svu_mi.capture.loading import load_capture
from svu_mi.core.io.files import prepare_folder
from svu_mi.core.validation import require_known
from svu_mi.geometry.texels import Texels, texels
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.presets import preset
from svu_mi.recovery.recovery_options import PathOptions, ShOptions
from svu_mi.recovery.svbrdf_textures import Textures, uniform_textures

PLACE = "orb"  # folder of finished results


@dataclass(frozen=True)
class OrbRow(RecoveryMethod):
    """Recovery method for real photographs: our model and path tracing include indirect light."""

    def source(self, capture: Capture, grid: Texels) -> Capture | Estimate:
        """Return an estimate with all bounces for our model, else the capture."""
        if self.method == "path" or self.sh != "default":
            return capture
        switches = preset("default", method="angular", bounces=True)
        return estimate(capture, grid, preset=switches, whole=True)

    def options(self, scale: float = 1.0) -> tuple[ShOptions, PathOptions]:
        """Return the options of the presets (see ``RecoveryMethod``)."""
        sh, path = super().options(scale)
        return sh, replace(path, max_depth=None)


# Ours, and the methods of Table 1: SH model, power spectrum, SH and one epoch of paths, Mitsuba.
ROWS = tuple(
    OrbRow(row.label, row.method, row.sh, row.path, row.sharing)
    for row in (
        ways.SH,
        ways.SH_PATH,
        ways.PATH,
        ways.SH_PAPER,
        ways.SPECTRUM,
        ways.SH_PAPER_PATH,
        ways.PATH_PAPER,
    )
)


@dataclass(frozen=True, kw_only=True)
class OrbSizes:
    """Sizes of the Stanford-ORB benchmark; part of every cache key.

    Attributes:
        film: Longer side in pixels to which photographs are reduced first; the evaluation of the
            data set uses 512.
        texels: Texels per side.
        spp: Samples per pixel of the pictures.
        recovery: Options of the timed runs.
    """

    film: int = 512
    texels: int = 512
    spp: int = 128
    recovery: RecoverySizes = field(default_factory=RecoverySizes)


FULL = OrbSizes()
RENDERED = OrbSizes(film=128, texels=128)  # of svu_mi's scenes, whose photographs are small
QUICK = OrbSizes(film=128, texels=128, spp=64, recovery=RecoverySizes(warm=False, repeats=1))


@dataclass(frozen=True)
class OrbCase:
    """A capture of the data set; its data are loaded when a record is missing.

    Attributes:
        bench: Folder, sizes and options of the run.
        path: Folder of the capture in the data set.
        rows: Recovery methods.
        environment_view: Test photograph whose environment map is the light of recovery; the
            first by default.
        rendered: True for a data set of svu_mi's scenes.
    """

    bench: BenchRun
    path: Path
    rows: Sequence[OrbRow]
    environment_view: str | None
    rendered: bool

    @property
    def sizes(self) -> OrbSizes:
        """Sizes of the benchmark."""
        full = RENDERED if self.rendered else FULL
        return QUICK if self.bench.quick else full

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def title(self) -> str:
        return self.path.name

    def settings(self, row: OrbRow | None) -> Any:
        return self._source, asdict(self.sizes), row and asdict(row)

    def measure(self, row: OrbRow) -> Record:
        """Return times of the recovery and scores of its textures."""
        timed = recover_warm(row, self.capture, self.grid, self.sizes.recovery)
        return {**run_figures(timed), **self.score(timed.result.textures, row.label)}

    def score(self, textures: Textures, label: str) -> Record:
        """Return the scores of textures: ``light``, ``view`` and ``albedo``.

        Args:
            textures: Textures of the object.
            label: Label in the pictures.
        """
        spp = self.sizes.spp
        relit, seen = (
            [target.picture(self.capture, textures, spp) for target in targets]
            for targets in (self.novel, self.test)
        )
        light = score_pictures(self.novel, relit, scaled=True)
        view = score_pictures(self.test, seen, scaled=False)
        shown = [("another light", self.novel[0], relit[0], light, True),
                 ("another view", self.test[0], seen[0], view, False)]  # fmt: skip
        draw_pictures(self._folder / f"{file_name(label)}.png", label, shown)
        albedo = score_albedo(self.test, self.capture, textures)
        return {"light": light, "view": view, "albedo": albedo}

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the split ``train``, imported once."""
        folder = self._folder / "capture"
        store = Store(self._folder)

        def imported() -> Record:
            source = read_orb(self.path, environment_view=self.environment_view)
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
        """Photographs of the object in other places."""
        return self._targets("novel")

    @cached_property
    def test(self) -> Sequence[Target]:
        """Photographs of the object in this place from other sides."""
        return self._targets("test")

    def head(self) -> Record:
        """Return counts, entropy, and the scores of a grey object."""
        counts = {"novel": len(self.novel), "test": len(self.test)}
        with self.bench.progress.stage(f"{self.path.name}: entropy"):
            estimated = estimate(self.capture, self.grid)
        seen = np.array(estimated.coverage) > 0
        entropy = np.array(estimated.entropy)[seen]
        grey = uniform_textures(self.grid, 0.5).but(
            metallic=uniform_textures(self.grid, 0.0).metallic
        )
        return {
            "name": self.path.name,
            "film": self.sizes.film,
            "resolution": self.sizes.texels,
            "rendered": self.rendered,
            "object": object_of(self.path.name),
            "photographs": self.capture.count,
            **counts,
            "texels": self.grid.count,
            "seen": int(seen.sum()),
            "entropy": float(entropy.mean()),
            "entropy_seconds": sum(estimated.timings.values()),
            "grey": self.score(grey, "grey"),
        }

    @property
    def _folder(self) -> Path:
        return prepare_folder(self.bench.folder / PLACE / self.name)

    @property
    def _source(self) -> tuple[str, str | None]:
        return str(self.path.resolve()), self.environment_view

    def _targets(self, split: Split) -> Sequence[Target]:
        views = read_views(self.path, split)
        with self.bench.progress.stage(f"{self.path.name}: reading {split}", len(views)) as stage:
            targets = []
            for view in views:
                targets.append(Target.of(view, self.sizes.film))
                stage.update(len(targets), len(views))
        return targets


def chosen_rows(labels: Sequence[str]) -> tuple[OrbRow, ...]:
    """Return the rows with given labels; without labels, all rows without path tracing.

    Raises:
        OptionError: Unknown label.
    """
    require_known(labels, [row.label for row in ROWS], "row")
    return tuple(row for row in ROWS if row.label in labels or not (labels or row.traced))


def chosen_captures(captures: Sequence[Path], names: Sequence[str]) -> tuple[Path, ...]:
    """Return captures by name (``teapot_scene001`` or ``teapot``); all captures without names.

    Raises:
        OptionError: Unknown name.
    """
    both = {path: {path.name, object_of(path.name)} for path in captures}
    require_known(names, sorted(set[str]().union(*both.values())), "capture or object")
    return tuple(path for path in captures if not names or both[path] & set(names))


def object_of(capture: str) -> str:
    """Return the object of a capture: ``teapot`` of ``teapot_scene001``."""
    return capture.rpartition("_")[0] or capture


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    rows = chosen_rows(selection.rows)
    data = own_dataset(bench) if selection.data is None else selection.data
    captures = chosen_captures(find_captures(data), selection.objects)
    own = selection.data is None
    settings = (OrbCase(bench, path, rows, selection.environment_view, own) for path in captures)
    return Experiment(PLACE, settings, whole=True)


STUDY = Study(
    title="Stanford-ORB", experiment=_experiment, tables=orb_tables, lines=orb_lines,
    files={"orb.csv": write_csv}, runs_on="data",
)  # fmt: skip
