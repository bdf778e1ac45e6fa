"""``run.json``: inputs, settings, results and environment of a run."""

import dataclasses
import json
import math
import os
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import distributions
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import svu_mi
from svu_mi import _llvm
from svu_mi.calibration.light.light_folder import light_record
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import mesh_key
from svu_mi.core.io.files import write_text
from svu_mi.core.io.output_folder import Draft
from svu_mi.core.io.provenance import RUN_RECORD
from svu_mi.errors import OutputError
from svu_mi.output.estimate_arrays import is_seen
from svu_mi.output.interval_summary import IntervalSummary
from svu_mi.posterior.estimate import Estimate

if TYPE_CHECKING:
    from svu_mi.guidance.guidance_result import Guidance
    from svu_mi.recovery.recovery_result import Recovery

RECORD = RUN_RECORD
PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "OpenEXR", "trimesh", "xatlas")


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """Settings and compiled kernels of a run.

    Attributes:
        settings: Settings of the caller, such as command-line options and seeds.
        kernels: Number of compiled kernels per stage (``Progress.kernels``).
    """

    settings: Mapping[str, Any] | None = None
    kernels: Mapping[str, int] | None = None


def environment_record() -> dict[str, Any]:
    """Return the environment: versions, platform, Mitsuba variant, threads, LLVM.

    Mitsuba and Dr.Jit must be loaded; otherwise their entries are null.
    """
    mitsuba, drjit = sys.modules.get("mitsuba"), sys.modules.get("drjit")
    return {
        "versions": {
            "svu_mi": svu_mi.__version__,
            "python": platform.python_version(),
            **{name: next((found.version for found in distributions(name=name)), None)
               for name in PACKAGES},
        },
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "variant": mitsuba.variant() if mitsuba else None,
        "threads": drjit.thread_count() if drjit else None,
        "llvm": {
            "version": ".".join(map(str, drjit.detail.llvm_version())) if drjit else None,
            "source": _llvm.status().source,
        },
    }  # fmt: skip


def run_record(
    capture: Capture, estimate: Estimate, summary: IntervalSummary | None = None
) -> dict[str, Any]:
    """Return the record of a capture, its estimate, and the ``summary`` of its intervals."""
    entropy, seen = np.asarray(estimate.entropy), is_seen(estimate)
    result = {
        "mean_entropy_of_seen": float(entropy[seen].mean()) if seen.any() else None,
        "intervals": summary or IntervalSummary.of(estimate),
        "error_bars_widened": estimate.posterior.kernel.spread,
        **_prediction(estimate),
    }
    return _record(
        capture, estimate, _settings(estimate), result,
        skipped=estimate.skipped, timings_s=estimate.timings,
    )  # fmt: skip


def recovery_record(
    capture: Capture, recovery: "Recovery", estimate: Estimate | None = None
) -> dict[str, Any]:
    """Return the record of a recovery, and of the estimate written with it."""
    losses = np.asarray(recovery.losses, np.float64)
    settings = {
        "method": recovery.method,
        "resolution": recovery.texels.resolution,
        "used": recovery.settings,
        "entropy_of": None if estimate is None else _settings(estimate),
    }
    result = {
        "steps": len(losses),
        "first_loss": float(losses[0]) if len(losses) else None,
        "last_loss": float(losses[-1]) if len(losses) else None,
        **({} if estimate is None else _prediction(estimate)),
    }
    return _record(capture, recovery, settings, result, timings_s=recovery.timings)


def guidance_record(capture: Capture, estimate: Estimate, guidance: "Guidance") -> dict[str, Any]:
    """Return the record of an estimate and its guidance."""
    result = {
        "mean_entropy": float(np.asarray(estimate.entropy).mean()),
        "candidates": guidance.candidates.count,
        "proposals": [proposal.name for proposal in guidance.proposals],
        **_prediction(estimate),
    }
    return _record(
        capture, estimate, {**_settings(estimate), "used": guidance.options}, result,
        skipped={**estimate.skipped, **guidance.skipped},
        timings_s={**estimate.timings, **guidance.timings},
    )  # fmt: skip


def _prediction(estimate: Estimate) -> dict[str, Any]:
    predicted, plane = estimate.prediction, estimate.observed and estimate.observed.plane
    return {
        "prediction": predicted, "reliable": predicted and predicted.reliable,
        "albedo_of_plane_below": plane,
    }  # fmt: skip


def _settings(estimate: Estimate) -> dict[str, Any]:
    return {
        "method": estimate.method,
        "preset": estimate.preset,
        "grid": getattr(estimate.posterior, "grid", None),
        "resolution": estimate.texels.resolution,
    }


def _record(
    capture: Capture, seen: "Estimate | Recovery", settings: dict[str, Any], result: dict[str, Any],
    **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """Return a record; texels are counted in ``seen``, and ``more`` contains further entries."""
    light = {} if capture.found_light is None else light_record(capture.found_light)
    texels = {"texels": seen.texels.count, "texels_seen": int(is_seen(seen).sum())}
    return {
        "inputs": {**inputs_record(capture), **light}, "settings": settings,
        "result": {**texels, **result}, **more, "warnings": capture.warnings,
    }  # fmt: skip


def inputs_record(capture: Capture) -> dict[str, Any]:
    """Return the record of a capture's photographs."""
    return {
        "source": capture.source,
        "mesh": mesh_key(capture.mesh),
        "views": capture.count,
        "photographs": capture.names,
        "exposures": capture.exposures,
        "left_out": list(compress(capture.names, np.logical_not(capture.used))),
    }


def write_run(draft: Draft, record: Mapping[str, Any], run: RunInfo) -> None:
    """Write ``run.json``: ``record``, and the settings and environment of the run."""
    write_manifest(draft.folder / RECORD, {
        **record, "settings": {**record["settings"], "given": run.settings},
        "kernels_compiled": run.kernels, "environment": environment_record(), **draft.entries(),
    })  # fmt: skip


def write_manifest(path: str | Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON, atomically.

    Dataclasses become objects; arrays and tuples become lists; paths become strings; NaN and
    infinity become null.

    Raises:
        OutputError: a value has no JSON equivalent, or the file cannot be written.
    """
    path = Path(path)
    text = json.dumps(_json_value(record, path.name), indent=2, allow_nan=False, ensure_ascii=False)
    write_text(path, text)


def _json_value(value: Any, where: str) -> Any:
    """Return the JSON equivalent of a value; ``where`` names the value in errors."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if hasattr(value, "__array__"):
        value = np.asarray(value).tolist()
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {str(key): _json_value(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, set | frozenset):
        value = sorted(value, key=str)
    if isinstance(value, list | tuple):
        return [_json_value(item, f"{where}[{index}]") for index, item in enumerate(value)]
    raise OutputError(f"{where}: a {type(value).__name__} cannot be written as JSON.")
