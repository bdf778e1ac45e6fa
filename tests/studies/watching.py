"""Descents that are watched: time, memory and kernels of their steps."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.bench.fresh import memory_mib
from svu_mi.progress import Progress, Stage, compiled_kernels

SETTLED = 0.1  # part of the steps after which memory should not grow any more


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


def describe_marks(marks: list[Mark], steps: int) -> dict[str, Any]:
    """Return the figures of a long run."""
    settled = next(mark for mark in marks if mark.step >= SETTLED * steps)
    return {
        "steps": marks[-1].step,
        "compiled": marks[-1].compiled - marks[0].compiled,
        "resident": settled.resident,
        "grown": _difference(marks[-1].resident, settled.resident),
        "seconds": step_seconds(marks),
    }


def _difference(last: float | None, first: float | None) -> float | None:
    return None if last is None or first is None else last - first
