"""Record what this version of svu_mi reaches, so that later ones can be held against it.

    python tests/records/record.py --data DATA -o tests/records/NAME.json [--work FOLDER]

For every cell (object and light; those of BENCHMARKS.md, 6 x 4 of DATA and 12 of our own):

* rho, Pearson's and Spearman's correlation of the entropy with that of the path-traced posterior of
  1000 texels, noise of 8 % of the mean radiance;
* the closed-form means of recovery, before any smoothing: PSNR of each parameter over 1500 texels
  that some view sees (seed 0), against the mean of the true texture over the texel.

And run times, on the bottle: files to entropy.exr, 512 x 512 texels and 60 photographs of 512 x 512
by preset; recovery of 256 x 256 texels from 40 photographs. Photographs and references are kept in
the working folder and used again. Takes about 40 minutes on two cores, the second time 10.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import svu_mi as svu  # first: it chooses LLVM

import mitsuba as mi  # isort: skip

from svu_mi.bench.captures import some_views
from svu_mi.bench.cells import OWN_OBJECTS, Cell, data_cells, own_cells
from svu_mi.bench.experiment import Bench, Experiment, NamedAfterCell
from svu_mi.bench.fresh import in_new_process
from svu_mi.progress import Progress

sys.path.insert(0, str(Path(__file__).parents[1]))  # studies, and helpers of the tests

TEXELS, JUDGED, REFERENCE, FINER = 256, 1500, 1000, 4
PHOTOGRAPHS: dict[str, Any] = {"views": 60, "film": 256, "spp": 32}
OBJECTS = ["water_bottle", "chess_king_black", "chess_rook_white", "flight_helmet", "lantern",
           "barrel"]  # fmt: skip
LIGHTS = ["photo_studio_01", "rural_asphalt_road", "potsdamer_platz", "st_fagans_interior"]
TIMED, RUNS = ("water_bottle", "rural_asphalt_road"), 5


def parser() -> argparse.ArgumentParser:
    """Return what this record is asked."""
    found = arguments(__doc__)
    found.add_argument("--times", action="store_true", help="run times alone")
    return found


def main() -> None:
    """Record all cells, or times; finished cells of the same version are kept."""
    asked = parser().parse_args()
    mi.set_variant("llvm_ad_rgb")
    record = read(asked.output)
    cells = cells_of(asked.data, asked.work)
    if asked.times:
        timed = [cell for cell in cells if (cell.object, cell.light) == TIMED] or cells[:1]
        record["seconds"] = seconds(timed[0], asked.work)
    else:
        record["cells"] = run("record", cells, asked, alone(judge, asked))
        record["means"] = means(record["cells"])
    save(asked.output, record)


def cells_of(data: Path | None, work: Path, objects: Sequence[str] = ()) -> list[Cell]:
    """Return our own 12 cells, and the 24 of a folder of data, or those of other objects there."""
    chosen = [name for name in objects or OBJECTS if name not in ("vase", "knot")]
    theirs = data_cells(data, work, chosen, LIGHTS) if data else ()
    return [*own_cells(), *theirs]


def photographs(cell: Any, work: Path, film: int) -> Path:
    """Render a cell's photographs, once; return their folder."""
    folder = work / f"{cell.name}_{film}"
    if not (folder / "capture.json").exists():
        svu.render_capture(
            cell.scene, PHOTOGRAPHS["spp"], 0, folder=folder, views=PHOTOGRAPHS["views"],
            resolution=(film, film), defines=cell.defines,
        )  # fmt: skip
    return folder


def judge(cell: Any, work: Path) -> dict[str, Any]:
    """Return the figures of one cell."""
    from scipy.stats import spearmanr

    capture = svu.load_capture(photographs(cell, work, PHOTOGRAPHS["film"]))
    layout = svu.texels(capture.mesh, TEXELS)
    subset, traced, halves = reference(cell, work, capture, layout)
    found = svu.estimate(capture, layout, preset=noise_of_8_percent())
    entropy = np.array(found.entropy, np.float64)[subset]
    result: dict[str, Any] = {
        "rho": float(np.corrcoef(entropy, traced)[0, 1]),
        "spearman": float(spearmanr(entropy, traced)[0]),
        "rho of reference's halves": halves,
    }
    seen = np.flatnonzero(np.array(found.coverage))
    chosen = np.sort(np.random.default_rng(0).choice(seen, min(JUDGED, len(seen)), replace=False))
    truth, values = true_means(capture, layout, work / f"{cell.object}.npz"), closed_form(found)
    for name, true in truth.items():
        error = np.mean((values[name][chosen] - true[chosen]) ** 2)
        result[name] = float(-10 * np.log10(error))
    return result


def reference(
    cell: Any, work: Path, capture: Any, layout: Any
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return texels, their path-traced entropy, and how well its halves correlate; kept."""
    file = work / f"{cell.name}_reference.npz"
    if not file.exists():
        found = svu.reference_posterior(capture, layout, REFERENCE, 128)
        seen = found.coverage > 0
        np.savez(file, subset=found.subset[seen], entropy=found.entropy[seen],
                 halves=found.split_half().correlation)  # fmt: skip
    with np.load(file) as kept:
        return kept["subset"], kept["entropy"], float(kept["halves"])


def noise_of_8_percent() -> str:
    """Return the preset whose likelihood is the reference's."""
    return "fixed"


def closed_form(found: Any) -> dict[str, np.ndarray]:
    """Return the means of every texel's posterior that recovery starts from, by name."""
    posterior = svu.estimate(found).posterior
    names = ("base_color", "roughness", "metallic")
    return {name: np.array(posterior.mean(name)) for name in names}


def true_means(capture: Any, layout: Any, file: Path) -> dict[str, np.ndarray]:
    """Return the true textures' means over the texels, (T, ...) by parameter; kept."""
    from svu_mi.surface.material import parameters_at

    if not file.exists():
        fine = svu.texels(capture.mesh, TEXELS * FINER)
        width = layout.resolution[0]
        x, y = fine.index.numpy() % (width * FINER), fine.index.numpy() // (width * FINER)
        place = np.full(width * width, -1)
        place[layout.index.numpy()] = np.arange(layout.count)
        parent = place[(y // FINER) * width + x // FINER]
        inside = parent >= 0
        count = np.bincount(parent[inside], minlength=layout.count)
        result = {}
        for name, values in parameters_at(capture, fine).items():
            columns = np.atleast_2d(np.asarray(values, np.float64).T)[:, inside]
            sums = [np.bincount(parent[inside], column, layout.count) for column in columns]
            own = np.atleast_2d(np.asarray(parameters_at(capture, layout)[name], np.float64).T)
            mean = np.where(count > 0, np.array(sums) / np.maximum(count, 1), own).T
            result[name] = mean if mean.shape[1] > 1 else mean[:, 0]
        np.savez(file, **result)
    with np.load(file) as kept:
        return dict(kept)


def seconds(cell: Any, work: Path) -> dict[str, float]:
    """Return median seconds of warm runs, by what is run."""
    from studies.kernels.end_to_end import run_once

    folder = str(photographs(cell, work, 512))
    found: dict[str, float] = {}
    for preset in ("default", "fast"):
        run = lambda: to_map(folder, preset)  # noqa: B023, E731
        found[f"files to entropy.exr, {preset}"] = median(run)
    cold = in_new_process(run_once, source=folder, resolution=512, method="angular")
    found["files to entropy.exr, default, cold"] = cold["seconds"]
    found["files to entropy.exr, default, cold, with imports"] = cold["process_seconds"]
    found["peak MiB, cold"] = cold["peak_mib"]
    small = svu.load_capture(photographs(cell, work, 256))
    capture = some_views(small, 40)
    layout = svu.texels(capture.mesh, 256)
    found["recovery, 256 x 256, 40 photographs"] = median(lambda: svu.recover(capture, layout))
    return found


def to_map(folder: str, preset: str) -> None:
    """Go from files to entropy.exr."""
    import tempfile

    from svu_mi.output import write_maps

    with tempfile.TemporaryDirectory() as target:
        capture = svu.load_capture(folder)
        write_maps(svu.estimate(capture, svu.texels(capture.mesh, 512), preset=preset), target)


def median(run: Any) -> float:
    """Return the median time of ``RUNS`` warm runs."""
    import drjit as dr

    taken = []
    for _ in range(RUNS + 1):
        dr.sync_thread()
        start = time.perf_counter()
        run()
        dr.sync_thread()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken[1:])


def means(cells: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return the mean of every figure over our own cells, and over the others."""
    own = ("vase__", "knot__", "spheres__")
    groups = {
        "own": [value for name, value in cells.items() if name.startswith(own)],
        "data": [value for name, value in cells.items() if not name.startswith(own)],
    }
    return {
        group: {key: float(np.mean([one[key] for one in found])) for key in found[0]}
        | {"worst rho": min(one["rho"] for one in found)}
        for group, found in groups.items()
        if found
    }


def arguments(description: str | None) -> argparse.ArgumentParser:
    """Return what every record is asked: data, output, working folder, cells, or a table."""
    parser = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--work", type=Path, default=Path("out/records"))
    parser.add_argument("--only", default="", help="cells whose name contains this")
    parser.add_argument("--table", type=Path, help="print the tables of a record, and do no more")
    return parser


@dataclass(frozen=True)
class Label:
    """A row of a record, by its label."""

    label: str


@dataclass(frozen=True)
class Recorded(NamedAfterCell):
    """A cell of a record.

    Attributes:
        cell: object and light.
        rows: what is measured on it.
        prepare: loads the cell, and returns what measures a row, given its label.
    """

    cell: Cell
    rows: Sequence[Label]
    prepare: Callable[[Cell], Callable[[str], dict[str, Any]]]

    def settings(self, row: Label | None) -> Any:
        return str(self.cell.scene), self.cell.defines, row and row.label

    def head(self) -> dict[str, Any]:
        """Return the name of the cell."""
        return {"name": self.name}

    def measure(self, row: Label) -> dict[str, Any]:
        """Return the figures of a row."""
        return self._figures(row.label)

    @cached_property
    def _figures(self) -> Callable[[str], dict[str, Any]]:
        return self.prepare(self.cell)


def alone(
    judge: Callable[[Cell, Path], dict[str, Any]], asked: argparse.Namespace
) -> Callable[[Cell], Callable[[str], dict[str, Any]]]:
    """Return what prepares a record with one row: all that ``judge`` says of a cell."""
    return lambda cell: lambda _: judge(cell, asked.work)


WHOLE = "cell"  # the row of a record that has one


def run(
    name: str, cells: Sequence[Cell], asked: argparse.Namespace,
    prepare: Callable[[Cell], Callable[[str], dict[str, Any]]], rows: Sequence[str] = (WHOLE,),
) -> dict[str, Any]:  # fmt: skip
    """Measure the cells that are asked for; what this version has finished is kept.

    Args:
        name: of the record.
        cells: objects x lights.
        asked: what ``arguments`` reads.
        prepare: see ``Recorded``.
        rows: labels.

    Returns:
        By name of the cell, the figures by label; without ``rows``, the figures alone.
    """
    labels = [Label(row) for row in rows]
    chosen = (Recorded(cell, labels, prepare) for cell in cells if asked.only in cell.name)
    here = Path(__file__).parent
    code = here, here.parent / "studies"
    bench = Bench(asked.work, progress=Progress(Console()), code=code)
    found = Experiment(name, chosen, whole=True).run(bench)
    measured = {cell["name"]: cell["rows"] for cell in found["cells"]}
    if tuple(rows) == (WHOLE,):
        return {cell: figures[WHOLE] for cell, figures in measured.items()}
    return measured


def some_cells(data: Path | None, work: Path, own: list[str], theirs: list[str]) -> list[Cell]:
    """Return our own objects under some lights, then those of DATA under others."""
    others = data_cells(data, work, OBJECTS, theirs) if data else ()
    return [*own_cells(lights=own), *others]


def rendered(cell: Any, folder: Path, film: int, views: int, spp: int) -> Any:
    """Return a capture of square photographs from all around a cell; rendered once."""
    if not (folder / "capture.json").exists():
        svu.render_capture(
            cell.scene, spp, 0, folder=folder, views=views, resolution=(film, film),
            defines=cell.defines,
        )  # fmt: skip
    return svu.load_capture(folder)


def groups(cells: dict[str, Any]) -> dict[str, list[Any]]:
    """Return the records of cells by name as those of our own, and of DATA; no empty group."""
    found: dict[str, list[Any]] = {"own": [], "DATA": []}
    for name, cell in cells.items():
        found["own" if name.split("__")[0] in OWN_OBJECTS else "DATA"].append(cell)
    return {name: chosen for name, chosen in found.items() if chosen}


def read(file: Path | None) -> dict[str, Any]:
    """Return a record to fill: what is in the file, if it is there, under today's commit."""
    before = json.loads(file.read_text()) if file is not None and file.exists() else {}
    return {**before, "commit": commit(), "date": str(date.today()), "photographs": PHOTOGRAPHS}


def commit() -> str:
    """Return the commit that is recorded."""
    asked = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


def save(file: Path | None, record: dict[str, Any]) -> None:
    """Write the record, if it has a file; figures to four digits."""
    if file is None:
        return
    digits = json.loads(json.dumps(record), parse_float=lambda text: round(float(text), 4))
    file.write_text(json.dumps(digits, indent=1) + "\n")


if __name__ == "__main__":
    main()
