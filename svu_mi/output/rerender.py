"""``relit.png``: photographs, renders with recovered textures, renders under another light."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.film_rays import SensorPixels
from svu_mi.capture.sensors import film_size, scaled_sensor
from svu_mi.capture.tonemap import resized, tone_mapped, white_radiance, with_bounds
from svu_mi.output import object_views, style
from svu_mi.output.style import DIFFERENCE_COLORMAP, FAINT, INK
from svu_mi.recovery.relighting import novel_light, relight
from svu_mi.recovery.svbrdf_textures import Textures

COLUMNS = ("Photograph", "Recovered", "Difference", "Under another light")
CELL = 2.9  # inches
SIDE = 320  # pixels of the longer side; rendering dominates the time
SAMPLES = 16  # per pixel; 25 take 1.5 times as long, for 0.8 times the noise
WORST = 0.25  # difference of sRGB values at the upper end of the scale


@dataclass(frozen=True, kw_only=True)
class RenderComparison:
    """Photograph and render of one view, by default at most 320 pixels wide.

    Attributes:
        view: Index into ``capture.sensors``.
        name: Name of the photograph.
        photograph: (h, w, 3) linear radiance, with bounds of saturated channels; NaN if unusable.
        exact: (h, w) bool, pixels that are neither saturated nor unusable.
        render: (h, w, 3) linear radiance of the object with the textures under the capture's light;
            0 outside the object.
        inside: (h, w) bool, pixels that the object covers completely.
        relit: Render under another light, like ``render``, or None.
    """

    view: int
    name: str
    photograph: np.ndarray
    exact: np.ndarray
    render: np.ndarray
    inside: np.ndarray
    relit: np.ndarray | None = None

    @cached_property
    def difference(self) -> np.ndarray:
        """Largest difference of sRGB values among channels, (h, w); NaN where not comparable."""
        error = np.abs(np.subtract(*self._exposed)).max(axis=2)
        return np.where(self.inside & self.exact, error, np.nan)

    @property
    def mean_difference(self) -> float | None:
        """Mean of ``difference``; None without usable pixels."""
        error = self.difference
        return float(np.nanmean(error)) if np.isfinite(error).any() else None

    @cached_property
    def pictures(self) -> list[np.ndarray]:
        """Photograph, render, difference and (if present) ``relit`` as screen colours (h, w, 3).

        White outside the object. Differences range from 0 (black) to 0.25 (yellow). ``relit`` has
        its own exposure.
        """
        photograph, render = self._exposed
        error = self.difference[..., None]
        colors = style.colors(error[..., 0], (0, WORST), DIFFERENCE_COLORMAP)
        pictures = [photograph, self._on_white(render), np.where(np.isnan(error), 1, colors)]
        if self.relit is not None:
            pictures.append(self._on_white(tone_mapped(self.relit, self.inside)))
        return pictures

    def cropped(self) -> list[np.ndarray]:
        """Return ``pictures``, cropped to the object."""
        window = object_views.object_window(self.inside)
        return [object_views.crop(image, window) for image in self.pictures]

    @cached_property
    def _exposed(self) -> tuple[np.ndarray, np.ndarray]:
        """Photograph and render as sRGB values with the photograph's exposure."""
        white = white_radiance(self.photograph, self.inside)
        return (tone_mapped(self.photograph, white=white),
                tone_mapped(self.render, white=white))  # fmt: skip

    def _on_white(self, image: np.ndarray) -> np.ndarray:
        return np.where(self.inside[..., None], image, np.float32(1))


def compare_renders(
    capture: Capture, textures: Textures, chosen: Sequence[int], spp: int = SAMPLES,
    side: int = SIDE, *, relit: bool = True,
) -> list[RenderComparison]:  # fmt: skip
    """Return photographs and renders with ``textures`` from the ``chosen`` sensors.

    ``side`` is the longer side in pixels; ``relit`` adds renders under ``novel_light``.
    """
    sensors = [scaled_sensor(capture.sensors[view], side) for view in chosen]
    covered = SensorPixels(sensors).covered(capture.scene, capture.shape)
    inside = [part == 1 for part in covered]
    lights = [None, novel_light(capture)] if relit else [None]
    lit = [relight(capture, textures, light, sensors, spp, pixels=inside) for light in lights]
    return [
        RenderComparison(
            view=view, name=capture.names[view],
            photograph=resized(with_bounds(capture, view), film_size(sensor)),
            exact=np.isfinite(resized(capture.images[view], film_size(sensor))).all(axis=2),
            inside=mask, render=renders[0], relit=renders[1] if relit else None,
        )
        for view, sensor, mask, *renders in zip(chosen, sensors, inside, *lit, strict=True)
    ]  # fmt: skip


def write_relit(comparisons: Sequence[RenderComparison], path: str | Path) -> None:
    """Draw one row per view: photograph, render, difference, render under another light.

    Raises:
        OutputError: the file cannot be written.
    """
    height = CELL * len(comparisons) + 0.4
    figure = style.new_figure(CELL * len(COLUMNS), height)
    # Fixed margins: matplotlib's automatic layout draws everything three times.
    room = {"left": 0.005, "right": 0.995, "top": 1 - 0.3 / height, "bottom": 0.22 / height}
    grid = figure.subplots(
        len(comparisons), len(COLUMNS), squeeze=False,
        gridspec_kw={**room, "wspace": 0.02, "hspace": 0.09},
    )  # fmt: skip
    for row, comparison in zip(grid, comparisons, strict=True):
        error = comparison.mean_difference
        mean = "" if error is None else f"mean {error:.3f}"
        notes = (style.photograph_title(comparison.name), "", mean, "")
        for axes, image, note in zip(row, comparison.cropped(), notes, strict=True):
            style.draw_image(axes, image)
            axes.text(0.5, -0.02, note, size=9.5, color=FAINT, ha="center", va="top",
                      transform=axes.transAxes)  # fmt: skip
    for axes, title in zip(grid[0], COLUMNS, strict=True):
        axes.set_title(title, y=1.0, size=12, color=INK)
    style.save_figure(figure, path)
