"""Files of ``svu compare``: ``compare.html``, ``compare.json`` and difference maps."""

import os
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
SIDE, SIGNED = 384, "RdBu_r"  # pixels of a map; colormap: blue is less, red is more
LARGEST = (0.05, 0.1, 0.25, 0.5, 1.0)  # possible ends of difference scales
SHOWN = 0.98  # quantile of differences within the scale


def write_comparison(
    comparison: Comparison, folder: str | os.PathLike[str], *, settings: Any = None
) -> None:
    """Write ``compare.html``, ``compare.json`` and one ``difference_*.exr`` per map.

    Each EXR contains the difference (Y, or R, G, B), the difference in standard deviations
    (``deviations``, if known), and ``compared``, which is 1 where both sides have a value.
    Elsewhere all channels are 0.
    """
    attributes = {"svu:version": svu_mi.__version__}
    with writing(folder, "compare", RECORD) as draft:
        for name, one in comparison.maps.items():
            planes = {"RGB" if one.values.shape[2] == 3 else "Y": one.values,
                      "compared": np.isfinite(one.values).all(axis=2)}  # fmt: skip
            planes |= {} if one.deviations is None else {"deviations": one.deviations}
            planes = {key: np.nan_to_num(np.float32(plane)) for key, plane in planes.items()}
            write_exr(draft.folder / f"difference_{name}.exr", planes, attributes)
        write_page(
            draft.folder / TEMPLATE, TEMPLATE, comparison=comparison, certain=CERTAIN,
            around=AROUND, signed=SIGNED, maps=[_pictures(comparison, n) for n in comparison.maps],
        )  # fmt: skip
        write_manifest(draft.folder / RECORD, {
            "sentence": comparison.sentence(),
            "sides": [{"name": s.name, "about": s.about, "mesh": s.key} for s in comparison.sides],
            "resolution": comparison.area.shape[::-1], "seen_part": comparison.seen_part,
            "tolerance": comparison.tolerance, "certain": CERTAIN, "notes": comparison.notes,
            "differences": {name: {"all": one.figures} for name, one in comparison.maps.items()},
            "settings": settings, "environment": environment_record(), **draft.entries(),
        })  # fmt: skip


def _pictures(comparison: Comparison, name: str) -> dict[str, Any]:
    """Return figures and pictures of a map: both sides, difference, significant difference."""
    one, sure = comparison.maps[name], None
    colormap = ENTROPY.colormap if name == "entropy" else style.VALUES_COLORMAP
    size = largest(one.values)
    high = float(np.nanquantile(np.abs(size), SHOWN))
    limit = next((end for end in LARGEST if high <= end), LARGEST[-1])

    def draw(image: np.ndarray, limits: tuple[float, float], colormap: str) -> PageImage:
        """Draw a map (H, W, C): grey where NaN, transparent outside the charts."""
        known, values = np.isfinite(image).all(axis=2, keepdims=True), np.nan_to_num(image)
        colors = style.colors(values[..., 0], limits, colormap)
        if values.shape[2] == 3:
            colors = srgb(np.clip(values, 0, 1))
        colors = np.where(known, colors, style.UNSEEN)
        return embedded_png(np.dstack([colors, comparison.area > 0]), SIDE)

    if one.deviations is not None:
        certain = np.where(np.abs(one.deviations) <= CERTAIN, 0, one.deviations)
        sure = draw(certain, (-3 * CERTAIN, 3 * CERTAIN), SIGNED)
    return {
        "name": label_of(name), "colormap": None if name == "base_color" else colormap,
        "ends": ENDS.get(name, ENTROPY.ends), "limit": limit, "sure": sure,
        "sides": [draw(values, (0, 1), colormap) for values in one.both],
        "difference": draw(size, (-limit, limit), SIGNED), "figures": one.figures,
    }  # fmt: skip
