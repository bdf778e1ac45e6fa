"""Measure whether the posterior is calibrated, for the tables of BENCHMARKS.md.

    python tests/records/calibration.py --data DATA -o FILE.json [--work FOLDER]
    python tests/records/calibration.py --table FILE.json

For every cell of record.py (6 x 4 of DATA, 12 of our own; 60 photographs of 256 x 256, 32 samples
per pixel) the preset `default` is held against the true textures, over 1500 texels that some view
sees (seed 0), the truth being the mean of the texture over the texel:

* how often sets of 90 and 50 % hold the truth: by mass, on the cells of the grid, the last cell
  counted by the part of it that reaches the level; and intervals as `.interval` returns them;
* how well predicted errors go with true ones: root of the summed variances against root of the
  summed squared errors of the three parameters; area under the sparsification error, relative
  (0 perfect, 1 chance);
* CRPS of every parameter, over that of tau = 3; PSNR of the means;
* of the texels whose 90 % interval is at most .05 to either side, how many hold the truth;
* with `--reference N`: correlation of entropy with N texels that are path traced with the same
  likelihood.

Then `--footprints`: the same paths on films of 256, 512 and 1024 pixels (king and bottle, two
lights, 192 x 192 texels); `--switches`: our own scenes with single switches changed.
About 5 minutes on two cores when the photographs are there; references take 20 s each.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import record
from scipy.stats import pearsonr, spearmanr

import svu_mi as svu  # first: it chooses LLVM

import mitsuba as mi  # isort: skip

from svu_mi.bench.cells import OWN_OBJECTS

NAMES = ("roughness", "metallic", "base_color")
SETTLED = 0.05
SWITCHES: dict[str, dict[str, Any]] = {
    "default": {},
    "tau 1": {"overdispersion": 1.0},
    "tau 3": {"overdispersion": 3.0},
    "tau 5": {"overdispersion": 5.0},
    "tau 10": {"overdispersion": 10.0},
    "edges count like others": {"edges": 0.0},
    "edges 20": {"edges": 20.0},
    "edges 200": {"edges": 200.0},
    "metallic uniform": {"metals": 0.0},
    "nu 1": {"degrees": 1.0},
    "nu 16": {"degrees": 16.0},
    "knee 1": {"knee": 1.0, "edges": 240.0},
    "12 levels": {"levels": 12},
    "28 parts": {"parts": 28},
    "84 parts": {"parts": 84},
    "grey": {"channels": "grey"},
    "no traced light": {"cells": 0},
}
FILMS = ((256, 128), (512, 32), (1024, 8))
SHOWN = {
    "90 r": "90 % sets: r", "90 m": "m", "90 c": "c", "90 rm": "r, m", "50 r": "50 %: r",
    "50 m": "m", "50 c": "c", "50 rm": "r, m", "pearson": "Pearson", "spearman": "Spearman",
    "ause r": "AUSE r", "ause m": "m", "ause c": "c", "psnr r": "PSNR r", "psnr m": "m",
    "psnr c": "c",
}  # fmt: skip


def parser() -> argparse.ArgumentParser:
    """Return what this record is asked."""
    found = record.arguments(__doc__)
    found.add_argument("--objects", nargs="*", default=[], help="others of DATA than usual")
    found.add_argument("--reference", type=int, default=0, help="texels to path trace")
    found.add_argument("--footprints", action="store_true")
    found.add_argument("--switches", action="store_true")
    return found


def main() -> None:
    """Measure what is asked for, and keep it; or print tables."""
    asked = parser().parse_args()
    if asked.table:
        print(tables(json.loads(asked.table.read_text())))
        return
    mi.set_variant("llvm_ad_rgb")
    kept = record.read(asked.output)
    cells = record.cells_of(asked.data, asked.work, asked.objects)
    if asked.footprints:
        measure, part = footprints, "footprints"
        cells = [cell for cell in cells if cell.object in ("chess_king_black", "water_bottle")
                 and cell.light in ("rural_asphalt_road", "st_fagans_interior")]  # fmt: skip
    elif asked.switches:
        measure, part = switched, "switches"
        cells = [cell for cell in cells if cell.object in OWN_OBJECTS]
    elif asked.reference:
        measure, part = traced(asked.reference), "traced"
    else:
        measure, part = calibration, "cells"
    found = record.run(f"calibration_{part}", cells, asked, record.alone(measure, asked))
    record.save(asked.output, {**kept, part: {**kept.get(part, {}), **found}})


def setting(cell: Any, work: Path) -> tuple[Any, Any, dict[str, np.ndarray], np.ndarray]:
    """Return what was observed, texels, true means, and the texels that are judged."""
    from svu_mi.observed import observe

    capture = svu.load_capture(record.photographs(cell, work, record.PHOTOGRAPHS["film"]))
    layout = svu.texels(capture.mesh, record.TEXELS)
    observed = observe(capture, layout)
    seen = np.flatnonzero(observed.coverage)
    number = min(record.JUDGED, len(seen))
    chosen = np.sort(np.random.default_rng(0).choice(seen, number, replace=False))
    return observed, layout, record.true_means(capture, layout, work / f"{cell.object}.npz"), chosen


def calibration(cell: Any, work: Path) -> dict[str, float]:
    """Return all figures of a cell."""
    observed, _, truth, chosen = setting(cell, work)
    true = {name: truth[name][chosen] for name in NAMES}
    found = figures(svu.estimate(observed).posterior, true, chosen)
    three = svu.preset("default", method="angular", overdispersion=3.0)
    other = figures(svu.estimate(observed, preset=three).posterior, true, chosen)
    return found | {f"{key} at tau 3": x for key, x in other.items() if key.startswith("crps")}


def switched(cell: Any, work: Path) -> dict[str, dict[str, float]]:
    """Return the figures of a cell with single switches changed."""
    observed, _, truth, chosen = setting(cell, work)
    true = {name: truth[name][chosen] for name in NAMES}
    return {
        title: figures(
            svu.estimate(
                observed, preset=svu.preset("default", method="angular", **changed)
            ).posterior, true, chosen,
        )
        for title, changed in SWITCHES.items()
    }  # fmt: skip


def traced(count: int) -> Any:
    """Return what correlates the entropy with that of path-traced texels."""

    def measure(cell: Any, work: Path) -> dict[str, float]:
        observed, *_ = setting(cell, work)
        reference = svu.reference_posterior(observed, None, count, 256, noise="estimated")
        seen = reference.coverage > 0
        own = np.array(svu.estimate(observed).entropy, np.float64)[reference.subset][seen]
        return {
            "rho": float(np.corrcoef(own, reference.entropy[seen])[0, 1]),
            "halves": reference.split_half().correlation,
        }

    return measure


def footprints(cell: Any, work: Path) -> dict[str, Any]:
    """Return PSNR of the means by film, and how well entropies agree with those of 512."""
    result: dict[str, Any] = {}
    entropies = {}
    for film, spp in FILMS:
        folder = work / f"{cell.name}_f{film}_{spp}"
        if not (folder / "capture.json").exists():
            svu.render_capture(
                cell.scene, spp, 0, folder=folder, views=60, resolution=(film, film),
                defines=cell.defines,
            )  # fmt: skip
        capture = svu.load_capture(folder)
        layout = svu.texels(capture.mesh, 192)
        found = svu.estimate(capture, layout)
        seen = np.flatnonzero(found.coverage)
        number = min(record.JUDGED, len(seen))
        chosen = np.sort(np.random.default_rng(0).choice(seen, number, replace=False))
        truth = fine_means(capture, layout)
        result[str(film)] = {
            name: decibels(np.array(found.posterior.mean(name))[chosen] - truth[name][chosen])
            for name in NAMES
        }
        entropies[film] = np.array(found.entropy)
    for film in (256, 1024):
        both = (entropies[film] < 1) & (entropies[512] < 1)
        rho = np.corrcoef(entropies[film][both], entropies[512][both])[0, 1]
        result[f"rho of {film} and 512"] = float(rho)
    return result


def fine_means(capture: Any, layout: Any) -> dict[str, np.ndarray]:
    """Return the true means over the texels of a grid of another size than the records'."""
    usual = record.TEXELS
    record.TEXELS = layout.resolution[0]
    try:
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            return record.true_means(capture, layout, Path(folder) / "truth.npz")
    finally:
        record.TEXELS = usual


def decibels(error: np.ndarray) -> float:
    """PSNR of errors of parameters in [0, 1]."""
    return float(-10 * np.log10(np.mean(error**2)))


def figures(posterior: Any, truth: dict[str, np.ndarray], chosen: np.ndarray) -> dict[str, float]:
    """Return everything that is measured of a posterior.

    Args:
        posterior: of T texels.
        truth: (t,) or (t, 3) by parameter.
        chosen: (t,) texels.
    """
    from svu_mi.metrics import sparsification

    colors = {name: truth[name] for name in NAMES}
    if posterior.groups == 1:
        colors["base_color"] = colors["base_color"].mean(axis=1)
    truth = colors
    result = sets(posterior, truth, chosen)
    errors, variances = [], []
    for name in NAMES:
        key, true = name.replace("base_", "")[0], columns(truth[name])
        mean, sd = (columns(np.array(x(name), np.float64)[chosen])
                    for x in (posterior.mean, posterior.sd))  # fmt: skip
        low, high = (columns(np.array(end)) for end in posterior.interval(name, 0.9, chosen))
        inside = (true >= low - 1e-6) & (true <= high + 1e-6)
        settled = (high - low) / 2 <= SETTLED
        error, variance = ((mean - true) ** 2).mean(axis=1), (sd**2).mean(axis=1)
        errors.append(error)
        variances.append(variance)
        result |= {
            f"interval {key}": float(inside.mean()), f"settled {key}": float(settled.mean()),
            f"settled {key} holds": float(inside[settled].mean()) if settled.any() else 1.0,
            f"psnr {key}": decibels(mean - true),
            f"ause {key}": sparsification(np.sqrt(error), np.sqrt(variance)).relative,
            f"crps {key}": crps(posterior, name, true, chosen),
        }  # fmt: skip
    error, said = np.sqrt(np.sum(errors, axis=0)), np.sqrt(np.sum(variances, axis=0))
    return result | {"pearson": float(pearsonr(error, said)[0]),
                     "spearman": float(spearmanr(error, said)[0])}  # fmt: skip


def columns(values: np.ndarray) -> np.ndarray:
    """(t,) or (t, g) as (t, g)."""
    return values if values.ndim == 2 else values[:, None]


def sets(
    posterior: Any, truth: dict[str, np.ndarray], chosen: np.ndarray
) -> dict[str, float]:
    """Return how often sets by mass hold the truth, the last cell counted in part."""
    from svu_mi.metrics import credible_coverage, nearest_cells

    p = np.array(posterior.probabilities_of(chosen), np.float64)
    p = p if p.ndim == 5 else p[..., None]
    nodes = dict.fromkeys(NAMES, np.arange(8) / 7)
    cells = {
        name: np.stack(
            [nearest_cells({name: nodes[name]}, {name: x}) for x in columns(truth[name]).T], axis=1
        )
        for name in NAMES
    }
    joint = p[..., 0].sum(axis=3).reshape(len(p), 64)
    result = {}
    for level in (0.9, 0.5):
        key = f"{100 * level:.0f}"
        of = {
            "r": credible_coverage(p[..., 0].sum(axis=(2, 3)), cells["roughness"][:, 0], level),
            "m": credible_coverage(p[..., 0].sum(axis=(1, 3)), cells["metallic"][:, 0], level),
            "rm": credible_coverage(
                joint, 8 * cells["roughness"][:, 0] + cells["metallic"][:, 0], level
            ),
        }
        result |= {f"{key} {name}": found.fractional for name, found in of.items()}
        channels = zip(np.moveaxis(p.sum(axis=(1, 2)), 2, 0), cells["base_color"].T, strict=True)
        found = [credible_coverage(q, own, level).fractional for q, own in channels]
        result[f"{key} c"] = float(np.mean(found))
    return result


def crps(posterior: Any, name: str, true: np.ndarray, chosen: np.ndarray) -> float:
    """Return the mean of the integral of (F(x) - [x >= truth])^2 over [0, 1], F from the masses
    of fine parts."""
    tables, parts = fine_masses(posterior, name, chosen)
    x = (np.arange(1000) + 0.5) / 1000
    k = np.minimum(np.searchsorted(parts.high, x), parts.count - 1)
    width = parts.high[k] - parts.low[k]
    share = np.where(width > 0, (x - parts.low[k]) / np.where(width > 0, width, 1), 1)
    total = []
    for table, y in zip(tables, true.T, strict=True):
        below = np.concatenate([0 * table[:1], np.cumsum(table / table.sum(axis=0), axis=0)])
        F = below[k] + share[:, None] * (below[k + 1] - below[k])
        total.append(np.mean((F - (x[:, None] >= y)) ** 2))
    return float(np.mean(total))


def fine_masses(posterior: Any, name: str, chosen: np.ndarray) -> tuple[list[np.ndarray], Any]:
    """Return the masses (N, t) of fine parts, by channel, and the parts."""
    from svu_mi.posterior.calibrated_kernel import color_masses
    from svu_mi.posterior.nodes import COLOR_PARTS, uniform_axis
    from svu_mi.statistics.blocks import rows_of

    lanes, problem = posterior._lane[chosen], posterior.problem
    if name == "base_color":
        parts = uniform_axis(posterior.axes[name], COLOR_PARTS)
        tables = color_masses(problem, parts, lanes)
        found = [rows_of(table, parts.count, len(lanes)) for table in tables]
    else:
        parts, table = problem.axis(name), posterior._summary_of_lanes.masses(problem, name)
        found = [rows_of(table, parts.count, problem.factors.count)[:, lanes]]
    return [x.astype(np.float64) for x in found], parts


def tables(kept: dict[str, Any]) -> str:
    """Return the tables of BENCHMARKS.md as Markdown."""
    found, lines = kept["cells"], [f"commit {kept['commit']}, {kept['date']}", ""]
    groups = {
        "own": [x for n, x in found.items() if n.startswith(("vase", "knot", "spheres"))],
        "DATA": [x for n, x in found.items() if not n.startswith(("vase", "knot", "spheres"))],
        "all": list(found.values()),
    }
    heads = ["object / light", *SHOWN.values()]
    lines += [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    for title, cells in groups.items():
        if cells:
            means = {k: np.mean([x[k] for x in cells]) for k in cells[0]}
            worst = {k: np.min([x[k] for x in cells]) for k in cells[0]}
            lines += [row(f"**mean of {len(cells)}, {title}**", means), row("lowest", worst)]
    lines += [row(name.replace("__", " / "), x) for name, x in found.items()] + [""]
    for title, cells in groups.items():
        if not cells:
            continue
        means = {k: float(np.mean([x[k] for x in cells])) for k in cells[0]}
        ratio = {k: means[f"crps {k}"] / means[f"crps {k} at tau 3"] for k in "rmc"}
        lines.append(f"{title}: CRPS " + ", ".join(
            f"{k} {means[f'crps {k}']:.4f} ({ratio[k]:.3f} of tau 3)" for k in "rmc"))
        lines.append(f"{title}: intervals hold " + ", ".join(
            f"{k} {means[f'interval {k}']:.2f}" for k in "rmc") + "; settled " + ", ".join(
            f"{k} {means[f'settled {k}']:.2f} holds {means[f'settled {k} holds']:.2f}"
            for k in "rmc"))
    for part in ("traced", "footprints"):
        lines += ["", part] + [f"{name}: {x}" for name, x in kept.get(part, {}).items()]
    for title in SWITCHES if kept.get("switches") else ():
        cells = [x[title] for x in kept["switches"].values()]
        lines.append(row(title, {k: float(np.mean([x[k] for x in cells])) for k in cells[0]}))
    return "\n".join(lines)


def row(title: str, x: dict[str, float]) -> str:
    """Return a line of the table."""
    cells = [f"{x[k]:.1f}" if k.startswith("psnr") else f"{x[k]:.2f}" for k in SHOWN]
    return f"| {title} | {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
