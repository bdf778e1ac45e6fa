"""Table 2 of the paper: textures from photographs mostly from one side, and their entropy.

    python tests/records/table2.py --data DATA -o table2.json [--work FOLDER]
    python tests/records/table2.py --table table2.json

9 cells of our own (vase, knot and spheres under three lights) and 6 x 3 of DATA: 24 photographs
of 96 x 96 with 32 samples, 20 of them from one side, 96 x 96 texels, direct light. Rows are the
paper's as printed (presets ``paper`` and ``spectrum``) and ours. Beside the PSNR of textures over
texels that a photograph shows:

* Pearson's correlation of a texel's mean absolute error with its entropy: the paper's textures
  with the paper's entropy (power spectra), ours with ours;
* Fig. 8: the mean absolute error of the most and of the least certain texels, by the paper's
  entropy, for masks of 10 to 90 % of the surface.

Finished rows of the same version are kept; so are photographs. Takes about an hour on two cores,
most of it path tracing (``--untraced`` leaves that out: 10 minutes).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import record as records

import svu_mi as svu  # before Mitsuba: it chooses LLVM

import mitsuba as mi  # isort: skip

from studies.captures import uneven_views

FILM, DENSE, FRONT, BACK, TEXELS, SPP = 96, 48, 20, 4, 96, 32
OWN_LIGHTS = ["window", "studio", "overcast"]
LIGHTS = ["photo_studio_01", "rural_asphalt_road", "st_fagans_interior"]
PARTS = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]


def photographs(cell: Any, work: Path) -> Any:
    """Return a cell's photographs from one side mostly; rendered once."""
    folder = work / f"{cell.name}_{FILM}_of_{DENSE}"
    return uneven_views(records.rendered(cell, folder, FILM, DENSE, SPP), FRONT, BACK)


class Judge:
    """A capture, its truth, and the entropies that errors are held against."""

    def __init__(self, capture: Any) -> None:
        from svu_mi import metrics
        from svu_mi.parameters import NAMES

        self.capture, self.grid = capture, svu.texels(capture.mesh, TEXELS)
        ours = svu.estimate(capture, self.grid)
        paper = svu.estimate(ours, method="spectrum", preset="paper")
        self.seen = np.array(ours.coverage) > 0
        known = metrics.ground_truth(capture, self.grid)
        self.truth = {name: getattr(known, name)[self.seen] for name in NAMES}
        self.entropy = {
            name: np.array(one.entropy, np.float64)[self.seen]
            for name, one in (("paper", paper), ("ours", ours))
        }

    def judge(self, row: Any) -> dict[str, Any]:
        """Recover textures in one way, and compare them with the true ones."""
        import drjit as dr

        from svu_mi import metrics

        dr.sync_thread()
        start = time.perf_counter()
        textures = row.recover(self.capture, self.grid).textures
        dr.sync_thread()
        seconds = time.perf_counter() - start
        found = {name: textures.at(self.grid, name)[self.seen] for name in self.truth}
        error = metrics.texel_error(found, self.truth)
        own = self.entropy["paper" if "(paper)" in row.label else "ours"]
        return {
            "seconds": seconds, "psnr": metrics.texture_psnr(found, self.truth),
            "correlation": metrics.pearson(error, own),
            "certain": masked(error, np.argsort(self.entropy["paper"], kind="stable")),
            "uncertain": masked(error, np.argsort(-self.entropy["paper"], kind="stable")),
        }  # fmt: skip


def masked(error: np.ndarray, order: np.ndarray) -> list[float]:
    """Return mean errors over the first of the texels, by part of their number."""
    return [float(error[order[: max(int(part * len(order)), 1)]].mean()) for part in PARTS]


def rows(traced: bool) -> list[Any]:
    """Return the ways of recovery, the paper's first."""
    from svu_mi.bench.recovery.rows import OURS, PAPER, PATH_SHARING

    ours = [row for row in OURS if row is not PATH_SHARING]  # BENCHMARKS, "Textures"
    return [row for row in (*PAPER, *ours) if traced or not row.traced]


def tables(record: dict[str, Any]) -> str:
    """Return Table 2 of both groups, and the errors of Fig. 8, as Markdown."""
    parts = []
    for group, cells in records.groups(record["cells"]).items():
        labels = [label for label in cells[0] if all(label in cell for cell in cells)]
        lines = [f"{len(cells)} cells, {group}", "",
                 "| recovery | base colour | roughness | metallic | average | error with entropy | "
                 "seconds |", "| --- |" + " --- |" * 6]  # fmt: skip
        for label in labels:
            found = [cell[label] for cell in cells]
            names = ("base_color", "roughness", "metallic", "average")
            values = [f"{np.mean([one['psnr'][name] for one in found]):.2f}" for name in names]
            values += [f"{np.mean([one['correlation'] for one in found]):.2f}",
                       f"{np.median([one['seconds'] for one in found]):.1f}"]  # fmt: skip
            lines.append(f"| {label} | {' | '.join(values)} |")
        lines += ["", "| part of the texels | " + " | ".join(f"{p:.0%}" for p in PARTS) + " |",
                  "| --- |" + " --- |" * len(PARTS)]  # fmt: skip
        for label in labels:
            for kind in ("certain", "uncertain"):
                means = np.mean([cell[label][kind] for cell in cells], axis=0)
                lines.append(f"| {label}, most {kind} | "
                             + " | ".join(f"{value:.3f}" for value in means) + " |")  # fmt: skip
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def parser() -> argparse.ArgumentParser:
    """Return what this record is asked."""
    found = records.arguments(__doc__)
    found.add_argument("--untraced", action="store_true", help="leave path tracing out")
    return found


def main() -> None:
    """Record all cells; finished rows of the same version are kept."""
    asked = parser().parse_args()
    if asked.table:
        print(tables(json.loads(asked.table.read_text())))
        return
    mi.set_variant("llvm_ad_rgb")
    ways = {row.label: row for row in rows(not asked.untraced)}

    def prepare(cell: Any) -> Callable[[str], dict[str, Any]]:
        judge = Judge(photographs(cell, asked.work))
        return lambda label: judge.judge(ways[label])

    record = records.read(asked.output)
    record["cells"] = records.run(
        "table2", records.some_cells(asked.data, asked.work, OWN_LIGHTS, LIGHTS), asked,
        prepare, list(ways),
    )  # fmt: skip
    records.save(asked.output, record)
    print(tables(record))


if __name__ == "__main__":
    main()
