"""Run times of stages, kernels and cold processes."""

from __future__ import annotations

import importlib
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.core.memory import held
from svu_mi.core.progress import compiled_kernels
from svu_mi.errors import SvuEnvironmentError


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


def time_once(function: Callable[[], Any]) -> Timed:
    """Run a function that returns a result with ``timings``."""
    dr.sync_thread()
    compiled, start = compiled_kernels(), time.perf_counter()
    result = function()
    dr.sync_thread()
    seconds = time.perf_counter() - start
    return Timed(result, seconds, dict(result.timings), compiled_kernels() - compiled)


def time_warm(function: Callable[[], Any], repeats: int = 1, long_s: float = math.inf) -> Timed:
    """Time a function whose kernels are compiled: it runs again if it had to compile some.

    Args:
        function: as for ``time_once``.
        repeats: runs that count.
        long_s: a function that takes longer, in seconds, runs once, whatever it compiles.
    """
    runs = [time_once(function)]
    if runs[0].compiled and runs[0].seconds < long_s:
        runs = [time_once(function)]
    while len(runs) < repeats and runs[0].seconds < long_s:
        runs.append(time_once(function))
    stages = runs[0].timings
    return Timed(
        result=runs[-1].result,
        seconds=statistics.median(run.seconds for run in runs),
        timings={stage: statistics.median(run.timings[stage] for run in runs) for stage in stages},
        compiled=sum(run.compiled for run in runs),
        runs=len(runs),
    )


WARM_UP = 2  # the second run can compile too: what was a literal in the first is an array then
MILLISECOND = 1e-3  # Dr.Jit's unit of time


@dataclass(frozen=True)
class KernelRun:
    """One run of a function, the device synchronised at both ends.

    Attributes:
        wall: seconds by the clock, with the tracing of kernels in Python.
        kernel: seconds in kernels.
        compile: seconds of the backend, for kernels that are in no cache.
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


def run(function: Callable[[], Any]) -> KernelRun:
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
    return KernelRun(
        wall=wall,
        kernel=MILLISECOND * sum(k["execution_time"] for k in history),
        compile=MILLISECOND * sum(k["backend_time"] for k in new),
        compiled=len(new),
        launched=len(history),
        operations=sum(k["operation_count"] for k in traced),
    )


def summary(runs: Sequence[KernelRun]) -> dict[str, Any]:
    """Return ``wall`` and ``kernel``, each the ``spread`` of its seconds over the runs;
    ``launched`` and ``operations`` of one run; ``repeats``; ``compiled``, 0 if warm."""
    return {
        "wall": spread([one.wall for one in runs]),
        "kernel": spread([one.kernel for one in runs]),
        "launched": runs[-1].launched,
        "operations": runs[-1].operations,
        "repeats": len(runs),
        "compiled": sum(one.compiled for one in runs),
    }


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return ``median``, ``low`` (the least) and ``high`` (the greatest)."""
    return {
        "median": statistics.median(values),
        "low": min(values),
        "high": max(values),
    }


def measure_in_turns(
    functions: Mapping[str, Callable[[], Any]], repeats: int
) -> dict[str, dict[str, Any]]:
    """Time functions that are to be compared: a slow spell of the machine then hits them all.

    Args:
        functions: by name, each as for ``run``.
        repeats: number of runs of each that count.

    Returns:
        What ``summary`` returns, by name.
    """
    rounds = [
        {name: run(function) for name, function in functions.items()}
        for _ in range(WARM_UP + repeats)
    ]
    return {name: summary([one[name] for one in rounds[WARM_UP:]]) for name in functions}


# svu_mi first: it chooses LLVM. The variant is set here because this is the whole program.
PROGRAM = """
import svu_mi, mitsuba, drjit, sys
mitsuba.set_variant(sys.argv[1])
if drjit.thread_count() != int(sys.argv[2]):
    drjit.set_thread_count(int(sys.argv[2]))
from svu_mi.bench.timing import child
child(*sys.argv[3:])
"""
TIMEOUT_S = 1800


def in_new_process(function: Callable[..., dict[str, Any]], **arguments: Any) -> dict[str, Any]:
    """Call a function of a module in a new process.

    Args:
        function: takes and returns what JSON can hold.
        **arguments: for it.

    Returns:
        What it returns, and ``process_seconds`` with start, imports and everything else, and
        ``peak_mib``, the most memory that was resident, None where the system does not tell.

    Raises:
        SvuEnvironmentError: the process failed; the sentence is its last one.
    """
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="svu-cold-") as cache:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, mi.variant(), str(dr.thread_count()),
             function.__module__, function.__qualname__, json.dumps(arguments)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "DRJIT_CACHE_DIR": cache},
            capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S,
        )  # fmt: skip
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise SvuEnvironmentError(f"{function.__qualname__}() failed when cold: {lines[-1]}")
    record: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return {**record, "process_seconds": time.perf_counter() - start}


def child(module: str, name: str, arguments: str) -> None:
    """Call the function and print its result as one line of JSON."""
    function = getattr(importlib.import_module(module), name)
    record = {**function(**json.loads(arguments)), "peak_mib": memory_mib("VmHWM")}
    sys.stdout.write(json.dumps(record) + "\n")


def allocated_mib(function: Callable[[], Any]) -> float:
    """Return the most memory, in MiB, that Dr.Jit's allocator held while a function ran.

    On a GPU that of the device. What was held before counts as well.
    """
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    function()
    dr.sync_thread()
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float)) / 2**20


def memory_mib(kind: str) -> float | None:
    """Return memory of this process in MiB (``memory.held``)."""
    size = held(kind)
    return None if size is None else size / 2**20
