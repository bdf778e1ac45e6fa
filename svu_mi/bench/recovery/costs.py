"""What single steps cost: sharing, many views, and a long run's memory and kernels."""

from __future__ import annotations

import statistics
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.bench import clock
from svu_mi.bench.accuracy import Bench
from svu_mi.bench.captures import some_views
from svu_mi.bench.cells import Cell
from svu_mi.bench.fresh import in_new_process
from svu_mi.bench.recovery.measure import Mark, Watch, recover_once, step_seconds
from svu_mi.bench.recovery.rows import COLD, PATH, SH, Row
from svu_mi.capture import Capture
from svu_mi.pipeline import estimate
from svu_mi.posterior import CalibratedPosterior
from svu_mi.posterior.object_prior import shared
from svu_mi.recovery.path.objective import path_objective
from svu_mi.recovery.regularized import Rule, each
from svu_mi.recovery.sh.objective import Pull
from svu_mi.recovery.textures import uniform
from svu_mi.regularization import GlobalSharing, TotalVariation
from svu_mi.surface import Texels, texels

Record = dict[str, Any]
WATCHED = (SH, PATH)  # in the long run
SETTLED = 0.1  # part of its steps after which memory should not grow any more


def measure_costs(bench: Bench, cell: Cell) -> Record:
    """Measure what steps cost, on one cell.

    Args:
        bench: where and how.
        cell: object and light.

    Returns:
        ``cell``; ``sharing``: by rule, see ``sharing_cost``; ``views``: see ``cost_of_views``;
        ``long``: by label, see ``long_run``; ``cold``: by label, see ``recover_once``.
    """
    capture, sizes = bench.capture(cell), bench.sizes.recovery
    grid = texels(capture.mesh, bench.sizes.texels)
    folder = bench.folder / "cells" / cell.name / "capture"
    cold: Record = {}
    if sizes.cold:
        cold = {
            label: in_new_process(
                recover_once, folder=str(folder), resolution=bench.sizes.texels, label=label,
                scale=sizes.scale,
            )
            for label in COLD
        }  # fmt: skip
    return {
        "cell": cell.title,
        "sharing": {
            name: sharing_cost(capture, grid, rule, sizes.turns)
            for name, rule in _rules(capture, grid).items()
        },
        "views": cost_of_views(bench, cell),
        "long": {row.label: long_run(bench, cell, row) for row in WATCHED},
        "cold": cold,
    }


def _rules(capture: Capture, grid: Texels) -> dict[str, Rule]:
    """Return both ways of sharing: that of the rows, and that for anybody's loop."""
    found = estimate(capture, grid)
    posterior = found.posterior
    assert isinstance(posterior, CalibratedPosterior)
    return {
        "common prior": Pull.by_trust(shared(posterior), grid),
        "Eq. 14, 15": each(GlobalSharing(found, capture.mesh)),
    }


def sharing_cost(capture: Capture, grid: Texels, rule: Rule, turns: int) -> Record:
    """Time steps of the path tracer, loss to gradients, with sharing and without, in turns.

    Args:
        capture: the photographs.
        grid: texels of its mesh.
        rule: of sharing, a function of all textures.
        turns: pairs of steps that count.

    Returns:
        ``seconds`` of a step without, ``seconds_shared``, medians; ``part``: the median over
        pairs of what sharing adds, as a part of a step; ``alone``: seconds of sharing by itself.
    """
    smooth = each(TotalVariation(grid, capture.mesh))
    _, options = PATH.options()
    objective = path_objective(capture, grid, options)
    start = dict(uniform(grid).items())
    counter = iter(range(10**9))

    def step(shared: bool, traced: bool = True) -> Any:
        textures = {name: mi.TensorXf(tensor) for name, tensor in start.items()}
        dr.enable_grad(*textures.values())
        loss = objective(textures, next(counter)) if traced else mi.Float(0)
        if traced:
            loss = loss + options.tv * smooth(textures)
        if shared:
            loss = loss + options.sharing * rule(textures)
        dr.backward(loss)
        return [dr.grad(tensor).array for tensor in textures.values()]

    pairs = []
    for turn in range(clock.WARM_UP + turns):
        # The order changes, so that neither kind always comes second.
        order = (False, True) if turn % 2 else (True, False)
        walls = {shared: clock.run(partial(step, shared)).wall for shared in order}
        pairs.append((walls[False], walls[True]))
    pairs = pairs[clock.WARM_UP :]
    alone = clock.measure(partial(step, True, traced=False), turns)
    return {
        "seconds": statistics.median(plain for plain, _ in pairs),
        "seconds_shared": statistics.median(shared for _, shared in pairs),
        "part": statistics.median(shared / plain - 1 for plain, shared in pairs),
        "alone": alone["wall"]["median"],
        "part_alone": alone["wall"]["median"] / statistics.median(plain for plain, _ in pairs),
        "pixels": options.pixels_per_batch,
        "spp": options.spp,
    }


def cost_of_views(bench: Bench, cell: Cell) -> list[Record]:
    """Time steps of SH descent with few and with many views of the same object.

    Returns:
        For each number of views: ``views``, ``seconds`` per step (the least of several runs'
        medians), ``texels`` that are seen.
    """
    sizes = bench.sizes.recovery
    few, many = sizes.step_views
    size = replace(bench.sizes, views=many, film=sizes.step_film)
    whole = bench.capture(cell, size, f"capture_{many}_views_{size.film}")
    grid = texels(whole.mesh, bench.sizes.texels)
    captures = {count: some_views(whole, count) for count in (few, many)}
    times: dict[int, list[float]] = {few: [], many: []}
    texels_seen = {}
    for _ in range(sizes.repeats):
        for count, capture in captures.items():  # in turns: a slow spell hits both
            watch = Watch()
            found = SH.recover_in(sizes.step_steps, capture, grid, watch)
            times[count].append(step_seconds(watch.marks))
            texels_seen[count] = int((found.coverage > 0).sum())
    return [
        {"views": count, "seconds": min(times[count]), "texels": texels_seen[count]}
        for count in (few, many)
    ]


def long_run(bench: Bench, cell: Cell, row: Row) -> Record:
    """Watch a long run of a small capture.

    Returns:
        ``steps``; ``compiled``: kernels after the first mark (ten steps; the first two may
        compile); ``resident``: MiB when it has settled, ``grown``: MiB from then to the end,
        None where the system does not say; ``seconds`` per step.
    """
    sizes = bench.sizes.recovery
    size = replace(bench.sizes, views=sizes.soak_views, film=sizes.soak_film)
    capture = bench.capture(cell, size, f"capture_{size.views}_views_{size.film}")
    grid = texels(capture.mesh, sizes.soak_texels)
    watch = Watch()
    row.recover_in(sizes.steps, capture, grid, watch)
    return describe_marks(watch.marks, sizes.steps)


def describe_marks(marks: list[Mark], steps: int) -> Record:
    """Return the figures of ``long_run``."""
    settled = next(mark for mark in marks if mark.step >= SETTLED * steps)
    known = settled.resident is not None and marks[-1].resident is not None
    return {
        "steps": marks[-1].step,
        "compiled": marks[-1].compiled - marks[0].compiled,
        "resident": settled.resident,
        "grown": marks[-1].resident - settled.resident if known else None,  # type: ignore[operator]
        "seconds": step_seconds(marks),
    }
