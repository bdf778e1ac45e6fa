"""References on disk: one file per key, the key made of everything that matters."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import mitsuba as mi
import numpy as np

import svu_mi
from svu_mi.capture import Capture
from svu_mi.capture.fingerprint import capture_parts
from svu_mi.errors import SvuError, SvuWarning
from svu_mi.files import clear_temporaries, prepare_folder
from svu_mi.hashing import Key
from svu_mi.npz import Field, read_arrays, require_schema, write_arrays
from svu_mi.reference.options import Options
from svu_mi.reference.record import Reference, Traced
from svu_mi.statistics.factors import PAIRS
from svu_mi.surface import Texels

log = logging.getLogger(__name__)

FORMAT = 4  # raised whenever the same input would give another result, or another file


def locate(
    folder: str | Path,
    capture: Capture,
    texels: Texels,
    subset: int | np.ndarray,
    options: Options,
) -> Path:
    """Return the file of one reference; its folder exists afterwards."""
    key = Key(FORMAT, svu_mi.__version__, mi.__version__, mi.variant(), options, subset)
    key.add(capture_parts(capture))
    for values in (texels.position, texels.geometric_normal):  # others are in the capture
        key.add(values.numpy())
    folder = prepare_folder(folder)
    clear_temporaries(folder)
    return folder / f"reference-{key.digest()}.npz"


def load(path: Path, options: Options) -> Reference | None:
    """Read a reference back; None, with a warning, when the file is damaged or another one's."""
    if not path.exists():
        return None
    try:
        return _unpack(read_arrays(path), path.stem, options)
    except (ValueError, SvuError) as error:
        warnings.warn(
            f"{path}: the cached reference cannot be read ({error}); it is traced again.",
            SvuWarning,
            stacklevel=3,
        )
        return None


def store(path: Path, reference: Reference) -> None:
    """Write a reference."""
    traced = reference.traced
    weight = {} if traced.weight is None else {"weight": traced.weight}
    write_arrays(
        path,
        {
            "name": path.stem,
            "subset": reference.subset,
            "tables": traced.tables,
            **weight,
            "unit": reference.unit,
            "brightness": reference.brightness,
            "coverage": reference.coverage,
            "scalars": np.array([reference.scale, reference.seconds]),
            "counts": np.array([reference.rays, reference.dropped]),
        },
    )
    log.debug("%s: reference stored", path)


def _unpack(stored: dict[str, np.ndarray], name: str, options: Options) -> Reference:
    """Return what was read as a reference."""
    if str(stored.get("name")) != name:
        raise ValueError("it belongs to another capture or other options")
    _require_shapes(stored, options)
    found = Traced(stored["tables"], stored.get("weight"), stored["coverage"])
    unit = float(stored["unit"])
    whole, first, second = found.posteriors(options, unit)
    scale, seconds = stored["scalars"].tolist()
    rays, dropped = stored["counts"].tolist()
    return Reference(
        subset=stored["subset"],
        posterior=whole,
        halves=(first, second),
        traced=found,
        unit=unit,
        brightness=stored["brightness"],
        coverage=stored["coverage"],
        scale=scale,
        seconds=seconds,
        cached=True,
        rays=rays,
        dropped=dropped,
        spp=options.spp,
        max_depth=options.max_depth,
        method=options.method,
    )


def _require_shapes(stored: dict[str, np.ndarray], options: Options) -> None:
    """Refuse arrays that no reference with these options has, by a ValueError."""
    schema = {
        "subset": Field("i", ("n",)), "unit": Field("f"), "brightness": Field("f", ("n",)),
        "coverage": Field("i", ("n",)), "scalars": Field("f", (2,)), "counts": Field("i", (2,)),
        "name": Field("U"),
    }  # fmt: skip
    if options.noise == "estimated":
        sums = (3, len(options.levels), 3, len(PAIRS), "n")
        schema |= {"tables": Field("f", sums), "weight": Field("f", ("n",))}
    else:
        schema |= {"tables": Field("f", (3, "n", *options.grid.shape))}
    require_schema(stored, schema)
