"""Run times, warm and cold, and how they trade against agreement with the reference."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from svu_mi import metrics
from svu_mi.bench.accuracy import Bench, estimate_once, run_warm
from svu_mi.bench.captures import some_views
from svu_mi.bench.cells import Cell
from svu_mi.bench.fresh import in_new_process
from svu_mi.bench.store import Store
from svu_mi.bench.variants import Variant
from svu_mi.capture import Capture
from svu_mi.observed import observe
from svu_mi.posterior import PrincipledGrid
from svu_mi.surface import Texels, texels

DEGREES = (2, 3, 4, 5, 6, 8)
NODES = (4, 6, 8, 12, 16, 24, 32)
MAX_CELLS = 5000  # of a grid in the scaling curve
VIEWS = (10, 20, 40, 60)
SAMPLES = (2, 4, 8, 16, 32, 64, 128)
PLAIN_PSI, LINEAR_PSI = 512, 32  # of the path-traced posterior that is timed

Row = dict[str, Any]


def run_speed(bench: Bench, cell: Cell, variants: Sequence[Variant]) -> dict[str, Any]:
    """Measure one cell; every finished part is taken from disk.

    Args:
        bench: where and how.
        cell: object and light.
        variants: the main ones are timed; ``default`` and ``fixed`` of each method are scaled.

    Returns:
        ``cell``; ``estimators``: warm and cold seconds by label; ``scaling``: rows of value,
        seconds and pearson by ``degree``, ``grid``, ``views`` (each by label) and
        ``reference_spp``; ``brute``: see ``brute_force``.
    """
    main = [v for v in variants if v.main]
    scaled = [v for v in main if v.label.endswith((" default", " fixed"))]
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "estimators": lambda: time_estimators(bench, cell, main),
        "degree": lambda: {v.label: by_degree(bench, cell, v) for v in scaled},
        "grid": lambda: {v.label: by_grid(bench, cell, v) for v in scaled},
        "views": lambda: {v.label: by_views(bench, cell, v) for v in scaled},
        "reference_spp": lambda: {"reference": by_samples(bench, cell)},
        "brute": lambda: brute_force(bench, cell),
    }
    store, key = Store(bench.folder / "speed"), bench.key(cell, main)
    done = {
        name: store.recall(name, key, partial(_result, measure), fresh=bench.fresh)["result"]
        for name, measure in parts.items()
    }
    scaling = {name: done[name] for name in ("degree", "grid", "views", "reference_spp")}
    return {
        "cell": cell.title,
        "estimators": done["estimators"],
        "scaling": scaling,
        "brute": done["brute"],
    }


def _result(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    return {"result": measure()}


def time_estimators(bench: Bench, cell: Cell, variants: Sequence[Variant]) -> dict[str, Any]:
    """Return warm (median of several) and cold (one fresh process) seconds per stage."""
    sizes = bench.sizes
    capture, grid = timed_setting(bench, cell)
    folder = bench.folder / "cells" / cell.name / _timed_name(bench)
    found = {}
    for variant in variants:
        with bench.progress.stage(f"Timing {variant.label}, warm"):
            runs = [run_warm(capture, grid, variant) for _ in range(sizes.repeats)]
        with bench.progress.stage(f"Timing {variant.label}, cold"):
            cold = in_new_process(
                estimate_once, folder=str(folder), resolution=sizes.speed_texels,
                label=variant.label,
            )  # fmt: skip
        warm = {
            stage: statistics.median(run.timings[stage] for run in runs)
            for stage in runs[0].timings
        }
        found[variant.label] = {
            "warm": warm,
            "warm_seconds": statistics.median(run.seconds for run in runs),
            "repeats": len(runs),
            "cold": cold,
        }
    return {
        "variants": found,
        "views": capture.count,
        "film": sizes.speed_film,
        "texels": grid.count,
        "resolution": sizes.speed_texels,
    }


# --- scaling ------------------------------------------------------------------------------


def _points(bench: Bench, values: tuple[int, ...]) -> tuple[int, ...]:
    return values[:: bench.sizes.stride]


def by_degree(bench: Bench, cell: Cell, variant: Variant) -> list[Row]:
    """Time and agreement by highest degree l*; empty for an estimator without degrees."""
    if variant.method != "spectrum":
        return []
    changed = {
        degree: replace(variant, switches={**variant.switches, "degree": degree})
        for degree in _points(bench, DEGREES)
    }
    return _rows(bench, cell, variant, "degree", [(d, v, {}) for d, v in changed.items()])


def by_grid(bench: Bench, cell: Cell, variant: Variant) -> list[Row]:
    """Time and agreement by number of nodes per axis of the posterior's grid."""
    capture, grid, _ = _setting(bench, cell)
    shape: Any = run_warm(capture, grid, variant).result.posterior.grid
    sizes = [n for n in _points(bench, NODES) if n ** len(shape.axes) <= MAX_CELLS]
    return _rows(
        bench, cell, variant, "grid",
        [(n, variant, {"grid": replace(shape, **dict.fromkeys(shape.axes, n))}) for n in sizes],
    )  # fmt: skip


def by_views(bench: Bench, cell: Cell, variant: Variant) -> list[Row]:
    """Time and agreement by number of views, each with the reference of the same views."""
    whole, grid, _ = _setting(bench, cell)
    counts = sorted({min(count, whole.count) for count in VIEWS})
    rows = []
    for count in counts:
        with bench.progress.stage(f"{variant.label}: {count} views"):
            capture = some_views(whole, count)
            reference = bench.reference(capture, grid)
            rows.append(_row(bench, count, capture, grid, variant, reference, {}))
    return rows


def by_samples(bench: Bench, cell: Cell) -> list[Row]:
    """Time of the reference by samples per ray, and agreement with its largest number."""
    capture, grid, _ = _setting(bench, cell)
    most = bench.sizes.reference_spp
    counts = [spp for spp in _points(bench, SAMPLES) if spp < most] + [most]
    found = []
    for spp in counts:
        with bench.progress.stage(f"Reference with {spp} samples"):
            found.append(bench.reference(capture, grid, spp=spp))
    best = np.array(found[-1].entropy)
    return [
        {
            "value": spp,
            "seconds": reference.seconds,
            # The largest agrees with itself; what noise it has is seen in its two halves.
            "pearson": metrics.pearson(reference.entropy, best) if spp < counts[-1] else None,
        }
        for spp, reference in zip(counts, found, strict=True)
    ]


def _rows(
    bench: Bench,
    cell: Cell,
    variant: Variant,
    what: str,
    points: Sequence[tuple[int, Variant, dict[str, Any]]],
) -> list[Row]:
    capture, grid, reference = _setting(bench, cell)
    rows = []
    for value, changed, options in points:
        with bench.progress.stage(f"{variant.label}: {what} {value}"):
            rows.append(_row(bench, value, capture, grid, changed, reference, options))
    return rows


def _row(
    bench: Bench,
    value: int,
    capture: Capture,
    grid: Texels,
    variant: Variant,
    reference: Any,
    options: dict[str, Any],
) -> Row:
    # Half as many as for the table of run times: there are many points.
    repeats = range((bench.sizes.repeats + 1) // 2)
    runs = [run_warm(capture, grid, variant, **options) for _ in repeats]
    seen = np.array(reference.coverage) > 0
    entropy = np.array(runs[0].result.entropy)[np.array(reference.subset)[seen]]
    return {
        "value": value,
        "seconds": statistics.median(run.seconds for run in runs),
        "pearson": metrics.pearson(entropy, np.array(reference.entropy)[seen]),
    }


def _setting(bench: Bench, cell: Cell) -> tuple[Capture, Texels, Any]:
    capture = bench.capture(cell)
    grid = texels(capture.mesh, bench.sizes.texels)
    return capture, grid, bench.reference(capture, grid)


def brute_force(bench: Bench, cell: Cell) -> dict[str, Any]:
    """Extrapolate the time of the path-traced posterior of all texels from a sample.

    seconds = (texel, view) pairs x psi x spp / (rays per second), where a ray is one camera
    path, the pairs are those visible, and psi are the 512 of the grid, or the 32 that are
    enough for direct light. The rate is that of the reference's texels with the full number of
    samples, 8 psi, kernels compiled before: larger batches are not faster.
    """
    capture, grid = timed_setting(bench, cell)
    few, spp = PrincipledGrid(2, 2, 2), bench.sizes.reference_spp
    with bench.progress.stage("Tracing all psi"):
        for seed in range(2):  # the first compiles
            sample = bench.reference(
                capture, grid, method="brute", spp=spp, grid=few, seed=seed, cache=None
            )
    pairs = int(observe(capture, grid).coverage.sum(dtype=np.int64))
    rate = sample.rays / sample.seconds
    return {
        "sample_rays": sample.rays,
        "sample_seconds": sample.seconds,
        "rays_per_second": rate,
        "pairs": pairs,
        "psi": PLAIN_PSI,
        "spp": spp,
        "seconds": pairs * PLAIN_PSI * spp / rate,
        "linear_seconds": pairs * LINEAR_PSI * spp / rate,
    }


def timed_setting(bench: Bench, cell: Cell) -> tuple[Capture, Texels]:
    """Return the capture and the texels that run times are measured on."""
    size = bench.sizes.speed_film
    sizes = replace(bench.sizes, film=size)
    capture = bench.capture(cell, sizes, _timed_name(bench))
    return capture, texels(capture.mesh, bench.sizes.speed_texels)


def _timed_name(bench: Bench) -> str:
    size = bench.sizes.speed_film
    return "capture" if size == bench.sizes.film else f"capture_{size}"
