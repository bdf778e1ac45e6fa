"""``compare.html``, difference maps and ``compare.json``: what differs between two results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import svu_mi
from svu_mi.capture.poses import sphere_sensors
from svu_mi.capture.shown import srgb
from svu_mi.exr import write_exr
from svu_mi.output import style
from svu_mi.output.compare import Comparison
from svu_mi.output.compare_difference import AROUND, CERTAIN, Difference, Figures
from svu_mi.output.figures import GUTTER, map_colors
from svu_mi.output.manifest import environment_record, write_manifest
from svu_mi.output.page import Picture, drawing, percent, write_page
from svu_mi.output.report.turntable import Turntable
from svu_mi.output.result import words
from svu_mi.output.surface_maps import ENDS, ENTROPY
from svu_mi.results.writing import writing
from svu_mi.surface.gutter import dilate

TEMPLATE, RECORD = "compare.html", "compare.json"
SIDE, MAP_SIDE, FRAMES = 240, 384, 4  # pixels of a picture of the object, of a map; turns
SIGNED = "RdBu_r"  # blue is less, red is more, and white none
MOST = 3 * CERTAIN  # standard deviations at the ends of a scale
LARGEST = (0.05, 0.1, 0.25, 0.5, 1.0)  # differences at the ends of a scale
SHOWN = 0.98  # part of the texels whose differences the scale does not clip
ROWS = 12  # charts in a table, those that differ most


def write_comparison(
    found: Comparison, folder: str | Path, *, settings: Mapping[str, Any] | None = None
) -> None:
    """Write ``compare.html``, ``compare.json`` and a ``difference_*.exr`` of every map.

    An EXR has the difference (Y, or R, G, B), ``deviations`` where these are known, and
    ``compared``: 1 where both sides have a value; all others are 0 elsewhere.

    Args:
        found: what was found.
        folder: made if missing.
        settings: what the caller was asked for.

    Raises:
        OutputError: a file cannot be written.
    """
    with writing(folder, "compare", RECORD) as draft:
        for name, one in _all(found).items():
            _write_map(found, one, draft.folder / f"difference_{name}.exr")
        drawn = _Drawn.of(found)
        write_page(
            draft.folder / TEMPLATE, TEMPLATE,
            sentence=found.sentence(), sides=found.sides, notes=found.notes,
            numbers=_numbers(found), certain=CERTAIN, around=AROUND, most=f"{MOST:g}",
            signed=SIGNED, parts_=list(_parts(found, drawn)), unseen=style.UNSEEN,
            tolerance=found.tolerance, figures=_figures(found), charts=_charts(found),
            size=found.surface.size, on_object=drawn.table is not None,
        )  # fmt: skip
        write_manifest(draft.folder / RECORD, {
            "sentence": found.sentence(), "sides": [_side(side) for side in found.sides],
            "resolution": found.surface.size, "seen_part": found.seen_part,
            "tolerance": found.tolerance, "certain": CERTAIN, "notes": found.notes,
            "differences": {
                name: {"all": one.figures, "charts": one.charts}
                for name, one in _all(found).items()
            },
            "settings": settings, "environment": environment_record(), **draft.entries(),
        })  # fmt: skip


def _all(found: Comparison) -> dict[str, Difference]:
    entropy = {} if found.entropy is None else {"entropy": found.entropy}
    return {**found.differences, **entropy}


def _side(side: Any) -> dict[str, Any]:
    return {"name": side.name, "about": side.about, "mesh": side.key}


def _write_map(found: Comparison, one: Difference, path: Path) -> None:
    compared = np.isfinite(one.values).all(axis=1)
    letters = "RGB" if one.values.shape[1] == 3 else "Y"
    channels = {letters: one.values, "compared": compared.astype(np.float32)}
    if one.deviations is not None:
        channels["deviations"] = one.deviations
    images = {
        name: found.surface.to_image(np.nan_to_num(values)) for name, values in channels.items()
    }
    write_exr(path, images, {"svu:version": svu_mi.__version__})


@dataclass(frozen=True, kw_only=True)
class _Drawn:
    """Draws values of texels.

    Attributes:
        found: the comparison.
        table: the object, None if its mesh is not known.
    """

    found: Comparison
    table: Turntable | None

    @classmethod
    def of(cls, found: Comparison) -> _Drawn:
        mesh = found.surface.mesh
        if mesh is None:
            return cls(found=found, table=None)
        known = [side.sensors for side in found.sides if side.sensors]
        sensors = known[0] if known else sphere_sensors(mesh, FRAMES, (SIDE, SIDE))
        around: Any = SimpleNamespace(mesh=mesh, sensors=sensors, used_sensors=sensors)
        return cls(found=found, table=Turntable.around(around, FRAMES, SIDE))

    def colors(self, values: np.ndarray, limits: tuple[float, float], colormap: str) -> np.ndarray:
        """Return values (T,) as a texture (H, W, 3); grey where not both have one."""
        compared = np.isfinite(values)
        stand_in: Any = SimpleNamespace(texels=self.found.surface, coverage=compared)
        return map_colors(
            stand_in, np.where(compared, values, 0), limits=limits, colormap=colormap, gutter=GUTTER
        )

    def colors_of_base(self, values: np.ndarray) -> np.ndarray:
        """Return linear colours (T, 3) as a texture (H, W, 3)."""
        surface, compared = self.found.surface, np.isfinite(values).all(axis=1)
        shown = srgb(np.clip(np.where(compared[:, None], values, 0), 0, 1))
        shown[~compared] = style.UNSEEN
        image, inside = surface.to_image(shown), surface.inside()
        image[~inside] = style.OUTSIDE
        return dilate(image, inside, GUTTER)

    def pictures(self, texture: np.ndarray, frames: int) -> tuple[list[Picture], Picture]:
        """Return a texture on the object, from so many sides, and by itself."""
        inside = self.found.surface.inside().astype(np.float32)
        shown = range(frames) if self.table is not None else ()
        on_object = [drawing(self.table.frame(texture, k)) for k in shown if self.table]
        return on_object, drawing(np.dstack([texture, inside]), MAP_SIDE)


def _parts(found: Comparison, drawn: _Drawn) -> Iterator[dict[str, Any]]:
    """Yield what the page shows of every map: where it certainly differs, both, and by how much."""
    for name, one in _all(found).items():
        size = one.values[np.arange(len(one.values)), np.abs(np.nan_to_num(one.values)).argmax(1)]
        limit = _limit(size)
        colormap, ends = ENTROPY.colormap, ENTROPY.ends
        if name != "entropy":
            colormap, ends = style.VALUES_COLORMAP, ENDS[name]
        both = [
            (side.name, drawn.pictures(texture, 1))
            for side, texture in zip(found.sides, _textures(found, drawn, name), strict=True)
        ]
        sure = None
        if one.deviations is not None:
            shown = np.where(one.certain | np.isnan(one.deviations), one.deviations, 0)
            sure = drawn.pictures(drawn.colors(shown, (-MOST, MOST), SIGNED), FRAMES)
        yield {
            "name": words(name), "sure": sure, "both": both, "limit": f"{limit:g}",
            "difference": drawn.pictures(drawn.colors(size, (-limit, limit), SIGNED), 1),
            "colormap": None if name == "base_color" else colormap, "ends": ends,
            "figures": one.figures,
        }  # fmt: skip


def _textures(found: Comparison, drawn: _Drawn, name: str) -> Iterator[np.ndarray]:
    for side in found.sides:
        image = np.asarray(side.entropy)[..., None] if name == "entropy" else side.values[name]
        values = found.surface.read(image)
        values[~found.seen] = np.nan
        if values.shape[1] == 3:
            yield drawn.colors_of_base(values)
            continue
        colormap = ENTROPY.colormap if name == "entropy" else style.VALUES_COLORMAP
        yield drawn.colors(values[:, 0], (0, 1), colormap)


def _limit(values: np.ndarray) -> float:
    """Return the difference at the ends of the scale."""
    high = float(np.nanquantile(np.abs(values), SHOWN))
    return next((limit for limit in LARGEST if high <= limit), LARGEST[-1])


def _numbers(found: Comparison) -> Iterator[tuple[str, str, str]]:
    """Yield names, values and notes of the head of the page."""
    yield "Compared", percent(found.seen_part), "of the surface, which both show"
    for name, one in found.differences.items():
        figures, title = one.figures, words(name).capitalize()
        if figures.certain is None:
            how = f"by more than {found.tolerance:g}"
            yield f"{title} differs on", percent(figures.beyond), how
        else:
            by = "" if figures.certain_mean is None else f", by {figures.certain_mean:+.3f} there"
            yield f"{title} differs on", percent(figures.certain), f"certainly{by}"
    if found.entropy is not None:
        yield "Mean entropy", f"{found.entropy.figures.mean:+.3f}", "less is better known"


def _figures(found: Comparison) -> list[list[str]]:
    return [_row(words(name).capitalize(), one.figures) for name, one in _all(found).items()]


def _row(title: str, one: Figures) -> list[str]:
    certain = "–" if one.certain is None else percent(one.certain)
    return [
        title, f"{one.mean:+.4f}", f"{one.median:.4f}", f"{one.rms:.4f}", f"{one.psnr:.1f} dB",
        percent(one.beyond), certain,
    ]  # fmt: skip


def _charts(found: Comparison) -> list[list[str]]:
    """Return rows of the charts that differ most: number, part of the surface, and parameters."""
    surface = found.surface
    area = np.bincount(surface.chart, surface.area)
    count = max((len(one.charts) for one in found.differences.values()), default=0)
    if count < 2:
        return []
    shares = np.zeros((len(found.differences), count))
    for row, one in zip(shares, found.differences.values(), strict=True):
        for chart, figures in enumerate(one.charts):
            if figures is not None:
                row[chart] = figures.differs
    order = np.argsort(-shares.max(axis=0), kind="stable")[:ROWS]
    return [
        [f"{chart + 1}", percent(area[chart] / area.sum()), *map(percent, shares[:, chart])]
        for chart in order
    ]  # fmt: skip
