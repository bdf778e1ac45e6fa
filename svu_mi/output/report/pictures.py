"""Pictures of a report: photographs, the object on a turntable, maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.output import surface_maps, views
from svu_mi.output.figures import map_colors
from svu_mi.output.knowledge import Intervals
from svu_mi.output.page import THUMBNAIL, Picture, drawing, grouped, percent
from svu_mi.output.page import photograph as embedded
from svu_mi.output.report.findings import why_left_out
from svu_mi.output.report.turntable import Turntable
from svu_mi.output.result import is_seen, open_axes
from svu_mi.output.style import css_gradient
from svu_mi.output.surface_maps import SurfaceMap
from svu_mi.recovery.textures import Textures

SHOWN = 60  # photographs in a report; of more, every other, or fewer
FIRST = 12  # of them that are shown without asking
SHOWN_LEFT_OUT = 12
OVERSAMPLED = 4  # pixels that a thumbnail's is averaged over, along each side
MAP_SIDE = 512  # pixels
CHECKS, LIGHT, DARK = 24, 0.72, 0.5  # fields across a texture and greys of what was not seen


@dataclass(frozen=True)
class Thumbnail:
    """A photograph.

    Attributes:
        picture: small.
        name: of its file.
        notes: what there is to say of it.
        first: whether it is one of those that stand for all.
    """

    picture: Picture
    name: str
    notes: str
    first: bool


@dataclass(frozen=True)
class Map:
    """A ``SurfaceMap`` of a page.

    Attributes:
        name: what it is.
        sentence: what it means.
        on_object: seen from the front.
        picture: laid out as a texture.
        scale: colours of CSS, and the words at both ends; None if the colour is the value.
    """

    name: str
    sentence: str
    on_object: Picture
    picture: Picture
    scale: tuple[str, str, str] | None


def thumbnails(capture: Any, estimate: Any) -> tuple[list[Thumbnail], list[Thumbnail]]:
    """Return photographs that were used, and some that were left out."""
    used = [view for view in range(capture.count) if capture.used[view]]
    seen = dict(zip(used, np.asarray(estimate.seen_per_view), strict=False))
    texels = max(estimate.texels.count, 1)
    chosen = spread(used, SHOWN)
    first, shown = spread(chosen, FIRST), []
    for view in chosen:
        notes = [f"shows {percent(seen.get(view, 0) / texels)} of the points"]
        if capture.unusable[view]:
            notes.append(f"{grouped(capture.unusable[view])} unusable pixels")
        if capture.exposures[view] != 1:
            notes.append(f"exposure × {capture.exposures[view]:.3g}")
        shown.append(_thumbnail(capture, view, ", ".join(notes), view in first))
    left_out = [view for view in range(capture.count) if not capture.used[view]]
    return shown, [
        _thumbnail(capture, view, why_left_out(capture.images[view]), True)
        for view in left_out[:SHOWN_LEFT_OUT]
    ]


def spread(views_: Sequence[int], most: int) -> list[int]:
    """Return at most so many of some views, evenly through their order, the first and the last."""
    if len(views_) <= most:
        return list(views_)
    return [views_[k] for k in np.linspace(0, len(views_) - 1, most).round().astype(int)]


def _thumbnail(capture: Any, view: int, notes: str, first: bool) -> Thumbnail:
    image, mask = capture.images[view], capture.masks[view]
    step = max(max(image.shape[:2]) // (OVERSAMPLED * THUMBNAIL), 1)  # for large ones' sake
    image, mask = image[::step, ::step], None if mask is None else mask[::step, ::step]
    height, width = image.shape[:2]
    scale = min(1.0, THUMBNAIL / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = views.resized(image, size)
    if mask is not None:
        rows = (np.arange(size[1]) + 0.5) * height / size[1]
        columns = (np.arange(size[0]) + 0.5) * width / size[0]
        mask = mask[np.ix_(rows.astype(int), columns.astype(int))]
    return Thumbnail(embedded(views.tone_mapped(small, mask)), capture.names[view], notes, first)


def turning(table: Turntable, estimate: Any) -> list[tuple[Picture, str, str]]:
    """Return the entropy on the object, from all around: pictures, descriptions, captions."""
    colors, frames = map_colors(estimate), []
    for number in range(len(table.sensors)):
        angle = f"{360 * number / len(table.sensors):.0f}°"
        words = f"Entropy on the object, turned by {angle}"
        frames.append((drawing(table.frame(colors, number)), words, angle))
    return frames


def maps(table: Turntable, estimate: Any, intervals: Intervals) -> list[Map]:
    """Return maps of entropy and coverage, and of each open parameter, if any texel is seen.

    Args:
        table: shows the object.
        estimate: the ``Estimate``.
        intervals: of its posterior.
    """
    shown = surface_maps.entropy_maps(estimate)
    for name in open_axes(estimate) if is_seen(estimate).any() else ():
        shown += [
            surface_maps.most_probable(estimate, name),
            surface_maps.uncertainty(estimate, name, intervals),
        ]
    inside, chequers = estimate.texels.inside(), _chequers(estimate)
    return [
        _map(table, one, one.colors(unseen=chequers), inside)
        for one in shown
    ]


def texture_maps(table: Turntable, estimate: Any, textures: Textures) -> list[Map]:
    """Return recovered textures as maps."""
    inside = estimate.texels.inside()
    if textures.resolution != estimate.texels.resolution:
        inside = np.ones(textures.resolution[::-1], bool)
    return [
        _map(table, one, one.colors(), inside) for one in surface_maps.recovered_maps(textures)
    ]


def _chequers(estimate: Any) -> np.ndarray:
    """Return what nobody saw where grey is a colour: fields (H, W, 3) of two greys."""
    width, height = estimate.texels.resolution
    rows, columns = np.mgrid[:height, :width]
    size = max(max(height, width) / CHECKS, 1)
    odd = (rows // size + columns // size) % 2 > 0
    return np.repeat(np.where(odd, LIGHT, DARK)[..., None], 3, axis=2)


def _map(table: Turntable, one: SurfaceMap, colors: np.ndarray, inside: np.ndarray) -> Map:
    opaque = np.dstack([colors, inside.astype(np.float32)])
    front = drawing(table.frame(colors, 0))
    scale = None if one.scale is None else (css_gradient(one.scale.colormap), *one.scale.ends)
    name = one.name[0].upper() + one.name[1:]
    return Map(name, one.sentence, front, drawing(opaque, MAP_SIDE), scale)
