"""``compare.html``, ``compare.json`` and difference maps: the files of ``svu compare``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import svu_mi
from svu_mi.exr import write_exr
from svu_mi.output import style
from svu_mi.output.compare import AROUND, CERTAIN, Comparison
from svu_mi.output.figures import albedo_colors, map_colors
from svu_mi.output.manifest import environment_record, write_manifest
from svu_mi.output.page import Picture, drawing, percent, write_page
from svu_mi.output.result import words
from svu_mi.output.surface_maps import ENDS, ENTROPY
from svu_mi.results.transaction import writing

TEMPLATE, RECORD = "compare.html", "compare.json"
SIDE = 384  # pixels of a map
SIGNED = "RdBu_r"  # blue is less, red is more
LARGEST = (0.05, 0.1, 0.25, 0.5, 1.0)  # differences at the ends of a scale
SHOWN = 0.98  # part of the texels whose differences the scale does not clip


def write_comparison(
    found: Comparison, folder: str | os.PathLike[str], *, settings: Mapping[str, Any] | None = None
) -> None:
    """Write ``compare.html``, ``compare.json`` and a ``difference_*.exr`` of every map.

    An EXR has the difference (Y, or R, G, B), ``deviations`` where these are known, and
    ``compared``: 1 where both sides have a value; all others are 0 elsewhere.

    Raises:
        OutputError: a file cannot be written.
    """
    with writing(folder, "compare", RECORD) as draft:
        for name in found.maps:
            _write_map(found, name, draft.folder / f"difference_{name}.exr")
        write_page(
            draft.folder / TEMPLATE, TEMPLATE, found=found, certain=CERTAIN, around=AROUND,
            signed=SIGNED, maps=[_pictures(found, name) for name in found.maps],
            rows=[_row(found, name) for name in found.maps],
        )  # fmt: skip
        write_manifest(draft.folder / RECORD, {
            "sentence": found.sentence(),
            "sides": [{"name": one.name, "about": one.about, "mesh": one.key}
                      for one in found.sides],
            "resolution": found.surface.resolution, "seen_part": found.seen_part,
            "tolerance": found.tolerance, "certain": CERTAIN, "notes": found.notes,
            "differences": {name: {"all": one.figures} for name, one in found.maps.items()},
            "settings": settings, "environment": environment_record(), **draft.entries(),
        })  # fmt: skip


def _write_map(found: Comparison, name: str, path: Path) -> None:
    one, image = found.maps[name], found.image(name)
    channels = {
        "RGB" if image.ndim == 3 else "Y": image,
        "compared": found.surface.to_image(np.isfinite(one.values).all(axis=1), 0).astype("f4"),
    }
    if one.deviations is not None:
        channels["deviations"] = found.image(f"{name}_deviations")
    planes = {key: np.nan_to_num(plane) for key, plane in channels.items()}
    write_exr(path, planes, {"svu:version": svu_mi.__version__})


def _pictures(found: Comparison, name: str) -> dict[str, Any]:
    """Return the pictures of a map: both sides, their difference, and where it is certain."""
    one, sure = found.maps[name], None
    colormap = ENTROPY.colormap if name == "entropy" else style.VALUES_COLORMAP
    worst = np.abs(np.nan_to_num(one.values)).argmax(axis=1)[:, None]
    size = np.take_along_axis(one.values, worst, axis=1)
    high = float(np.nanquantile(np.abs(size), SHOWN))
    limit = next((end for end in LARGEST if high <= end), LARGEST[-1])
    if one.deviations is not None:
        certain = np.where(np.abs(one.deviations) <= CERTAIN, 0, one.deviations)
        sure = _picture(found, certain, (-3 * CERTAIN, 3 * CERTAIN), SIGNED)
    return {
        "name": words(name), "colormap": None if name == "base_color" else colormap,
        "ends": ENDS.get(name, ENTROPY.ends), "limit": limit, "sure": sure,
        "sides": [_picture(found, values, (0, 1), colormap) for values in one.both],
        "difference": _picture(found, size, (-limit, limit), SIGNED),
    }  # fmt: skip


def _picture(
    found: Comparison, values: np.ndarray, limits: tuple[float, float], colormap: str
) -> Picture:
    """Return values (T,) or (T, C) as a map, grey where not both have one."""
    table = values.reshape(len(values), -1)
    compared = np.isfinite(table).all(axis=1)
    table = np.where(compared[:, None], table, 0)
    shown: Any = SimpleNamespace(texels=found.surface, coverage=compared)
    if table.shape[1] == 3:
        image = albedo_colors(shown, table)
    else:
        image = map_colors(shown, table[:, 0], limits=limits, colormap=colormap)
    return drawing(np.dstack([image, found.surface.inside()]), SIDE)


def _row(found: Comparison, name: str) -> list[str]:
    """Return the row of a map in the table of figures."""
    one = found.maps[name].figures
    shares = ["–" if (share := one[key]) is None else percent(share)
              for key in ("beyond", "certain")]  # fmt: skip
    lengths = [f"{one[key]:.4f}" for key in ("median", "rms")]
    mean, decibels = f"{one['mean']:+.4f}", f"{one['psnr']:.1f} dB"
    return [words(name).capitalize(), mean, *lengths, decibels, *shares]
