"""Table 3 of the paper: does the entropy agree with that of a path tracer?

    python tests/records/table3.py --data DATA -o table3.json [--work FOLDER]
    python tests/records/table3.py --table table3.json

Pearson's correlation of entropies over 400 texels (64 paths per ray, direct light, 8 x 8 x 8
parameters) for 12 cells of our own and 6 x 4 of DATA:

* the rows of the paper: the SH model (Eq. 6), evaluated in angle, and power spectra (Eq. 11), both
  as printed; the reference's d is the *sum* over views as well (sigma .4 of the mean radiance);
* the same over open texels alone, which lose less than 3 % of their irradiance to the object;
* what other readings change, and what is between the SH model and ours: light that is known in all
  directions, GGX lobes with their own Fresnel term, cells of the light, occlusion;
* ours, whose reference has the mean over views (sigma .08).

Photographs and references are kept in the working folder. Takes about 15 minutes on two cores, the
second time 4.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import record as records

import svu_mi as svu  # before Mitsuba: it chooses LLVM

import mitsuba as mi  # isort: skip

TEXELS, REFERENCE, SPP = 256, 400, 64
OPEN, LOSES = ("SH model (paper)", "spectrum (paper)", "fixed, sum over views"), 0.97
SUM, MEAN = 0.4, 0.08  # sigma, as parts of the mean radiance


def rows() -> dict[str, tuple[str, Any, str]]:
    """Return (method, preset, which reference) by label."""
    from svu_mi.options import Fit

    def angular(**switches: Any) -> Any:
        return svu.preset("paper", method="angular", **switches)

    def ours(**switches: Any) -> Any:
        return svu.preset("fixed", method="angular", errors="sum", sigma=SUM, **switches)

    mean = {"errors": "mean", "sigma": MEAN}
    return {
        "SH model (paper)": ("angular", angular(), "sum"),
        "spectrum (paper)": ("spectrum", svu.preset("paper"), "sum"),
        "spectrum (paper), relative noise": (
            "spectrum", svu.preset("paper", noise="relative", sigma=0.02), "sum"),
        "SH model, mean over views": ("angular", angular(**mean), "mean"),
        "SH model, band-limit undone": ("angular", angular(fit=Fit(undo_prefilter=True)), "sum"),
        "SH model, degree 5": ("angular", angular(fit=Fit(degree=5)), "sum"),
        "SH model, degree 9": ("angular", angular(fit=Fit(degree=9)), "sum"),
        "SH model, lambda 1e-2": ("angular", angular(fit=Fit(regularizer=1e-2)), "sum"),
        "SH model, constant free": ("angular", angular(fit=Fit(penalize_constant=False)), "sum"),
        "its lobes, light known everywhere": ("angular", angular(fit=None), "sum"),
        "GGX lobes, light known everywhere": ("angular", ours(cells=0), "sum"),
        "cells of the light, nothing occluded": ("angular", ours(occluded=False), "sum"),
        "fixed, sum over views": ("angular", ours(), "sum"),
        "fixed": ("angular", svu.preset("fixed", method="angular"), "mean"),
        "spectrum (ours)": ("spectrum", svu.preset("default"), "mean"),
    }  # fmt: skip


def references(capture: Any, layout: Any, file: Path) -> dict[str, np.ndarray]:
    """Return texels, entropies of both references and of their halves, and simple maps; kept."""
    from svu_mi.posterior import TabulatedPosterior

    if not file.exists():
        found = svu.reference_posterior(
            capture, layout, REFERENCE, SPP, sigma=SUM, errors="sum"
        )
        seen = found.coverage > 0
        kept = {"subset": found.subset[seen], "views": found.coverage[seen],
                "brightness": found.brightness[seen]}  # fmt: skip
        for name, tables in (
            ("sum", found.traced.tables * found.coverage[:, None, None, None]),
            ("mean", found.traced.tables * (SUM / MEAN) ** 2),
        ):
            grid = found.posterior.grid
            for part, table in zip(("", " 1", " 2"), tables, strict=True):
                p = TabulatedPosterior(energies=table, grid=grid, observed=seen)
                kept[name + part] = np.array(p.entropy(), np.float64)[seen]
        np.savez(file, **kept)
    with np.load(file) as kept:
        return dict(kept)


def judge(cell: Any, work: Path) -> dict[str, float]:
    """Return the correlations of one cell, by row."""
    capture = svu.load_capture(records.photographs(cell, work, records.PHOTOGRAPHS["film"]))
    layout = svu.texels(capture.mesh, TEXELS)
    known = references(capture, layout, work / f"{cell.name}_table3.npz")
    seen, result = svu.estimate(capture, layout, "spectrum", "paper"), {}
    free = open_texels(seen)[known["subset"]]
    result["open texels, part"] = float(free.mean())
    for label, (method, preset, which) in rows().items():
        H = np.array(svu.estimate(seen, method=method, preset=preset).entropy, np.float64)
        result[label] = correlation(H[known["subset"]], known[which])
        if label in OPEN:
            result[f"{label}, open texels"] = correlation(
                H[known["subset"]][free], known[which][free])  # fmt: skip
    for which in ("sum", "mean"):
        result[f"reference's halves ({which})"] = correlation(
            known[f"{which} 1"], known[f"{which} 2"])  # fmt: skip
        for name in ("views", "brightness"):
            result[f"{name} ({which})"] = correlation(-known[name], known[which])
        result[f"mean entropy of the reference ({which})"] = float(known[which].mean())
    return result


def open_texels(seen: Any) -> np.ndarray:
    """Return (T,) bool: texels that lose little of their irradiance to the object itself."""
    observed, result = seen.observed, np.zeros(seen.texels.count, bool)
    rules = (svu.preset("default", occluded=on) for on in (True, False))
    arrives, whole = (observed.irradiance(rule, 1)[0].numpy() for rule in rules)
    result[observed.seen] = arrives > LOSES * whole
    return result


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's; NaN if either is constant."""
    varied = np.ptp(a) > 0 and np.ptp(b) > 0
    return float(np.corrcoef(a, b)[0, 1]) if varied else float("nan")


def table(record: dict[str, Any]) -> str:
    """Return means over the cells of both groups, and the lowest of each, as Markdown."""
    groups = records.groups(record["cells"])
    head = [f"mean of {len(cells)}, {name} | lowest" for name, cells in groups.items()]
    lines = [f"| row | {' | '.join(head)} |", "| --- |" + " --- |" * (2 * len(groups))]
    for label in next(iter(record["cells"].values())):
        values = [[cell[label] for cell in cells] for cells in groups.values()]
        cells = [f"{np.mean(v):.3f} | {np.min(v):.3f}" for v in values]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Record all cells; finished ones of the same version are kept."""
    asked = records.arguments(__doc__).parse_args()
    if asked.table:
        print(table(json.loads(asked.table.read_text())))
        return
    mi.set_variant("llvm_ad_rgb")
    record, cells = records.read(asked.output), records.cells_of(asked.data, asked.work)
    record["cells"] = records.run("table3", cells, asked, records.alone(judge, asked))
    records.save(asked.output, record)
    print(table(record))


if __name__ == "__main__":
    main()
