"""Disk cache of references: one file per hash of scene, photographs and options."""

import logging
from dataclasses import fields
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import svu_mi
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_parts
from svu_mi.core.io.files import clear_temporaries, prepare_folder
from svu_mi.core.io.hashes import Key
from svu_mi.core.io.npz import read_arrays, write_arrays
from svu_mi.core.io.schema import Axis, Field, checked
from svu_mi.errors import SvuError, warn
from svu_mi.evaluation.reference import Reference, TracedTables
from svu_mi.evaluation.reference_options import ReferenceOptions
from svu_mi.geometry.texels import Texels
from svu_mi.statistics.cholesky_factors import PAIRS

log = logging.getLogger(__name__)

FORMAT = 5  # increase whenever the same input gives another result or another file layout


def locate(
    folder: str | Path,
    capture: Capture,
    texels: Texels,
    subset: int | np.ndarray,
    options: ReferenceOptions,
) -> Path:
    """Return the path of a reference's cache file, and create its folder."""
    key = Key(FORMAT, svu_mi.__version__, mi.__version__, mi.variant(), options, subset)
    key.add(capture_parts(capture))
    for values in (texels.position, texels.geometric_normal):  # the capture determines the rest
        key.add(values.numpy())
    folder = prepare_folder(folder)
    clear_temporaries(folder)
    return folder / f"reference-{key.digest()}.npz"


def load(path: Path, options: ReferenceOptions) -> Reference | None:
    """Read a reference; warn and return None if the file is damaged or has another key."""
    if not path.exists():
        return None
    try:
        stored = read_arrays(path)
        if str(stored.pop("name", "")) != path.stem:
            raise ValueError("the file belongs to another capture or to other options")
        _require_shapes(stored, options)
        values: dict[str, Any] = {k: x if x.ndim else x.item() for k, x in stored.items()}
        return Reference.of(TracedTables(**values), options, cached=True)
    except (ValueError, SvuError) as error:
        warn(f"{path}: the cached reference cannot be read ({error}); it is traced again.")
        return None


def store(path: Path, traced: TracedTables) -> None:
    """Write the tables of a reference to its cache file."""
    values = {each.name: getattr(traced, each.name) for each in fields(traced)}
    stored = {name: value for name, value in values.items() if value is not None}
    write_arrays(path, {"name": path.stem, **stored})
    log.debug("%s: reference stored", path)


def _require_shapes(stored: dict[str, np.ndarray], options: ReferenceOptions) -> None:
    """Raise a ValueError if the shapes do not match the options."""
    n = Axis("texels")
    schema = {
        "subset": Field("i", (n,)), "brightness": Field("f", (n,)), "unit": Field("f"),
        "coverage": Field("i", (n,)), "scale": Field("f"), "seconds": Field("f"),
        "rays": Field("i"), "dropped": Field("i"),
        "tables": Field("f", (3, n, *options.grid.shape)),
    }  # fmt: skip
    if options.noise == "estimated":
        schema["tables"] = Field("f", (3, len(options.levels), 3, len(PAIRS), n))
        schema["weight"] = Field("f", (n,))
    checked(stored, schema, closed=True)
