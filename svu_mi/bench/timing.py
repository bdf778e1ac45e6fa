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
    """A result and its run time.

    Attributes:
        result: Result with ``timings``, such as an ``Estimate`` or a ``Recovery``.
        seconds: Total time, median over runs.
        timings: Seconds by stage, median over runs.
        compiled: Number of compiled kernels; 0 for warm runs.
        runs: Number of runs.
    """

    result: Any
    seconds: float
    timings: dict[str, float]
    compiled: int
    runs: int = 1


def time_once(function: Callable[[], Any]) -> Timed:
    """Time a function that returns a result with ``timings``."""
    dr.sync_thread()
    compiled, start = compiled_kernels(), time.perf_counter()
    result = function()
    dr.sync_thread()
    seconds = time.perf_counter() - start
    return Timed(result, seconds, dict(result.timings), compiled_kernels() - compiled)


def time_warm(function: Callable[[], Any], repeats: int = 1, long_s: float = math.inf) -> Timed:
    """Time a function with compiled kernels; a first run that compiles kernels is discarded.

    Args:
        function: Returns a result with ``timings``.
        repeats: Number of timed runs.
        long_s: Run time in seconds above which the first run is the only one.
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


WARM_UP = 2  # literals of the first run can be arrays in the second, which then compiles too
MILLISECOND = 1e-3  # unit of Dr.Jit's times


@dataclass(frozen=True)
class KernelRun:
    """Times of one run of a function, with the device synchronised at both ends.

    Attributes:
        wall: Wall-clock seconds, including tracing in Python.
        kernel: Seconds in kernels.
        compile: Seconds of compilation of kernels that were not cached.
        compiled: Number of compiled kernels.
        launched: Number of launched kernels.
        operations: Number of operations of all traced kernels.
    """

    wall: float
    kernel: float
    compile: float
    compiled: int
    launched: int
    operations: int


def run(function: Callable[[], Any]) -> KernelRun:
    """Time one run of a function.

    Args:
        function: Returns Dr.Jit arrays, which are evaluated, or None.
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
    """Summarise runs.

    Returns:
        ``wall`` and ``kernel``, each a ``spread`` over the runs; ``launched`` and ``operations``
        of one run; number of runs, ``repeats``; number of ``compiled`` kernels.
    """
    return {
        "wall": spread([one.wall for one in runs]),
        "kernel": spread([one.kernel for one in runs]),
        "launched": runs[-1].launched,
        "operations": runs[-1].operations,
        "repeats": len(runs),
        "compiled": sum(one.compiled for one in runs),
    }


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return ``median``, minimum (``low``) and maximum (``high``)."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}


def measure_in_turns(
    functions: Mapping[str, Callable[[], Any]], repeats: int
) -> dict[str, dict[str, Any]]:
    """Time functions in turns, so that slow periods of the machine affect all of them.

    Args:
        functions: Functions for ``run``, by name.
        repeats: Number of timed runs of each function.

    Returns:
        Results of ``summary`` by name.
    """
    rounds = [
        {name: run(function) for name, function in functions.items()}
        for _ in range(WARM_UP + repeats)
    ]
    return {name: summary([one[name] for one in rounds[WARM_UP:]]) for name in functions}


# svu_mi comes first, because it selects LLVM.
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
        function: Takes and returns JSON values.
        **arguments: Arguments of the function.

    Returns:
        The result of the function, with ``process_seconds``, which includes start and imports,
        and ``peak_mib``, the peak of resident memory, None if the system does not report it.

    Raises:
        SvuEnvironmentError: The process failed; the message contains its last line.
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
        raise SvuEnvironmentError(f"{function.__qualname__}() failed in a new process: {lines[-1]}")
    record: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return {**record, "process_seconds": time.perf_counter() - start}


def child(module: str, name: str, arguments: str) -> None:
    """Call a function and print its result as one line of JSON."""
    function = getattr(importlib.import_module(module), name)
    record = {**function(**json.loads(arguments)), "peak_mib": memory_mib("VmHWM")}
    sys.stdout.write(json.dumps(record) + "\n")


def allocated_mib(function: Callable[[], Any]) -> float:
    """Return the peak of Dr.Jit's allocator in MiB while a function runs.

    On a GPU this is device memory. Memory that was allocated before is included.
    """
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    function()
    dr.sync_thread()
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float)) / 2**20


def memory_mib(kind: str) -> float | None:
    """Return the memory of this process in MiB (``memory.held``)."""
    size = held(kind)
    return None if size is None else size / 2**20
