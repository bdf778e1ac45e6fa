"""Run a function in a new process whose kernel cache is empty, as a new user's is."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.errors import SvuEnvironmentError
from svu_mi.memory import held

# svu_mi first: it chooses LLVM. The variant is set here because this is the whole program.
PROGRAM = """
import svu_mi, mitsuba, drjit, sys
mitsuba.set_variant(sys.argv[1])
if drjit.thread_count() != int(sys.argv[2]):
    drjit.set_thread_count(int(sys.argv[2]))
from svu_mi.bench.fresh import child
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
    """Call the function and write what it returns to standard output, as one line of JSON."""
    function = getattr(importlib.import_module(module), name)
    record = {**function(**json.loads(arguments)), "peak_mib": memory_mib("VmHWM")}
    sys.stdout.write(json.dumps(record) + "\n")


def memory_mib(kind: str) -> float | None:
    """Return memory of this process in MiB (``memory.held``)."""
    size = held(kind)
    return None if size is None else size / 2**20
