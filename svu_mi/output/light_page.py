"""Files of ``svu light``: estimated light, its uncertainty, and ``light.png``."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.calibration.light.light_estimate import LightEstimate
from svu_mi.calibration.light.light_folder import COMMAND, RECORD, light_record, write_light_arrays
from svu_mi.calibration.light.light_summary import (
    LightComparison,
    channel_factors,
    horizon,
    nearest_axis,
)
from svu_mi.calibration.light.resolve_light import with_light
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import photographs_key
from svu_mi.capture.tonemap import srgb
from svu_mi.capture.up_direction import UP, up_direction
from svu_mi.core.io.output_folder import writing
from svu_mi.light.environment import nearest_node
from svu_mi.light.latlong import directions, radiance_from
from svu_mi.output import object_views, style
from svu_mi.output.interval_summary import plain_percent
from svu_mi.output.rerender import compare_renders
from svu_mi.output.run_record import RunInfo, environment_record, inputs_record, write_manifest
from svu_mi.output.style import LEFT, RIGHT, Block, Panel
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.svbrdf_textures import Textures

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = "light.png"
HEADING = "Light estimated from the photographs"
WIDTH, ROW, REST = 16.0, 5.0, 1.4  # inches: page width, height of a row of maps, margins
PICTURES = 3.6  # inches: height of the pictures of the object
GREY = 0.18  # screen value (linear) of the geometric mean radiance
DARK = 1e-3  # lower bound of radiance, relative to the mean
KNOWN_COLORMAP = f"{style.COLORMAP}_r"  # yellow is uncertain, as on all pages
UNCERTAIN = 1.5  # upper end of the scale of log standard deviations
# Material in these pictures.
GREY_PLASTIC = dict.fromkeys(NAMES, 0.0) | {"base_color": 0.2, "roughness": 0.25}


def write_light(
    capture: Capture, estimate: LightEstimate, folder: str | os.PathLike[str],
    run: RunInfo | None = None, *, used: Mapping[str, Any] | None = None,
    against: LightComparison | None = None, timings: Mapping[str, float] | None = None,
    pictures: bool = True,
) -> None:  # fmt: skip
    """Write ``light.exr``, ``light.npz``, ``light.png`` and ``light.json``.

    ``used`` contains the options of the estimate, ``against`` compares it with the capture's own
    light, and ``timings`` are seconds per stage.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    run = run or RunInfo()
    with writing(folder, COMMAND, RECORD, capture=photographs_key(capture)) as draft:
        write_light_arrays(estimate, draft)
        if pictures:
            write_light_page(capture, estimate, draft.folder / PAGE, against)
        write_manifest(draft.folder / RECORD, {
            "inputs": inputs_record(capture), **light_record(estimate), "against": against,
            "settings": {"used": used, "given": run.settings}, "timings_s": timings,
            "kernels_compiled": run.kernels, "warnings": capture.warnings,
            "environment": environment_record(), **draft.entries(),
        })  # fmt: skip


def write_light_page(
    capture: Capture,
    estimate: LightEstimate,
    path: str | Path,
    against: LightComparison | None = None,
) -> None:
    """Draw lat-long maps of radiance and its uncertainty, and the object under the light.

    ``against`` adds the capture's own light. A light that moves with the camera has no pictures.
    """
    truth, shape = None, estimate.radiance.shape
    if against is not None:
        world = directions(shape[1], shape[0]).reshape(-1, 3)
        truth = radiance_from(capture.environment, world).reshape(shape)
    tone = ToneCurve.of(estimate.radiance if truth is None else truth)
    up = np.array(UP) if estimate.moves else up_direction(capture)
    panels = _radiance_panels("Radiance", estimate.radiance, tone, up)
    if truth is not None:
        panels += _radiance_panels("The capture's own light", truth, tone, up)
    panels += [
        ("Standard deviation of the logarithm of radiance", partial(
            _draw_scaled, values=estimate.sd, limits=(0, UNCERTAIN), up=up,
            label="0.1 is 10 %; includes the common scale")),
        ("Fraction determined by the photographs", partial(
            _draw_scaled, values=estimate.known, limits=(0, 1), colormap=KNOWN_COLORMAP, up=up,
            label="0 = prior only, 1 = fully determined")),
    ]  # fmt: skip
    pictures = [] if estimate.moves else _lit_panels(capture, estimate)
    rows, below = len(panels) // 2, PICTURES if pictures else 0.0
    height = ROW * rows + REST + below
    box = (LEFT + 0.022, RIGHT, (0.9 + below) / height, 1 - 1.25 / height)
    blocks = [Block(panels=panels, shape=(rows, 2), box=box, space=(0.08, 0.34), anchor="N")]
    if pictures:
        box = (LEFT + 0.022, RIGHT, 0.1 / height, (PICTURES - 0.5) / height)
        blocks.append(Block(panels=pictures, shape=(1, 4), box=box, space=(0.05, 0), anchor="NW"))
    style.write_page(path, (WIDTH, height), HEADING, _notes(estimate, against), blocks)


def _lit_panels(capture: Capture, estimate: LightEstimate) -> list[Panel]:
    """Return panels of two photographs and of the object in grey under the estimated light."""
    grey = Textures.of({
        name: np.full((2, 2, CHANNELS[name]), value, np.float32)
        for name, value in GREY_PLASTIC.items()
    })  # fmt: skip
    views = object_views.distant_views(capture, [1] * sum(capture.used))  # of any coverage
    panels: list[Panel] = []
    for one in compare_renders(with_light(capture, estimate), grey, views, relit=False):
        photograph, *_, lit = replace(one, relit=one.render).cropped()  # exposed for itself
        panels += [
            (style.photograph_title(one.name), partial(style.draw_image, image=photograph)),
            ("Grey object in the estimated light", partial(style.draw_image, image=lit)),
        ]
    return panels


def _radiance_panels(
    title: str, radiance: np.ndarray, tone: "ToneCurve", up: np.ndarray
) -> list[Panel]:
    """Return panels of a map (H, W, 3): tone-mapped, and as logarithm."""
    return [
        (title, partial(_draw_colors, colors=tone.colors(radiance), up=up)),
        (f"{title}, log scale", partial(
            _draw_scaled, values=tone.stops(radiance), limits=tone.limits, up=up,
            colormap=style.GREY, label="powers of two, relative to middle grey")),
    ]  # fmt: skip


@dataclass(frozen=True)
class ToneCurve:
    """Reinhard's tone curve, which shows dark parts and lamps together.

    ``middle`` is the radiance of middle grey; ``limits`` is the range of log2 relative to it.
    """

    middle: float
    limits: tuple[float, float]

    @classmethod
    def of(cls, radiance: np.ndarray) -> "ToneCurve":
        """Return the curve for a map (H, W, 3)."""
        grey = radiance.mean(axis=-1)
        grey = np.maximum(grey, max(DARK * grey.mean(), 1e-30))  # limits the log of black
        middle = float(np.exp(np.log(grey).mean()))
        low, high = np.log2(np.quantile(grey, (0, 1)) / middle)
        return cls(middle, (min(float(low), -1.0), max(float(high), 1.0)))

    def colors(self, radiance: np.ndarray) -> np.ndarray:
        """Return a map (H, W, 3) as screen colours."""
        scaled = GREY * radiance / self.middle
        white = GREY * 2 ** self.limits[1]
        mean = scaled.mean(axis=-1, keepdims=True)
        shrunk = scaled * (1 + mean / white**2) / (1 + mean)
        return np.asarray(srgb(np.clip(shrunk, 0, 1)))

    def stops(self, radiance: np.ndarray) -> np.ndarray:
        """Return log2 of a map's brightness relative to the middle, (H, W)."""
        return np.log2(np.maximum(radiance.mean(axis=-1), 1e-30) / self.middle)


def light_colors(radiance: np.ndarray) -> np.ndarray:
    """Return radiance (H, W, 3) as screen colours."""
    return ToneCurve.of(radiance).colors(radiance)


def deviation_colors(estimate: LightEstimate) -> np.ndarray:
    """Return the map of standard deviations as screen colours (H, W, 3)."""
    return style.colors(estimate.sd, (0, UNCERTAIN))


def known_colors(estimate: LightEstimate) -> np.ndarray:
    """Return ``LightEstimate.known`` as screen colours (H, W, 3)."""
    return style.colors(estimate.known, colormap=KNOWN_COLORMAP)


def _notes(estimate: LightEstimate, against: LightComparison | None) -> list[str]:
    scale = f"factor of base colours {channel_factors(*estimate.scale_interval)}"
    notes = [
        f"{plain_percent(estimate.known_part)} determined", f"{estimate.texels} texels",
        scale if estimate.scale_sd.any() else "brightness and colour given",
        "turns with the camera" if estimate.moves else "fixed in the world",
    ]  # fmt: skip
    if against is not None:
        notes.append(f"correlation with the capture's own light {against.correlation:.2f}")
    return notes


def _draw_colors(axes: "Axes", colors: np.ndarray, up: np.ndarray) -> None:
    axes.imshow(upright(colors, up), extent=(0, 1, 0, 0.5), interpolation="nearest")
    _label_directions(axes, up)


def _draw_scaled(
    axes: "Axes", values: np.ndarray, limits: tuple[float, float], up: np.ndarray, label: str,
    colormap: str = style.COLORMAP,
) -> None:  # fmt: skip
    drawn = axes.imshow(
        upright(values, up), colormap, vmin=limits[0], vmax=limits[1], extent=(0, 1, 0, 0.5),
        interpolation="nearest",
    )  # fmt: skip
    _label_directions(axes, up)
    style.color_bar(axes, drawn, label, (0.0, -0.16, 1.0, 0.035))


def _label_directions(axes: "Axes", up: np.ndarray) -> None:
    """Label azimuths and elevations of a map, and draw the horizon."""
    style.frame_map(axes)
    ahead, right = (nearest_axis(direction) for direction in horizon(up))
    azimuths = (f"0° {ahead}", f"90° {right}", "180°", "270°", "360°")
    axes.set_xticks(np.linspace(0, 1, 5), azimuths)
    for label, side in zip(axes.get_xticklabels()[::4], ("left", "right"), strict=True):
        label.set_horizontalalignment(side)
    axes.set_yticks((0, 0.25, 0.5), ("down", "0°", "up"))
    axes.tick_params(labelsize=style.TEXT, color=style.RULE, labelcolor=style.INK, length=3)
    axes.axhline(0.25, color="white", linewidth=0.8, linestyle=":")


def upright(values: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return a lat-long map (H, W, ...) with ``up`` (3,) at its top and azimuth 0 at its left."""
    height, width = values.shape[:2]
    ahead, right = horizon(up)
    world = directions(width, height) @ np.stack([right, up, -ahead])
    return np.asarray(values[nearest_node(world, height, width)])
