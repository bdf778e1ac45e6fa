"""Files of ``svu light``: estimated light, its uncertainty, and ``light.png``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.calibration.light.light_estimate import LightEstimate
from svu_mi.calibration.light.light_folder import COMMAND, RECORD, light_record, write_light_arrays
from svu_mi.calibration.light.light_summary import LightComparison, channel_factors
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import photographs_key
from svu_mi.capture.tonemap import srgb
from svu_mi.core.io.output_folder import writing
from svu_mi.light.latlong import directions, radiance_from
from svu_mi.output import style
from svu_mi.output.interval_summary import plain_percent
from svu_mi.output.run_record import RunInfo, environment_record, inputs_record, write_manifest
from svu_mi.output.style import LEFT, RIGHT, Block

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from svu_mi.output.style import Panel

PAGE = "light.png"
HEADING = "Light estimated from the photographs"
WIDTH, ROW, REST = 16.0, 5.0, 1.4  # inches: page width, height of a row, margins
GREY = 0.18  # screen value (linear) of the geometric mean radiance
DARK = 1e-3  # lower bound of radiance, relative to the mean
UNCERTAIN = 1.5  # upper end of the scale of log standard deviations
AXIS = ((0.0, "-Z"), (0.25, "+X"), (0.5, "+Z"), (0.75, "-X"), (1.0, "-Z"))


def write_light(
    capture: Capture,
    estimate: LightEstimate,
    folder: str | os.PathLike[str],
    run: RunInfo | None = None,
    *,
    used: Mapping[str, Any] | None = None,
    against: LightComparison | None = None,
    timings: Mapping[str, float] | None = None,
    pictures: bool = True,
) -> None:
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
    """Draw radiance, its logarithm, standard deviation and ``known`` as lat-long maps.

    ``against`` adds the capture's own light.
    """
    truth, shape = None, estimate.radiance.shape
    if against is not None:
        world = directions(shape[1], shape[0]).reshape(-1, 3)
        truth = radiance_from(capture.environment, world).reshape(shape)
    tone = ToneCurve.of(estimate.radiance if truth is None else truth)
    panels = _radiance_panels("Radiance", estimate.radiance, tone)
    if truth is not None:
        panels += _radiance_panels("The capture's own light", truth, tone)
    panels += [
        ("Standard deviation of the logarithm of radiance", partial(
            _draw_scaled, values=estimate.sd, limits=(0, UNCERTAIN), colormap=style.VIEWS_COLORMAP,
            label="0.1 is 10 %; includes the common scale")),
        ("Fraction determined by the photographs", partial(
            _draw_scaled, values=estimate.known, limits=(0, 1), colormap=style.COLORMAP,
            label="0 = prior only, 1 = fully determined")),
    ]  # fmt: skip
    rows = len(panels) // 2
    height = ROW * rows + REST
    box = (LEFT + 0.012, RIGHT, 0.9 / height, 1 - 1.25 / height)
    block = Block(panels=panels, shape=(rows, 2), box=box, space=(0.06, 0.34), anchor="N")
    style.write_page(path, (WIDTH, height), HEADING, _notes(estimate, against), [block])


def _radiance_panels(title: str, radiance: np.ndarray, tone: ToneCurve) -> list[Panel]:
    """Return panels of a map (H, W, 3): tone-mapped, and as logarithm."""
    return [
        (title, partial(_draw_colors, colors=tone.colors(radiance))),
        (f"{title}, log scale", partial(
            _draw_scaled, values=tone.stops(radiance), limits=tone.limits, colormap=style.COLORMAP,
            label="powers of two, relative to middle grey")),
    ]  # fmt: skip


@dataclass(frozen=True)
class ToneCurve:
    """Reinhard's tone curve, which shows dark parts and lamps together.

    ``middle`` is the radiance of middle grey; ``limits`` is the range of log2 relative to it.
    """

    middle: float
    limits: tuple[float, float]

    @classmethod
    def of(cls, radiance: np.ndarray) -> ToneCurve:
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
    return style.colors(estimate.sd, (0, UNCERTAIN), style.VIEWS_COLORMAP)


def known_colors(estimate: LightEstimate) -> np.ndarray:
    """Return ``LightEstimate.known`` as screen colours (H, W, 3)."""
    return style.colors(estimate.known)


def _notes(estimate: LightEstimate, against: LightComparison | None) -> list[str]:
    scale = f"factor of base colours {channel_factors(estimate)}"
    notes = [
        f"{plain_percent(estimate.known_part)} determined", f"{estimate.texels} texels",
        scale if estimate.scale_sd.any() else "brightness and colour given",
        "turns with the camera" if estimate.moves else "fixed in the world",
    ]  # fmt: skip
    if against is not None:
        notes.append(f"correlation with the capture's own light {against.correlation:.2f}")
    return notes


def _draw_colors(axes: Axes, colors: np.ndarray) -> None:
    axes.imshow(colors, extent=(0, 1, 0, 0.5), interpolation="nearest")
    _label_directions(axes)


def _draw_scaled(
    axes: Axes, values: np.ndarray, limits: tuple[float, float], colormap: str, label: str
) -> None:
    drawn = axes.imshow(
        values, colormap, vmin=limits[0], vmax=limits[1], extent=(0, 1, 0, 0.5),
        interpolation="nearest",
    )  # fmt: skip
    _label_directions(axes)
    style.color_bar(axes, drawn, label, (0.0, -0.16, 1.0, 0.035))


def _label_directions(axes: Axes) -> None:
    """Label the columns of a lat-long map with their directions."""
    style.frame_map(axes)
    axes.set_xticks([place for place, _ in AXIS], [name for _, name in AXIS])
    axes.tick_params(labelsize=style.TEXT, color=style.RULE, labelcolor=style.INK, length=3)
