"""How long a function takes: warm, by the clock and in kernels."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

WARM_UP = 2  # the second run can compile too: what was a literal in the first is an array then
ENOUGH_S = 0.3  # short functions are run more often, until they took so long in all,
MAX_RUNS = 50  # but not more often than this
MILLISECOND = 1e-3  # Dr.Jit's unit of time


@dataclass(frozen=True)
class Timed:
    """A result, and how long it took to get it.

    Attributes:
        result: what was computed.
        seconds: all together; the median, if there were several runs.
        timings: seconds by stage.
        compiled: kernels compiled meanwhile; 0 if it was warm.
        runs: number of runs.
    """

    result: Any
    seconds: float
    timings: dict[str, float]
    compiled: int
    runs: int = 1


@dataclass(frozen=True)
class Run:
    """One run of a function, the device synchronised at both ends.

    Attributes:
        wall: seconds by the clock, with the tracing of kernels in Python.
        kernel: seconds in kernels.
        compile: seconds of the backend, for kernels that were found in no cache.
        compiled: number of these.
        launched: number of kernels launched.
        operations: of all kernels that the function traced.
    """

    wall: float
    kernel: float
    compile: float
    compiled: int
    launched: int
    operations: int


def run(function: Callable[[], Any]) -> Run:
    """Run a function once.

    Args:
        function: returns Dr.Jit arrays, which are evaluated, or None.
    """
    dr.sync_thread()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = time.perf_counter()
        dr.eval(function())
        dr.sync_thread()
        wall = time.perf_counter() - start
        history = dr.kernel_history()
    traced = [kernel for kernel in history if kernel["type"] == dr.KernelType.JIT]
    new = [k for k in traced if not (k["cache_hit"] or k["cache_disk"])]
    return Run(
        wall=wall,
        kernel=MILLISECOND * sum(k["execution_time"] for k in history),
        compile=MILLISECOND * sum(k["backend_time"] for k in new),
        compiled=len(new),
        launched=len(history),
        operations=sum(k["operation_count"] for k in traced),
    )


def measure(function: Callable[[], Any], repeats: int) -> dict[str, Any]:
    """Time a function, warm.

    Args:
        function: as for ``run``.
        repeats: number of runs that count, at least.

    Returns:
        ``wall`` and ``kernel``, each the ``spread`` of its seconds over the runs; ``launched``
        and ``operations`` of one run; ``repeats``; ``compiled``, which is 0 if the runs were warm.
    """
    for _ in range(WARM_UP):
        run(function)
    runs = [run(function) for _ in range(repeats)]
    while sum(one.wall for one in runs) < ENOUGH_S and len(runs) < MAX_RUNS:
        runs.append(run(function))
    return summary(runs)


def summary(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the record of ``measure``."""
    return {
        "wall": spread([one.wall for one in runs]),
        "kernel": spread([one.kernel for one in runs]),
        "launched": runs[-1].launched,
        "operations": runs[-1].operations,
        "repeats": len(runs),
        "compiled": sum(one.compiled for one in runs),
    }


def spread(values: Sequence[float], scale: float = 1.0) -> dict[str, float]:
    """Return ``median``, ``low`` (the least) and ``high`` (the greatest), times a scale."""
    return {
        "median": scale * statistics.median(values),
        "low": scale * min(values),
        "high": scale * max(values),
    }
