"""``run.json``: everything needed to know what a run was, and to repeat it."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import math
import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import svu_mi
from svu_mi import _llvm
from svu_mi.errors import OutputError
from svu_mi.files import write_text
from svu_mi.output.knowledge import Knowledge
from svu_mi.output.result import is_seen
from svu_mi.results.writing import Draft

RECORD = "run.json"
PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "OpenEXR", "trimesh", "xatlas")


def environment_record() -> dict[str, Any]:
    """Return what the run ran on: versions, platform, Mitsuba variant, threads, LLVM.

    Without Mitsuba's variant set, or before Dr.Jit is loaded, those entries are None.
    """
    mitsuba, drjit = sys.modules.get("mitsuba"), sys.modules.get("drjit")
    llvm = _llvm.status()
    return {
        "versions": {
            "svu_mi": svu_mi.__version__,
            "python": platform.python_version(),
            **{name: _version(name) for name in PACKAGES},
        },
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "variant": mitsuba.variant() if mitsuba else None,
        "threads": drjit.thread_count() if drjit else None,
        "llvm": {
            "version": ".".join(map(str, drjit.detail.llvm_version())) if drjit else None,
            "source": llvm.source,
        },
    }


def run_record(capture: Any, estimate: Any, knowledge: Knowledge | None = None) -> dict[str, Any]:
    """Return what a capture and its estimate say about the run.

    Args:
        capture: the ``Capture``.
        estimate: its ``Estimate``.
        knowledge: what it says in units; computed if not given.
    """
    entropy, seen = np.asarray(estimate.entropy), is_seen(estimate)
    result = {
        "texels": estimate.texels.count,
        "texels_seen": int(seen.sum()),
        "mean_entropy_of_seen": float(entropy[seen].mean()) if seen.any() else None,
        "intervals": knowledge or Knowledge.of(estimate),
    }
    return _record(
        capture, _settings(estimate), result, skipped=estimate.skipped, timings_s=estimate.timings
    )


def recovery_record(capture: Any, recovery: Any, estimate: Any | None = None) -> dict[str, Any]:
    """Return what a capture and a recovery from it say about the run.

    Args:
        capture: the ``Capture``.
        recovery: its ``Recovery``.
        estimate: whose entropy and standard deviations are written beside it, or None.
    """
    losses = np.asarray(recovery.losses, np.float64)
    settings = {
        "method": recovery.method,
        "resolution": recovery.texels.resolution,
        "used": recovery.settings,
        "entropy_of": None if estimate is None else _settings(estimate),
    }
    result = {
        "texels": recovery.texels.count,
        "texels_seen": int(is_seen(recovery).sum()),
        "steps": len(losses),
        "first_loss": float(losses[0]) if len(losses) else None,
        "last_loss": float(losses[-1]) if len(losses) else None,
    }
    return _record(capture, settings, result, timings_s=recovery.timings)


def guidance_record(capture: Any, estimate: Any, guidance: Any) -> dict[str, Any]:
    """Return what a capture, its estimate and the guidance from there say about the run.

    Args:
        capture: the ``Capture``.
        estimate: what its photographs say.
        guidance: the ``Guidance``.
    """
    settings = {**_settings(estimate), "used": guidance.options}
    result = {
        "texels": guidance.texels.count,
        "texels_seen": int(is_seen(estimate).sum()),
        "mean_entropy": float(np.asarray(estimate.entropy).mean()),
        "candidates": guidance.candidates.count,
        "proposals": [proposal.name for proposal in guidance.proposals],
    }
    skipped = {**estimate.skipped, **guidance.skipped}
    timings = {**estimate.timings, **guidance.timings}
    return _record(capture, settings, result, skipped=skipped, timings_s=timings)


def _settings(estimate: Any) -> dict[str, Any]:
    return {
        "method": estimate.method,
        "preset": estimate.preset,
        "grid": getattr(estimate.posterior, "grid", None),
        "resolution": estimate.texels.resolution,
    }


def _record(
    capture: Any, settings: dict[str, Any], result: dict[str, Any], **more: Any
) -> dict[str, Any]:
    """Return what the records of all runs have, in their order."""
    inputs = {
        "source": capture.source,
        "views": capture.count,
        "photographs": capture.names,
        "exposures": capture.exposures,
        "left_out": [n for n, u in zip(capture.names, capture.used, strict=True) if not u],
    }
    return {
        "inputs": inputs, "settings": settings, "result": result, **more,
        "warnings": capture.warnings,
    }  # fmt: skip


def write_run(
    draft: Draft,
    record: Mapping[str, Any],
    settings: Mapping[str, Any] | None = None,
    kernels: Mapping[str, int] | None = None,
) -> None:
    """Write ``run.json``: a record of this module, and where the run took place.

    Args:
        draft: of the run, with everything else in it.
        record: of the run.
        settings: what the caller was asked for (command-line options, seeds).
        kernels: number of kernels compiled per stage, ``Progress.kernels``.

    Raises:
        OutputError: as ``write_manifest``.
    """
    write_manifest(draft.folder / RECORD, {
        **record, "settings": {**record["settings"], "given": settings},
        "kernels_compiled": kernels, "environment": environment_record(), **draft.entries(),
    })  # fmt: skip


def write_manifest(path: str | Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON, atomically.

    Dataclasses become objects, arrays and tuples lists, paths text, and NaN or infinity
    null, which JSON has no number for.

    Args:
        path: the file.
        record: by name; nested to any depth.

    Raises:
        OutputError: a value that JSON cannot hold, or a file that cannot be written.
    """
    path = Path(path)
    text = json.dumps(_plain(record, path.name), indent=2, allow_nan=False, ensure_ascii=False)
    write_text(path, text)


def _plain(value: Any, where: str) -> Any:
    """Return the JSON equivalent of a value; ``where`` names it in the error."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, set | frozenset):
        value = sorted(value, key=str)
    if hasattr(value, "__array__"):
        value = np.asarray(value).tolist()
        return _plain(value, where)
    if isinstance(value, list | tuple):
        return [_plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    raise OutputError(f"{where}: a {type(value).__name__} cannot be written as JSON.")


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
