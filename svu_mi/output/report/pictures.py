"""Pictures of a report: photographs, the object on a turntable, maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.output import views
from svu_mi.output.figures import GUTTER, map_colors
from svu_mi.output.knowledge import TOLERANCE, WIDEST, Intervals
from svu_mi.output.page import THUMBNAIL, Picture, drawing, grouped, percent
from svu_mi.output.page import photograph as embedded
from svu_mi.output.report.findings import why_left_out
from svu_mi.output.report.turntable import Turntable
from svu_mi.output.result import Result, open_axes, words
from svu_mi.output.style import COLORMAP, VIEWS_COLORMAP
from svu_mi.parameters import NAMES
from svu_mi.recovery.textures import Textures
from svu_mi.surface.gutter import dilate

SHOWN = 60  # photographs in a report; of more, every other, or fewer
FIRST = 12  # of them that are shown without asking
SHOWN_LEFT_OUT = 12
OVERSAMPLED = 4  # pixels that a thumbnail's is averaged over, along each side
VALUES_COLORMAP = "plasma"  # has no grey, which means unseen
ENDS = {"roughness": ("0: mirror", "1: matt"), "metallic": ("0: no metal", "1: metal"),
        "specular": ("0: no gloss", "1: mirror of all light")}  # fmt: skip
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
    """A value of every texel.

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


def entropy_maps(table: Turntable, estimate: Any, result: Result) -> list[Map]:
    """Return maps of the entropy and of the coverage."""
    most = max(int(result.coverage.max(initial=0)), 1)
    return [
        _scaled(
            table, estimate, "Entropy", result.entropy, COLORMAP,
            ("one material left", "nothing known"),
            "What the photographs leave open of all parameters together.",
        ),
        _scaled(
            table, estimate, "Coverage", result.coverage, VIEWS_COLORMAP,
            ("no photograph", f"{most} photographs"),
            "How many photographs see each point; being seen often does not make it known.",
            most,
        ),
    ]  # fmt: skip


def parameter_maps(table: Turntable, estimate: Any, intervals: Intervals) -> list[Map]:
    """Return maps of the most probable value of each open parameter, and of how well it is known.

    Args:
        table: shows the object.
        estimate: the ``Estimate``.
        intervals: of its posterior.
    """
    maps = []
    best = estimate.posterior.map()
    for name in open_axes(estimate):
        values = np.array(best[name], np.float32)
        label = words(name)
        if name == "base_color":
            maps.append(_colored(table, estimate, values))
        else:
            maps.append(_scaled(
                table, estimate, f"Most probable {label}", values, VALUES_COLORMAP, ENDS[name],
                "Of the material that explains the photographs best.",
            ))  # fmt: skip
        widest = "; of the three channels, the least known" if intervals.channels(name) > 1 else ""
        maps.append(_scaled(
            table, estimate, f"Uncertainty of {label}", intervals.half_width(name), COLORMAP,
            ("±0", f"±{WIDEST:g} and more"),
            f"Half the width of its {100 * intervals.level:g} % interval{widest}. Settled is "
            f"±{TOLERANCE:g}, the darkest sixth of these colours.", WIDEST,
        ))  # fmt: skip
    return maps


def texture_maps(table: Turntable, estimate: Any, textures: Textures) -> list[Map]:
    """Return recovered textures as maps."""
    inside = estimate.texels.inside()
    if textures.resolution != estimate.texels.resolution:
        inside = np.ones(textures.resolution[::-1], bool)
    maps = []
    for name in NAMES:
        image = np.clip(np.array(getattr(textures, name), np.float32), 0, 1)
        colors, scale = views.srgb(image), None
        if image.shape[2] == 1:
            colors = _shades(image[..., 0], VALUES_COLORMAP)
            scale = gradient(VALUES_COLORMAP), *ENDS[name]
        maps.append(_map(
            table, f"Recovered {words(name)}", colors, inside, scale,
            "As the recovered texture has it, also where nothing was seen.",
        ))  # fmt: skip
    return maps


def _scaled(
    table: Turntable, estimate: Any, name: str, values: np.ndarray, colormap: str,
    ends: tuple[str, str], sentence: str, most: float = 1,
) -> Map:  # fmt: skip
    colors = map_colors(estimate, values, limits=(0, most), colormap=colormap)
    return _map(
        table, name, colors, estimate.texels.inside(), (gradient(colormap), *ends), sentence
    )


def _colored(table: Turntable, estimate: Any, values: np.ndarray) -> Map:
    """Base colour: grey is a colour here, so what nobody saw is chequered."""
    colors = views.srgb(np.clip(values.reshape(len(values), -1), 0, 1))
    image = estimate.texels.to_image(np.broadcast_to(colors, (len(colors), 3)), 0)
    height, width = image.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    size = max(max(height, width) / CHECKS, 1)
    odd = (rows // size + columns // size) % 2 > 0
    unseen = ~estimate.texels.to_image(np.array(estimate.coverage) > 0, True)
    image[unseen] = np.where(odd, LIGHT, DARK)[unseen][:, None]
    inside = estimate.texels.inside()
    grey = ", in grey: brightness alone was estimated" if values.ndim == 1 else ""
    sentence = f"The colour that explains the photographs best{grey}; chequered where unseen."
    return _map(
        table, "Most probable base colour", dilate(image, inside, GUTTER), inside, None, sentence
    )


def _map(
    table: Turntable, name: str, colors: np.ndarray, inside: np.ndarray,
    scale: tuple[str, str, str] | None, sentence: str,
) -> Map:  # fmt: skip
    opaque = np.dstack([colors, inside.astype(np.float32)])
    front = drawing(table.frame(colors, 0))
    return Map(name, sentence, front, drawing(opaque, MAP_SIDE), scale)


def _shades(values: np.ndarray, colormap: str) -> np.ndarray:
    from matplotlib import colormaps

    return np.array(colormaps[colormap](values)[..., :3], np.float32)


def gradient(colormap: str) -> str:
    """Return a colormap as CSS has it."""
    return ", ".join(hexadecimal(np.linspace(0, 1, 9), colormap))


def hexadecimal(values: np.ndarray, colormap: str = COLORMAP) -> list[str]:
    """Return colours of a colormap as CSS has them."""
    from matplotlib.colors import to_hex

    return [to_hex(color) for color in _shades(values, colormap)]
