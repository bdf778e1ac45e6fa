"""How long kernels take: warm, by the clock and in themselves."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

WARM_UP = 2  # the second run can compile too: what was a literal in the first is an array then
ENOUGH_S = 0.3  # short functions are run more often, until they took so long in all,
MAX_RUNS = 50  # but not more often than this
MILLISECOND = 1e-3  # Dr.Jit's unit of time
UNITS = {"microseconds": 1e6, "nanoseconds": 1e9}  # in a second


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



def measure_in_turns(
    functions: Mapping[str, Callable[[], Any]], repeats: int
) -> dict[str, dict[str, Any]]:
    """Time functions that are to be compared: a slow spell of the machine then hits them all.

    Args:
        functions: by name, each as for ``run``.
        repeats: number of runs of each that count.

    Returns:
        What ``measure`` returns, by name.
    """
    rounds = [
        {name: run(function) for name, function in functions.items()}
        for _ in range(WARM_UP + repeats)
    ]
    return {name: summary([one[name] for one in rounds[WARM_UP:]]) for name in functions}


def compile_record(function: Callable[[], Any]) -> dict[str, Any]:
    """Return what it costs to run a function for the first time in a process.

    Returns:
        ``seconds`` of the backend, ``compiled`` kernels, ``operations`` of all kernels.
    """
    first = run(function)
    return {"seconds": first.compile, "compiled": first.compiled, "operations": first.operations}


def per_texel(label: str, timed: Mapping[str, Any], texels: int, unit: str) -> dict[str, Any]:
    """Return what a row of a table says of run times.

    Args:
        label: of the row.
        timed: what ``measure`` returns.
        texels: how many were worked on at a time.
        unit: ``microseconds`` or ``nanoseconds`` of one texel.
    """

    def scaled(seconds: Mapping[str, float]) -> dict[str, float]:
        return {name: UNITS[unit] / texels * value for name, value in seconds.items()}

    return {
        "label": label,
        "texels": texels,
        unit: scaled(timed["kernel"]),
        f"wall_{unit}": scaled(timed["wall"]),
        "launched": timed["launched"],
        "operations": timed["operations"],
    }
