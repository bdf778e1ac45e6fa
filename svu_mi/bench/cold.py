"""The first estimate of a fresh process: what a user waits for who has no compiled kernels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from svu_mi.bench.fresh import in_new_process
from svu_mi.bench.variants import VARIANTS
from svu_mi.capture import load_capture
from svu_mi.pipeline import estimate
from svu_mi.progress import Progress
from svu_mi.surface import texels


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
    found = in_new_process(_once, folder=str(folder), resolution=resolution, label=label)
    return {**found["result"], "process_seconds": found["process_seconds"]}


def _once(folder: str, resolution: int, label: str) -> dict[str, Any]:
    variant = next(v for v in VARIANTS if v.label == label)
    capture = load_capture(folder)
    grid = texels(capture.mesh, resolution)
    progress = Progress()
    estimate(capture, grid, variant.method, variant.preset, progress=progress)
    return {
        "timings": progress.timings,
        "seconds": sum(progress.timings.values()),
        "kernels": sum(progress.kernels.values()),
    }
