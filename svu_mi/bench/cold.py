"""The first estimate of a fresh process: what a user waits for who has no compiled kernels."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.bench.variants import VARIANTS
from svu_mi.capture import load_capture
from svu_mi.errors import SvuEnvironmentError
from svu_mi.pipeline import estimate
from svu_mi.progress import Progress
from svu_mi.surface import texels

# svu_mi first: it chooses LLVM. The variant is set here because this is the whole program.
CHILD = """
import svu_mi, mitsuba, drjit, sys
mitsuba.set_variant(sys.argv[1])
drjit.set_thread_count(int(sys.argv[2]))
from svu_mi.bench.cold import child
child(*sys.argv[3:])
"""
TIMEOUT_S = 1800


def run_cold(folder: Path, resolution: int, label: str) -> dict[str, Any]:
    """Estimate once in a new process with an empty kernel cache.

    Args:
        folder: of the capture.
        resolution: texels per side.
        label: of the variant.

    Returns:
        ``timings`` by stage in seconds, ``seconds`` their sum, ``kernels`` compiled, and
        ``process_seconds`` with start, loading and everything else.

    Raises:
        SvuEnvironmentError: the process failed; the sentence is its last one.
    """
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="svu-cold-") as cache:
        done = subprocess.run(
            [sys.executable, "-c", CHILD, mi.variant(), str(dr.thread_count()),
             str(folder), str(resolution), label],
            env={**os.environ, "DRJIT_CACHE_DIR": cache},
            capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S,
        )  # fmt: skip
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise SvuEnvironmentError(f"A cold run of '{label}' failed: {lines[-1]}")
    record: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return {**record, "process_seconds": time.perf_counter() - start}


def child(folder: str, resolution: str, label: str) -> None:
    """Run one estimate and write its timings to standard output, as one line of JSON."""
    variant = next(v for v in VARIANTS if v.label == label)
    capture = load_capture(folder)
    grid = texels(capture.mesh, int(resolution))
    progress = Progress()
    estimate(capture, grid, variant.method, variant.preset, progress=progress)
    record = {
        "timings": progress.timings,
        "seconds": sum(progress.timings.values()),
        "kernels": sum(progress.kernels.values()),
    }
    sys.stdout.write(json.dumps(record) + "\n")
