"""``compare.html``, ``compare.json`` and difference maps: the files of ``svu compare``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

import svu_mi
from svu_mi.capture.tonemap import srgb
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.output_folder import writing
from svu_mi.output import style
from svu_mi.output.compare.differences import AROUND, CERTAIN, Comparison, largest
from svu_mi.output.estimate_arrays import label_of
from svu_mi.output.html import PageImage, embedded_png, write_page
from svu_mi.output.run_record import environment_record, write_manifest
from svu_mi.output.surface_maps import ENDS, ENTROPY

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
        for name, one in found.maps.items():
            planes = {"RGB" if one.values.shape[2] == 3 else "Y": one.values,
                      "compared": np.isfinite(one.values).all(axis=2)}  # fmt: skip
            planes |= {} if one.deviations is None else {"deviations": one.deviations}
            write_exr(
                draft.folder / f"difference_{name}.exr",
                {key: np.nan_to_num(np.float32(plane)) for key, plane in planes.items()},
                {"svu:version": svu_mi.__version__},
            )
        write_page(
            draft.folder / TEMPLATE, TEMPLATE, found=found, certain=CERTAIN, around=AROUND,
            signed=SIGNED, maps=[_pictures(found, name) for name in found.maps],
        )  # fmt: skip
        write_manifest(draft.folder / RECORD, {
            "sentence": found.sentence(),
            "sides": [{"name": one.name, "about": one.about, "mesh": one.key}
                      for one in found.sides],
            "resolution": found.area.shape[::-1], "seen_part": found.seen_part,
            "tolerance": found.tolerance, "certain": CERTAIN, "notes": found.notes,
            "differences": {name: {"all": one.figures} for name, one in found.maps.items()},
            "settings": settings, "environment": environment_record(), **draft.entries(),
        })  # fmt: skip


def _pictures(found: Comparison, name: str) -> dict[str, Any]:
    """Return figures and pictures of a map: both sides, their difference, and where certain."""
    one, sure = found.maps[name], None
    colormap = ENTROPY.colormap if name == "entropy" else style.VALUES_COLORMAP
    size = largest(one.values)
    high = float(np.nanquantile(np.abs(size), SHOWN))
    limit = next((end for end in LARGEST if high <= end), LARGEST[-1])
    if one.deviations is not None:
        certain = np.where(np.abs(one.deviations) <= CERTAIN, 0, one.deviations)
        sure = _picture(found, certain, (-3 * CERTAIN, 3 * CERTAIN), SIGNED)
    return {
        "name": label_of(name), "colormap": None if name == "base_color" else colormap,
        "ends": ENDS.get(name, ENTROPY.ends), "limit": limit, "sure": sure,
        "sides": [_picture(found, values, (0, 1), colormap) for values in one.both],
        "difference": _picture(found, size, (-limit, limit), SIGNED), "figures": one.figures,
    }  # fmt: skip


def _picture(
    found: Comparison, image: np.ndarray, limits: tuple[float, float], colormap: str
) -> PageImage:
    """Draw a map (H, W, C), grey where not both have a value, transparent outside the charts."""
    known, values = np.isfinite(image).all(axis=2, keepdims=True), np.nan_to_num(image)
    if values.shape[2] == 3:
        colors = srgb(np.clip(values, 0, 1))
    else:
        colors = style.colors(values[..., 0], limits, colormap)
    colors = np.where(known, colors, style.UNSEEN)
    return embedded_png(np.dstack([colors, found.area > 0]), SIDE)
