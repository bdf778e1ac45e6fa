"""Pictures of a report: photographs, turntable, maps, errors of renders."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from svu_mi.calibration.light.light_estimate import LightEstimate
from svu_mi.capture.capture import Capture
from svu_mi.capture.tonemap import block_means, tone_mapped, with_bounds
from svu_mi.core.arrays import evenly_spaced
from svu_mi.output import object_views, rerender, surface_maps
from svu_mi.output.estimate_arrays import is_seen, open_axes
from svu_mi.output.html import (
    NARROW_SPACE,
    THUMBNAIL,
    PageImage,
    embedded_jpeg,
    embedded_png,
    grouped,
    percent,
)
from svu_mi.output.interval_summary import Intervals
from svu_mi.output.light_page import deviation_colors, known_colors, light_colors, upright
from svu_mi.output.panels import map_colors
from svu_mi.output.report.report_plots import Plot
from svu_mi.output.report.turntable import Turntable
from svu_mi.output.rerender import RenderComparison
from svu_mi.output.surface_maps import SurfaceMap
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.svbrdf_textures import Textures, lay_out
from svu_mi.recovery.uncertainty.texture_field import TextureField

SHOWN = 60  # largest number of photographs in a report
FIRST = 12  # photographs outside the collapsed part
SHOWN_LEFT_OUT = 12
OVERSAMPLED = 4  # subsampling keeps this many pixels per thumbnail pixel and axis
MAP_SIDE = 256  # pixels of a texture's longer side
CHECKS, LIGHT, DARK = 24, 0.72, 0.5  # chequers across a texture, and their two greys

COMPARED = 30  # largest number of rendered views
ERROR_SIDE = 64  # pixels of renders for error values
SAMPLES = 36  # per pixel, for error values: the noise must be below the error
SHOWN_SIDE, SHOWN_SAMPLES = 224, 16  # pixels and samples of renders that are shown
CHART_WIDTH = 900  # pixels

MapPictures = tuple[SurfaceMap, PageImage, PageImage]  # map, on the object, as a texture


def thumbnails(
    capture: Capture, estimate: Estimate
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return thumbnails of used photographs and of some unused ones.

    The entry ``first`` is True for thumbnails outside the collapsed part of the page.
    """
    used = [view for view in range(capture.count) if capture.used[view]]
    left_out = [view for view in range(capture.count) if not capture.used[view]]
    seen = dict(zip(used, np.asarray(estimate.seen_per_view), strict=False))
    chosen = [used[k] for k in evenly_spaced(len(used), SHOWN)]
    first = [chosen[k] for k in evenly_spaced(len(chosen), FIRST)]

    def thumbnail(view: int, notes: str, first: bool) -> dict[str, Any]:
        return {"picture": embedded_jpeg(_thumbnail(capture, view)), "name": capture.names[view],
                "notes": notes, "first": first}  # fmt: skip

    def notes(view: int) -> str:
        part = seen.get(view, 0) / max(estimate.texels.count, 1)
        facts = [f"shows {percent(part)} of the points"]
        saturation = capture.clipped[view] if capture.clipped else None
        saturated = 0 if saturation is None else int((saturation.channels > 0).sum())
        kinds = {"saturated": saturated, "unusable": capture.unusable[view] - saturated}
        facts += [
            f"{grouped(n)} {kind} pixel{'s' * (n != 1)}" for kind, n in kinds.items() if n > 0
        ]
        if saturated and capture.masks[view] is None:
            facts.append("with the background")
        if capture.exposures[view] != 1:
            facts.append(f"exposure × {capture.exposures[view]:#.3g}")
        return ", ".join(facts)

    return [thumbnail(view, notes(view), view in first) for view in chosen], [
        thumbnail(view, _why_left_out(capture.images[view]), True)
        for view in left_out[:SHOWN_LEFT_OUT]
    ]


def _thumbnail(capture: Capture, view: int) -> np.ndarray:
    """Return a photograph at thumbnail size, exposed for the object."""
    image, mask = with_bounds(capture, view), capture.masks[view]
    step = max(max(image.shape[:2]) // (OVERSAMPLED * THUMBNAIL), 1)  # limits the cost
    image, mask = image[::step, ::step], None if mask is None else mask[::step, ::step]
    # Average whole blocks, which is fast; Pillow does the remaining reduction.
    step = max(max(image.shape[:2]) // THUMBNAIL, 1)
    across, down = (min(step, size) for size in image.shape[1::-1])
    small = block_means(image, across, down)
    if mask is not None:
        mask = mask[down // 2 :: down, across // 2 :: across][: len(small), : small.shape[1]]
    return tone_mapped(small, mask)


def _why_left_out(image: np.ndarray) -> str:
    """Return a possible reason why a photograph is unused."""
    usable = image[np.isfinite(image).all(axis=2)]
    if usable.size == 0:
        return "no photograph, or no usable pixel"
    return "entirely black" if usable.max() <= 0 else "excluded on request, or unlike the others"


def turntable_pictures(
    table: Turntable, estimate: Estimate
) -> Iterator[tuple[PageImage, str, str]]:
    """Yield turntable pictures of the entropy, with alternative texts and captions."""
    colors = map_colors(estimate)
    for number in range(len(table.sensors)):
        angle = f"{360 * number / len(table.sensors):.0f}°"
        words = f"Entropy on the object, turned by {angle}"
        yield embedded_png(table.frame(colors, number)), words, angle


def map_pictures(table: Turntable, estimate: Estimate, intervals: Intervals) -> list[MapPictures]:
    """Return pictures of entropy, coverage and, if any texel is seen, each open parameter."""
    shown = surface_maps.entropy_maps(estimate)
    for name in open_axes(estimate) if is_seen(estimate).any() else ():
        shown += [
            surface_maps.most_probable(estimate, name),
            surface_maps.uncertainty(estimate, name, intervals),
        ]
    return _pictures(table, shown, estimate.texels.inside(), unseen=_chequers(estimate))


def texture_maps(
    table: Turntable, estimate: Estimate, textures: Textures, field: TextureField | None = None
) -> list[MapPictures]:
    """Return pictures of recovered textures, and of their uncertainty if ``field`` is given."""
    inside = estimate.texels.inside()
    if textures.resolution != estimate.texels.resolution:
        inside = np.ones(textures.resolution[::-1], bool)
    shown = surface_maps.recovered_maps(textures)
    shown += [] if field is None else surface_maps.field_maps(field, estimate)
    return _pictures(table, shown, inside)


def light_maps(light: LightEstimate, up: np.ndarray) -> list[tuple[str, str, PageImage]]:
    """Return names, sentences and pictures of estimated light, with ``up`` (3,) at the top."""
    maps = (
        ("Radiance", "Lat-long map: up is at the top, azimuth 0 at the left.",
         light_colors(light.radiance)),
        ("Standard deviation", "Of the logarithm of radiance. Dark: certain; yellow: may be "
         "several times brighter or darker.", deviation_colors(light)),
        ("Fraction determined", "Dark: by the photographs; yellow: by the prior, because no glossy "
         "part of the object mirrors that direction.", known_colors(light)),
    )  # fmt: skip
    return [(name, words, embedded_png(upright(colors, up))) for name, words, colors in maps]


def _chequers(estimate: Estimate) -> np.ndarray:
    """Return a chequered image (H, W, 3) that marks unseen texels of colour maps."""
    width, height = estimate.texels.resolution
    rows, columns = np.mgrid[:height, :width]
    size = max(max(height, width) / CHECKS, 1)
    odd = (rows // size + columns // size) % 2 > 0
    return np.repeat(np.where(odd, LIGHT, DARK)[..., None], 3, axis=2)


def _pictures(
    table: Turntable, shown: Iterable[SurfaceMap], inside: np.ndarray, **options: Any
) -> list[MapPictures]:
    """Return maps with pictures on the object and as a texture (see ``SurfaceMap.colors``)."""
    drawn = []
    for one in shown:
        colors = one.colors(**options)
        texture = embedded_png(np.dstack([colors, inside.astype(np.float32)]), MAP_SIDE)
        drawn.append((one, embedded_png(table.frame(colors, 0)), texture))
    return drawn


def render_errors(capture: Capture, textures: Textures, grey: bool) -> dict[str, Any] | None:
    """Compare photographs with renders of recovered textures; if ``grey``, brightness only.

    Returns the mean differences of evenly spaced views, a chart of them, and pictures of the
    best, median and worst view. None if no photograph shows the object.
    """
    used = [view for view in range(capture.count) if capture.used[view]]
    some = [used[k] for k in evenly_spaced(len(used), COMPARED)]
    compared = _compare(capture, textures, some, grey, (ERROR_SIDE, SAMPLES))
    errors = {c.view: e for c in compared if (e := c.mean_difference) is not None}
    if not errors:
        return None
    values = np.array(list(errors.values()))
    rows = [(capture.names[view], _percent(error)) for view, error in errors.items()]
    order = np.array(list(errors))[np.argsort(values, kind="stable")].tolist()
    extremes = list(dict.fromkeys([order[0], order[len(order) // 2], order[-1]]))
    size = SHOWN_SIDE, SHOWN_SAMPLES
    return {
        "rows": rows, "mean": _percent(values.mean()), "chart": _chart(values, rows),
        "views": len(used),
        "shown": [(capture.names[c.view], _comparison_pictures(c), _percent(errors[c.view]))
                  for c in _compare(capture, textures, extremes, grey, size)],
    }  # fmt: skip


def most_probable_textures(estimate: Any) -> Textures | None:
    """Return the most probable parameters as textures; None unless they are ``principled``."""
    best = {name: np.array(values) for name, values in estimate.posterior.map().items()}
    if set(best) != set(NAMES):
        return None
    color = best["base_color"].reshape(estimate.texels.count, -1)
    best["base_color"] = np.broadcast_to(color, (len(color), CHANNELS["base_color"]))
    return lay_out(estimate.texels, best)


def _chart(values: np.ndarray, rows: list[tuple[str, str]]) -> Plot:
    ends = [(0.5, rows[0][0]), (len(rows) - 0.5, rows[-1][0])]
    return Plot(
        alt="Mean difference of each view.", edges=np.arange(len(values) + 1), heights=values,
        labels=[": ".join(row) for row in rows], top=1.1 * max(values.max(), 0.01),
        x_ticks=ends[: len(rows)], y_ticks=[(0, "0"), (values.max(), _percent(values.max()))],
        width=CHART_WIDTH,
    )  # fmt: skip


def _compare(
    capture: Capture, textures: Textures, chosen: list[int], grey: bool, size: tuple[int, int]
) -> list[RenderComparison]:
    """Compare the chosen views; ``size`` is (longer side in pixels, samples per pixel)."""
    side, spp = size
    compared = rerender.compare_renders(capture, textures, chosen, spp, side, relit=False)

    def brightness(image: np.ndarray) -> np.ndarray:
        return np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)

    return [
        replace(c, photograph=brightness(c.photograph), render=brightness(c.render)) if grey else c
        for c in compared
    ]


def _comparison_pictures(comparison: RenderComparison) -> list[PageImage]:
    window = object_views.object_window(comparison.inside)
    usable = np.isfinite(comparison.difference)
    image, render, difference, inside, usable = (
        object_views.crop(i, window) for i in (*comparison.pictures, comparison.inside, usable)
    )
    return [
        embedded_jpeg(image), embedded_png(np.dstack([render, inside])),
        embedded_png(np.dstack([difference, usable])),
    ]  # fmt: skip


def _percent(difference: float) -> str:
    return f"{100 * difference:.1f}{NARROW_SPACE}%"
