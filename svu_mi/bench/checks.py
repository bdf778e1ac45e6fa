"""What the comparison itself takes for granted: direct light alone, and the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from svu_mi import metrics
from svu_mi.bench.accuracy import Bench, run_warm
from svu_mi.bench.cells import Cell
from svu_mi.bench.store import Store
from svu_mi.bench.variants import Variant
from svu_mi.surface import texels

DEPTH = 4  # of the reference with light between parts of the object
PHOTOGRAPHS = 6  # depth of the photographs it is compared on

Record = dict[str, Any]


def run_checks(bench: Bench, cells: Sequence[Cell], variants: Sequence[Variant]) -> list[Record]:
    """Check the first cell of every object; finished ones are taken from disk.

    Args:
        bench: where and how.
        cells: objects x lights.
        variants: the main ones are checked.
    """
    main = [v for v in variants if v.main]
    first = {cell.object: cell for cell in reversed(cells)}
    chosen = list(first.values())[::-1][: bench.sizes.checked]
    store, found = Store(bench.folder / "checks"), []
    for cell in chosen:
        compute = partial(check, bench, cell, main)
        key = bench.key(cell, main)
        found.append(store.recall(cell.name, key, compute, fresh=bench.fresh))
    return found


def check(bench: Bench, cell: Cell, variants: Sequence[Variant]) -> Record:
    """Compare estimators with references of other light paths and of other noise.

    Every psi has to be rendered where light goes between parts of the object, so this is done
    for a few texels.

    Returns:
        ``cell``; ``references``: their correlation with each other; ``estimators``: Pearson's
        rho by label and by case:

        * ``direct``: photographs and reference of direct light;
        * ``photographs``: photographs with all light, reference of direct light;
        * ``both``: photographs and reference with all light;
        * ``heteroscedastic``: direct light, reference with noise that grows with radiance;
        * ``estimated``: direct light, reference whose noise is estimated, as ``default`` does.
    """
    lit = replace(cell, defines={**cell.defines, "max_depth": str(PHOTOGRAPHS)})
    direct, full = bench.capture(cell), bench.capture(lit, name="capture_all_light")
    grid = texels(direct.mesh, bench.sizes.texels)
    asked: Record = {
        "subset": bench.sizes.brute_texels, "spp": bench.sizes.brute_spp
    }  # fmt: skip
    with bench.progress.stage(f"Tracing references of {cell.title}"):
        plain = bench.reference(direct, grid, **asked)
        subset = {**asked, "subset": plain.subset}
        cases = {
            "direct": (direct, plain),
            "photographs": (full, bench.reference(full, grid, **subset)),
            "both": (full, bench.reference(full, grid, method="brute", max_depth=DEPTH, **subset)),
            **{
                noise: (direct, bench.reference(direct, grid, noise=noise, **subset))
                for noise in ("heteroscedastic", "estimated")
            },
        }
    estimators: dict[str, Record] = {v.label: {} for v in variants}
    with bench.progress.stage(f"Checking {cell.title}"):
        for variant in variants:
            entropies = {
                id(capture): np.array(run_warm(capture, grid, variant).result.entropy, float)
                for capture in (direct, full)
            }
            for name, (capture, reference) in cases.items():
                seen = reference.posterior.observed
                estimators[variant.label][name] = metrics.pearson(
                    entropies[id(capture)][reference.subset[seen]], reference.entropy[seen]
                )
    kept = cases["photographs"][1].posterior.observed & cases["both"][1].posterior.observed
    one, other = (cases[name][1].entropy[kept] for name in ("photographs", "both"))
    return {
        "cell": cell.title,
        "texels": int(kept.sum()),
        "references": metrics.pearson(one, other),
        "mean_entropy": {name: float(r.entropy.mean()) for name, (_, r) in cases.items()},
        "estimators": estimators,
    }
