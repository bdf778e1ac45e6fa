"""Run one row on one cell: what comes out, and how long it takes when kernels are compiled."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.bench.clock import Timed
from svu_mi.bench.fresh import memory_mib
from svu_mi.bench.recovery.rows import Row, find_row
from svu_mi.bench.sizes import RecoverySizes
from svu_mi.capture import Capture, load_capture
from svu_mi.progress import Progress, Stage, compiled_kernels
from svu_mi.surface import Texels, texels

BRIEF = 4  # steps after which all kernels are compiled


def figures(timed: Timed) -> dict[str, Any]:
    """Return what is kept of a run of ``run_warm`` itself."""
    return {
        "seconds": timed.seconds,
        "runs": timed.runs,
        "compiled": timed.compiled,
        "steps": len(timed.result.losses),
        "timings": timed.timings,
    }


def run_warm(row: Row, capture: Capture, grid: Texels, sizes: RecoverySizes) -> Timed:
    """Recover textures with compiled kernels.

    Kernels are compiled by a brief run that does not count. A row that takes longer than
    ``sizes.long_s`` is timed once.
    """
    if sizes.warm:
        row.recover_in(BRIEF, capture, grid, Progress())
    runs = [_run(row, capture, grid, sizes)]
    if sizes.warm and runs[0].compiled and runs[0].seconds < sizes.long_s:
        runs = [_run(row, capture, grid, sizes)]
    while len(runs) < sizes.repeats and runs[0].seconds < sizes.long_s:
        runs.append(_run(row, capture, grid, sizes))
    return Timed(
        result=runs[-1].result,
        seconds=statistics.median(one.seconds for one in runs),
        timings=runs[-1].timings,
        compiled=sum(one.compiled for one in runs),
        runs=len(runs),
    )


def _run(row: Row, capture: Capture, grid: Texels, sizes: RecoverySizes) -> Timed:
    dr.sync_thread()
    compiled, start = compiled_kernels(), time.perf_counter()
    found = row.recover(capture, grid, sizes.scale)
    dr.sync_thread()
    seconds = time.perf_counter() - start
    return Timed(found, seconds, dict(found.timings), compiled_kernels() - compiled)


def recover_once(folder: str, resolution: int, label: str, scale: float) -> dict[str, Any]:
    """Recover as a user's first run does, in a new process (see ``fresh.in_new_process``).

    Args:
        folder: of the capture.
        resolution: texels per side.
        label: of the row.
        scale: see ``RecoverySizes``.

    Returns:
        ``seconds`` of the recovery, and ``compiled`` kernels.
    """
    capture = load_capture(folder)
    grid = texels(capture.mesh, resolution)
    run = _run(find_row(label), capture, grid, RecoverySizes(scale=scale))
    return {"seconds": run.seconds, "compiled": run.compiled}


# --- watching a run -----------------------------------------------------------------------


@dataclass(frozen=True)
class Mark:
    """What was seen when a run reported its progress.

    Attributes:
        step: number of steps done.
        seconds: on the clock.
        compiled: kernels of this process so far.
        resident: memory in MiB, None if it is not known.
    """

    step: int
    seconds: float
    compiled: int
    resident: float | None


class _Watching(Stage):
    """A stage that notes when it is told of a step."""

    def __init__(self, marks: list[Mark]) -> None:
        super().__init__()
        self._marks = marks

    def update(self, done: int, total: int) -> None:
        del total
        dr.sync_thread()
        self._marks.append(Mark(done, time.perf_counter(), compiled_kernels(), memory_mib("VmRSS")))


class Watch(Progress):
    """Progress that keeps a mark for every update of its last descent."""

    def __init__(self) -> None:
        super().__init__()
        self._stages: list[list[Mark]] = []

    @property
    def marks(self) -> list[Mark]:
        """Marks of the last stage that had any."""
        return next((marks for marks in reversed(self._stages) if marks), [])

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Stage]:
        """Run a stage, watched."""
        with super().stage(name, total):
            self._stages.append([])
            yield _Watching(self._stages[-1])


def step_seconds(marks: list[Mark]) -> float:
    """Return the median seconds per step between marks, without the first interval.

    NaN with fewer than three marks.
    """
    pairs = list(zip(marks[1:], marks[2:], strict=False))
    if not pairs:
        return float("nan")
    return float(np.median([(b.seconds - a.seconds) / (b.step - a.step) for a, b in pairs]))
