"""How long a function takes, by the clock, the device synchronised at both ends."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from svu_mi.progress import compiled_kernels


@dataclass(frozen=True)
class Timed:
    """A result with timings of its own, and how long it took to get it.

    Attributes:
        result: what was computed, such as an ``Estimate`` or a ``Recovery``.
        seconds: all together; the median, if there were several runs.
        timings: seconds by stage, medians likewise.
        compiled: kernels compiled meanwhile; 0 if it was warm.
        runs: number of runs.
    """

    result: Any
    seconds: float
    timings: dict[str, float]
    compiled: int
    runs: int = 1


def once(function: Callable[[], Any]) -> Timed:
    """Run a function that returns a result with ``timings``."""
    dr.sync_thread()
    compiled, start = compiled_kernels(), time.perf_counter()
    result = function()
    dr.sync_thread()
    seconds = time.perf_counter() - start
    return Timed(result, seconds, dict(result.timings), compiled_kernels() - compiled)


def warm(function: Callable[[], Any], repeats: int = 1, long_s: float = math.inf) -> Timed:
    """Time a function whose kernels are compiled: it runs again if it had to compile some.

    Args:
        function: as for ``once``.
        repeats: runs that count.
        long_s: a function that takes longer, in seconds, runs once, whatever it compiles.
    """
    runs = [once(function)]
    if runs[0].compiled and runs[0].seconds < long_s:
        runs = [once(function)]
    while len(runs) < repeats and runs[0].seconds < long_s:
        runs.append(once(function))
    stages = runs[0].timings
    return Timed(
        result=runs[-1].result,
        seconds=statistics.median(run.seconds for run in runs),
        timings={stage: statistics.median(run.timings[stage] for run in runs) for stage in stages},
        compiled=sum(run.compiled for run in runs),
        runs=len(runs),
    )
