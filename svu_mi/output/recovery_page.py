"""``recovery.png``: page with renders, recovered textures and their uncertainty."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.tonemap import ObjectView, object_only_scene, srgb
from svu_mi.errors import counted
from svu_mi.output import style
from svu_mi.output.estimate_arrays import is_seen, label_of, texel_areas
from svu_mi.output.html import grouped
from svu_mi.output.interval_summary import area_share, plain_percent
from svu_mi.output.panels import draw_look, draw_scaled_map, fully_seen, map_colors
from svu_mi.output.rerender import SIDE, WORST, RenderComparison
from svu_mi.output.style import GREY, LEFT, OUTSIDE, RIGHT, VIEWS_COLORMAP, Block, Panel
from svu_mi.output.texture_samples import texture_colors
from svu_mi.parameters import NAMES
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.recovery_result import Recovery
from svu_mi.recovery.uncertainty.texture_field import TextureField

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = (18.0, 10.2)  # inches
HEADING = "Reflectance recovered from the photographs"
TITLES = tuple(label_of(name).capitalize() for name in NAMES)
GREYS = "grey: never seen"


def write_recovery_overview(
    capture: Capture,
    recovery: Recovery,
    comparisons: Sequence[RenderComparison],
    path: str | Path,
    estimate: Estimate | None = None,
    field: TextureField | None = None,
) -> None:
    """Draw render comparisons, textures and uncertainty (1800 x 1020 pixels).

    ``estimate`` provides the entropy and, without ``field``, the standard deviations.
    """
    scene = object_only_scene(capture)
    objects: list[Panel | None] = []
    for row, comparison in enumerate(comparisons[:2]):
        look = ObjectView.at(scene, capture.sensors[comparison.view], SIDE)
        objects += _comparison_panels(comparison)
        if row:
            objects += _other_panels(look, recovery, comparison, estimate)
            continue
        for title, name in zip(TITLES, NAMES, strict=True):
            colors = texture_colors(recovery.texels, recovery.textures, name)
            objects.append((title, partial(draw_look, look=look, colors=colors)))
    style.write_page(path, SIZE, HEADING, _notes(capture, recovery, estimate), [
        Block(panels=objects, shape=(2, 6), box=(LEFT, RIGHT, 0.335, 0.875), space=(0.1, 0.13),
              anchor="NW"),
        Block(panels=_maps(recovery, estimate, field), shape=(1, 7), box=(LEFT, RIGHT, 0.07, 0.285),
              space=(0.12, 0), anchor="NW"),
    ])  # fmt: skip


def _notes(capture: Capture, recovery: Recovery, estimate: Estimate | None) -> list[str]:
    width, height = recovery.texels.resolution
    seen = is_seen(recovery if estimate is None else estimate)  # as in the terminal
    return [
        f"method {recovery.method}",
        f"{sum(capture.used)} of {capture.count} views",
        f"{width} × {height} texels, {grouped(recovery.texels.count)} in charts",
        f"{plain_percent(area_share(texel_areas(recovery), seen))} of the surface area seen",
        *([] if estimate is None else [f"preset {estimate.preset.name}"]),
        f"difference: yellow from {WORST:g}, white unused",
        "with sharing" if recovery.settings.get("sharing") else "without sharing",
        counted(len(recovery.losses), "step"),
    ]


def _maps(recovery: Recovery, estimate: Estimate | None, field: TextureField | None) -> list[Panel]:
    """Return panels of textures, standard deviations and entropy, in texture space."""
    inside, everywhere = recovery.texels.inside(), fully_seen(recovery.texels)
    color = np.where(inside[..., None], srgb(np.clip(recovery.image("base_color"), 0, 1)), OUTSIDE)
    panels: list[Panel] = [(TITLES[0], partial(_texture, image=color))]
    for title, name in zip(TITLES[1:], NAMES[1:], strict=True):
        values = recovery.textures.at(recovery.texels, name)
        panels.append((title, partial(_scaled, estimate=everywhere, values=values, colormap=GREY)))
    for title, name in zip(TITLES, NAMES, strict=True):
        sd = None
        if field is not None:
            sd = field.sd(name)
        elif estimate is not None and name in estimate.posterior.axes:
            sd = np.asarray(estimate.posterior.sd(name), np.float32)
        worst = None if sd is None else sd.reshape(len(sd), -1).max(axis=1, initial=0)
        panels.append((f"{title}, sd", partial(
            _scaled, estimate=None if sd is None else estimate, values=worst,
            label=GREYS,
            limits=(0, style.WIDEST_SD), ticks=(0, 0.1, 0.2, style.WIDEST_SD))))  # fmt: skip
    return [*panels, ("Entropy", partial(_scaled, estimate=estimate, label=GREYS))]


def _texture(axes: "Axes", image: np.ndarray) -> None:
    axes.imshow(image)
    style.frame_map(axes)


def _scaled(axes: "Axes", estimate: Any, **options: Any) -> None:
    """Draw a map with a colour bar; if ``estimate`` is None, write "not estimated"."""
    if estimate is None:
        style.frame_map(axes)
        axes.set_box_aspect(1)
        style.write_centered(axes, "not estimated")
    else:
        draw_scaled_map(axes, estimate, **{"ticks": (0, 0.5, 1), **options})


def _comparison_panels(comparison: RenderComparison) -> list[Panel]:
    """Return panels of a photograph, its render and their difference."""
    error = comparison.mean_difference
    titles = (
        style.photograph_title(comparison.name),
        "Rendered with these textures",
        "Difference" if error is None else f"Difference, mean {error:.3f}",
    )  # fmt: skip
    images = comparison.cropped()
    return [(title, partial(style.draw_image, image=image))
            for title, image in zip(titles, images, strict=False)]  # fmt: skip


def _other_panels(
    look: ObjectView, recovery: Recovery, comparison: RenderComparison, estimate: Estimate | None
) -> list[Panel | None]:
    """Return panels of the relit object, its entropy and its coverage."""
    coverage, made = np.array(recovery.coverage), cast(Any, recovery)  # used like an estimate
    limits = (0, max(float(coverage.max(initial=0)), 1.0))
    views = map_colors(made, coverage, limits=limits, colormap=VIEWS_COLORMAP)
    return [
        ("Under another light", partial(style.draw_image, image=comparison.cropped()[3])),
        None if estimate is None else
        ("Entropy", partial(draw_look, look=look, colors=map_colors(estimate))),
        ("Coverage", partial(draw_look, look=look, colors=views)),
    ]  # fmt: skip
