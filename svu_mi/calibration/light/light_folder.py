"""Folder of an estimated light: ``light.exr`` for viewing, ``light.npz`` for reuse."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import svu_mi
from svu_mi.calibration.light.light_estimate import FoundGains, LightEstimate
from svu_mi.capture.scene_xml import POLES, ROWS
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.files import read_json, refusing, write_json
from svu_mi.core.io.folder_exchange import restore
from svu_mi.core.io.npz import read_arrays, write_arrays
from svu_mi.core.io.output_folder import Draft, writing
from svu_mi.core.io.provenance import LIGHT, LIGHT_RECORD, entry_of, require_one_run
from svu_mi.core.io.schema import TEXT, Axis, Field, checked
from svu_mi.core.validation import MAX_VIEWS
from svu_mi.errors import CaptureError

COMMAND, RECORD = LIGHT, LIGHT_RECORD
MAP, ARRAYS = "light.exr", "light.npz"
HIGHEST = 60.0  # maximum log radiance in single precision
REAL = "fiub"
CELLS, DRAWS = Axis("cells", 64, 4096), Axis("draws", 1, 256)
LIGHT_ARRAYS = {
    "run": Field(TEXT), "remarks": Field(TEXT, (Axis("remarks"),)),
    "logarithm": Field(REAL, (CELLS, 3), -HIGHEST, HIGHEST),
    "cell_sd": Field(REAL, (CELLS,), 0, HIGHEST),
    "draws": Field(REAL, (DRAWS, CELLS, 3), -HIGHEST, HIGHEST),
    "scale_sd": Field(REAL, (3,), 0, HIGHEST), "tint_sd": Field(REAL, (3,), 0, HIGHEST),
    "moves": Field(REAL, (), 0, 1),
    "misfit": Field(REAL, (2,), 0, 1e12), "widening": Field(REAL, (), 1, 1e5),
    "texels": Field(REAL, (), 0, 2**31),
}  # fmt: skip
VIEWS = Axis("photographs", 1, MAX_VIEWS)
GAIN_ARRAYS = {  # optional
    "gains": Field(REAL, (VIEWS, 3), -HIGHEST, HIGHEST),
    "gains_noise": Field(REAL, (VIEWS,), 0, 1e12), "gains_odd": Field(REAL, (VIEWS,), 0, 1),
}  # fmt: skip


def save_light(
    estimate: LightEstimate,
    path: str | os.PathLike[str],
    *,
    photographs: str = "",
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write an estimated light to a folder, for ``load_light`` and ``--light``.

    Writes ``light.exr`` (radiance, with the layers ``sd.Y`` and ``known.Y``), ``light.npz`` and
    ``light.json`` atomically.

    Args:
        estimate: Estimated light.
        path: Path of the folder; created if missing. An older result is replaced.
        photographs: ``photographs_key`` of the capture, if known.
        about: Further entries of ``light.json``.

    Raises:
        OutputError: The folder or a file cannot be written.

    Example:
        >>> svu.save_light(light, "light")
        >>> svu.load_light("light").cells
        64
    """
    with writing(path, COMMAND, RECORD, capture=photographs) as draft:
        write_light_arrays(estimate, draft)
        record = {**(about or {}), **light_record(estimate), **draft.entries()}
        write_json(draft.folder / RECORD, record)


def write_light_arrays(estimate: LightEstimate, draft: Draft) -> None:
    """Write ``light.exr`` and ``light.npz`` to a draft."""
    channels = {"RGB": estimate.radiance, "sd.Y": estimate.sd, "known.Y": estimate.known}
    header = {"svu:version": svu_mi.__version__, ROWS: POLES}
    write_exr(draft.folder / MAP, channels, header)
    arrays = {name: getattr(estimate, name) for name in LIGHT_ARRAYS if name != "run"}
    if (gains := estimate.gains) is not None:
        arrays |= dict(zip(GAIN_ARRAYS, (gains.logarithm, gains.noise, gains.odd), strict=True))
    remarks = np.array(estimate.remarks, dtype=np.str_)
    write_arrays(draft.folder / ARRAYS, {**arrays, "remarks": remarks, "run": draft.run})


def light_record(estimate: LightEstimate) -> dict[str, Any]:
    """Return the entry ``light`` of records as JSON values."""
    low, high = estimate.scale_interval
    still, moving = (None if math.isnan(value) else float(value) for value in estimate.misfit)
    gains = estimate.gains
    return {
        "light": {
            "found": True,
            "known": estimate.known_part,
            "scale_interval": [low.tolist(), high.tolist()],
            "moves": bool(estimate.moves),
            "misfit": {"still": still, "moving": moving},
            "widening": float(estimate.widening),
            "cells": estimate.cells, "texels": int(estimate.texels),
            "remarks": list(estimate.remarks),
            "gains": None if gains is None else {
                "factor": gains.factor.tolist(), "noise": gains.noise.tolist(),
                "left_out": np.flatnonzero(gains.odd).tolist(),
            },
        }
    }  # fmt: skip


def photographs_of(path: str | Path) -> str:
    """Return the ``photographs_key`` of the light in a folder; empty if unknown."""
    entry = entry_of(Path(path) / RECORD, COMMAND)
    return "" if entry is None else entry.capture


def known_in(path: str | Path) -> dict[str, float]:
    """Return the parameters that were known to the estimate in a folder; empty if not recorded."""
    try:
        known = read_json(Path(path) / RECORD)["settings"]["used"]["known"]
    except (CaptureError, LookupError, TypeError):
        return {}
    return known if isinstance(known, dict) else {}


def load_light(path: str | Path) -> LightEstimate:
    """Read the light written by ``svu light`` or ``save_light``.

    Args:
        path: Path of the folder.

    Raises:
        CaptureError: The folder is not a light, or a file is missing, damaged, modified or from a
            different run.

    Example:
        >>> svu.save_light(light, "light")
        >>> svu.load_light("light").radiance.shape
        (129, 256, 3)
    """
    path = Path(path)
    restore(path)
    missing = [name for name in (MAP, ARRAYS, RECORD) if not (path / name).is_file()]
    if missing:
        what = f"has no {', '.join(missing)}" if path.is_dir() else "no such folder"
        raise CaptureError(f"{path}: {what}; give a folder written by svu light.")
    require_one_run(path, [MAP], RECORD, COMMAND)
    written = entry_of(path / RECORD, COMMAND)
    if written is None:
        raise CaptureError(f"{path / RECORD}: not written by svu light; run svu light again.")
    if not written.owns(path, MAP):
        raise CaptureError(
            f"{path / MAP}: was changed since svu light wrote it; give this map itself, or run svu "
            "light again."
        )
    with refusing(path / ARRAYS, "run svu light again"):
        arrays = read_arrays(path / ARRAYS)
        estimate = _estimate_of(arrays)
        if str(arrays["run"]) != written.run:
            raise ValueError(f"it is from a different run than {RECORD}")
    return estimate


def _estimate_of(arrays: dict[str, np.ndarray]) -> LightEstimate:
    """Return the light from arrays, where a misfit that was not tested (fixed, moving) is NaN."""
    has_gains = not GAIN_ARRAYS.keys().isdisjoint(arrays)
    known = {"misfit": np.nan_to_num(arrays["misfit"])} if "misfit" in arrays else {}
    checked(arrays | known, LIGHT_ARRAYS | (GAIN_ARRAYS if has_gains else {}), closed=True)
    if np.isnan(arrays["misfit"][int(arrays["moves"])]):
        raise ValueError("the misfit of the chosen light is NaN")
    names = (*GAIN_ARRAYS, "logarithm", "cell_sd", "draws", "scale_sd", "tint_sd")
    real = {name: arrays[name].astype(np.float64) for name in names if name in arrays}
    still, moving = arrays["misfit"].tolist()
    gains = None
    if has_gains:
        logarithm, noise, odd = (real.pop(name) for name in GAIN_ARRAYS)
        gains = FoundGains(logarithm, noise, odd.astype(bool))
    return LightEstimate(
        **real, moves=bool(arrays["moves"]), misfit=(still, moving),
        widening=float(arrays["widening"]), texels=int(arrays["texels"]),
        remarks=tuple(map(str, arrays["remarks"])), gains=gains,
    )  # fmt: skip
