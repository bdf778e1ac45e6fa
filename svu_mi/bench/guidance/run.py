"""Run the guidance benchmark, start by start; what is finished is kept."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Sequence
from typing import Any

from svu_mi.bench.accuracy import Bench
from svu_mi.bench.captures import some_views
from svu_mi.bench.cells import Cell
from svu_mi.bench.failures import Failures
from svu_mi.bench.guidance.curves import Shoot
from svu_mi.bench.guidance.speed import measure_speed
from svu_mi.bench.guidance.verdict import find_bars
from svu_mi.bench.sizes import GuidanceSizes
from svu_mi.bench.store import Store, code_and_machine, key_of
from svu_mi.surface import texels

Record = dict[str, Any]
PLACE = "guidance"  # folder of finished runs
PHOTOGRAPHS = 10  # that steps are timed with


def run_guidance(
    bench: Bench, cells: Sequence[Cell], *, finished: Callable[[Record], None] | None = None
) -> Record:
    """Choose views by every strategy, recover textures from them, and time the choice.

    Args:
        bench: where, and how large.
        cells: objects x lights; steps are timed on the first.
        finished: called with the record so far after each run.

    Returns:
        ``runs``: a record per cell and start, with ``cell``, ``object``, ``seed``, ``kind``,
        ``start``, ``agreement`` of forecasts, and ``curves`` by strategy; ``speed``; ``bars``;
        ``sizes``; ``quick``; ``failed`` cells.

    Raises:
        SvuError: that of the first cell, if every cell failed.
        OutputError: the folder cannot be written.
    """
    sizes = bench.sizes.guidance
    failures = Failures()
    record: Record = {"runs": [], "speed": None, "bars": [], "failed": failures.found,
                      "sizes": sizes, "quick": bench.quick}  # fmt: skip
    chosen = few_lights(cells, sizes.lights)
    with bench.progress.stage("Timing steps of guidance"):
        capture = some_views(bench.capture(chosen[0]), PHOTOGRAPHS)
        record["speed"] = measure_speed(capture, sizes)
    _tell(record, sizes, finished)
    # Every cell once before any twice: an interrupted run has seen them all.
    for seed, kind, cell in itertools.product(range(sizes.starts), sizes.kinds, chosen):
        if any(failed["cell"] == cell.title for failed in failures.found):
            continue
        with failures.leave_out(cell.title):
            record["runs"].append(_run(bench, cell, sizes, kind, seed))
        _tell(record, sizes, finished)
    failures.raise_unless(record["runs"])
    return record


def few_lights(cells: Sequence[Cell], count: int) -> list[Cell]:
    """Return the first ``count`` cells of every object."""
    kept: list[Cell] = []
    for cell in cells:
        if sum(one.object == cell.object for one in kept) < count:
            kept.append(cell)
    return kept


def _run(bench: Bench, cell: Cell, sizes: GuidanceSizes, kind: str, seed: int) -> Record:
    size = bench.sizes
    photographs = (size.views, size.film, size.spp, size.seed)
    what = (
        sizes.texels, sizes.looked_at, sizes.start, sizes.marks, sizes.strategies, sizes.asked, kind
    )  # fmt: skip
    key = key_of(str(cell.scene), cell.defines, photographs, what, seed, code_and_machine())

    def measure() -> Record:
        capture = bench.capture(cell)
        own = zlib.crc32(f"{cell.name} {seed}".encode())  # no two cells share their luck
        shoot = Shoot(capture, texels(capture.mesh, sizes.texels), sizes, own, kind)
        title = f"{cell.title}, {kind} start {seed}"
        with bench.progress.stage(title, len(sizes.strategies)) as stage:
            curves: Record = {}
            for strategy, curve in shoot.curves():
                curves[strategy] = curve
                stage.update(len(curves), len(sizes.strategies))
        return {
            "cell": cell.title, "object": cell.object, "seed": seed, "kind": kind,
            "start": shoot.start, "agreement": shoot.agreement(), "curves": curves,
        }  # fmt: skip

    store = Store(bench.folder / PLACE / cell.name)
    return store.recall(f"start_{kind}_{seed}", key, measure, fresh=bench.fresh)


def _tell(record: Record, sizes: GuidanceSizes, finished: Callable[[Record], None] | None) -> None:
    record["bars"] = find_bars(record, sizes)
    if finished is not None:
        finished(record)
