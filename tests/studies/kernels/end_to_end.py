"""From the files of a capture to entropy.exr: warm, and as the first thing that is ever run."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import drjit as dr

from studies.clock import WARM_UP, spread
from studies.kernels.memory import resident_formula
from svu_mi.bench.fresh import in_new_process
from svu_mi.bench.text import Bar
from svu_mi.capture import load_capture
from svu_mi.output import write_maps
from svu_mi.pipeline import estimate
from svu_mi.progress import Progress
from svu_mi.surface import texels

METHODS = ("angular", "spectrum")
WARM_BAR_S, COLD_BAR_S, MEMORY_BAR = 3.0, 25.0, 1.1


def measure_end_to_end(
    folder: Path, resolution: int, repeats: int, methods: tuple[str, ...] = METHODS
) -> dict[str, Any]:
    """Time the whole way, by stage.

    Args:
        folder: of a capture (``capture.json`` and photographs).
        resolution: texels per side.
        repeats: warm runs.
        methods: of ``estimate``.

    Returns:
        ``views``, ``pixels`` of all photographs, ``texels``; ``methods``: by name ``warm`` and
        ``cold``; and ``bars``. Warm: ``stages``, the spread of each, and ``seconds``, that of
        the whole. Cold, in a new process without compiled kernels: ``stages`` in seconds, their
        sum ``seconds``, ``kernels`` compiled, ``process_seconds`` with start and imports, and
        ``peak_mib``, the most memory resident (None if unknown), beside ``formula_mib``, what
        the README says.
    """
    found = {name: _both(folder, resolution, repeats, name) for name in methods}
    first = next(iter(found.values()))
    return {
        **{name: first["cold"][name] for name in ("views", "pixels", "texels")},
        "resolution": resolution,
        "methods": found,
        "bars": [bar.record() for name in methods for bar in _bars(name, found[name])],
    }


def run_once(source: str, resolution: int, method: str) -> dict[str, Any]:
    """Go all the way once.

    Args:
        source: folder of the capture.
        resolution: texels per side.
        method: of ``estimate``.

    Returns:
        ``stages`` in seconds, ``seconds`` of all, ``kernels`` compiled; ``views``, ``pixels``
        of all photographs and ``texels``: how many.
    """
    progress: Any = Progress()
    dr.sync_thread()
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="svu-maps-") as target:
        with progress.stage("Loading photographs"):
            capture = load_capture(source)
        with progress.stage("Laying out texels"):
            layout = texels(capture.mesh, resolution)
        found = estimate(capture, layout, method, progress=progress)  # type: ignore[arg-type]
        with progress.stage("Writing entropy.exr"):
            write_maps(found, target)
        seconds = time.perf_counter() - start
    return {
        "stages": dict(progress.timings),
        "seconds": seconds,
        "kernels": sum(progress.kernels.values()),
        "views": capture.count,
        "pixels": sum(image.shape[0] * image.shape[1] for image in capture.images),
        "texels": layout.count,
    }


def _both(folder: Path, resolution: int, repeats: int, method: str) -> dict[str, Any]:
    asked: dict[str, Any] = {"source": str(folder), "resolution": resolution, "method": method}
    runs = [run_once(**asked) for _ in range(WARM_UP + repeats)][WARM_UP:]
    warm = {
        "stages": {
            stage: spread([run["stages"][stage] for run in runs]) for stage in runs[0]["stages"]
        },
        "seconds": spread([run["seconds"] for run in runs]),
        "kernels": sum(run["kernels"] for run in runs),
    }
    cold = in_new_process(run_once, **asked)
    cold["formula_mib"] = resident_formula(method, cold["pixels"], cold["texels"])
    return {"warm": warm, "cold": cold}


def _bars(method: str, found: dict[str, Any]) -> list[Bar]:
    return [
        Bar(f"files to entropy.exr, {method}, warm", found["warm"]["seconds"]["median"],
            WARM_BAR_S, "s"),
        Bar(f"files to entropy.exr, {method}, cold, with imports",
            found["cold"]["process_seconds"], COLD_BAR_S, "s"),
        Bar(f"files to entropy.exr, {method}: resident memory over the formula",
            (found["cold"]["peak_mib"] or 0.0) / found["cold"]["formula_mib"], MEMORY_BAR, ""),
    ]  # fmt: skip
