"""``relit.png``: photographs, what the recovered textures make of them, and another light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.poses import film_size, scaled_sensor
from svu_mi.capture.rendering import object_mask
from svu_mi.output import style, views
from svu_mi.output.style import DIFFERENCE_COLORMAP, FAINT, INK
from svu_mi.recovery.relight import novel_light, relight
from svu_mi.recovery.textures import Textures

COLUMNS = ("Photograph", "Recovered", "Difference", "Under another light")
CELL = 2.9  # inches
SIDE = 320  # pixels of the longer side: renders are what takes time
SAMPLES = 48
WORST = 0.25  # difference of sRGB values at the end of the scale


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One view: what was photographed and what the textures say, at most 320 pixels wide.

    Attributes:
        view: index into ``capture.sensors``.
        photograph: (h, w, 3) linear radiance; NaN where it is not usable.
        render: (h, w, 3) linear radiance of the object in the textures under the capture's light.
        inside: (h, w) bool, the pixels that show nothing but the object.
    """

    view: int
    photograph: np.ndarray
    render: np.ndarray
    inside: np.ndarray

    @property
    def white(self) -> float:
        """Radiance that is shown as white in the photograph and in the render."""
        return views.exposure(self.photograph, self.inside)

    def difference(self) -> np.ndarray:
        """Return (h, w): the largest difference of sRGB values among channels; NaN outside."""
        both = (views.tone_mapped(i, white=self.white) for i in (self.photograph, self.render))
        error = np.abs(np.subtract(*both)).max(axis=2)
        usable = self.inside & np.isfinite(self.photograph).all(axis=2)
        return np.where(usable, error, np.nan)

    @property
    def mean_difference(self) -> float | None:
        """Mean of ``difference``; None without any usable pixel."""
        error = self.difference()
        return float(np.nanmean(error)) if np.isfinite(error).any() else None

    def pictures(self) -> tuple[np.ndarray, ...]:
        """Return photograph, render and difference as screen colours (h, w, 3), white outside.

        The difference is of sRGB values, from 0 (black) to a quarter (yellow).
        """
        difference = self.difference()
        colors = style.colors(difference, (0, WORST), DIFFERENCE_COLORMAP)
        return (
            views.tone_mapped(self.photograph, white=self.white),
            self._on_white(views.tone_mapped(self.render, white=self.white)),
            np.where(np.isnan(difference)[..., None], 1, colors),
        )

    def cropped(self) -> list[np.ndarray]:
        """Return ``pictures``, cut to the object."""
        window = views.object_window(self.inside)
        return [views.crop(image, window) for image in self.pictures()]

    def _on_white(self, image: np.ndarray) -> np.ndarray:
        return np.where(self.inside[..., None], image, np.float32(1))


@dataclass(frozen=True, kw_only=True)
class Relit(Comparison):
    """A comparison, and the object under another light.

    Attributes:
        relit: (h, w, 3) linear radiance.
    """

    relit: np.ndarray

    def pictures(self) -> tuple[np.ndarray, ...]:
        """Return what a ``Comparison`` does, and the object under the other light.

        That one is exposed for itself.
        """
        relit = self._on_white(views.tone_mapped(self.relit, self.inside))
        return (*super().pictures(), relit)


def explain(
    capture: Capture,
    textures: Textures,
    chosen: Sequence[int],
    spp: int = SAMPLES,
    side: int = SIDE,
) -> list[Comparison]:
    """Render the object in some textures as some of the cameras saw it.

    Args:
        capture: the ``Capture``.
        textures: of the object.
        chosen: indices of its sensors.
        spp: samples per pixel.
        side: of the pictures' longer side, in pixels.
    """
    sensors = [scaled_sensor(capture.sensors[view], side) for view in chosen]
    renders = relight(capture, textures, None, sensors, spp)
    return [
        Comparison(
            view=view,
            photograph=views.resized(capture.images[view], film_size(sensor)),
            render=render,
            inside=object_mask(capture.scene, capture.shape, sensor) >= 1,
        )
        for view, sensor, render in zip(chosen, sensors, renders, strict=True)
    ]


def compare(
    capture: Capture,
    textures: Textures,
    chosen: Sequence[int],
    spp: int = SAMPLES,
) -> list[Relit]:
    """Render the recovered object as some of the cameras saw it, and under ``novel_light``.

    Args:
        capture: the ``Capture``.
        textures: of the object.
        chosen: indices of its sensors.
        spp: samples per pixel.
    """
    sensors = [scaled_sensor(capture.sensors[view], SIDE) for view in chosen]
    relit = relight(capture, textures, novel_light(capture), sensors, spp)
    return [
        Relit(**vars(comparison), relit=image)
        for comparison, image in zip(explain(capture, textures, chosen, spp), relit, strict=True)
    ]


def write_relit(comparisons: Sequence[Relit], path: str | Path) -> None:
    """Draw one row per view: photograph, render, their difference, and another light.

    Args:
        comparisons: at least one.
        path: the PNG file.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = len(comparisons)
    figure = style.new_figure(CELL * len(COLUMNS), CELL * rows + 0.4, layout="constrained")
    cells = figure.subplots(rows, len(COLUMNS), squeeze=False)
    for row, comparison in zip(cells, comparisons, strict=True):
        for axes, image in zip(row, comparison.cropped(), strict=True):
            style.draw_image(axes, image)
        error = comparison.mean_difference
        notes = {0: f"view {comparison.view}", 2: "" if error is None else f"mean {error:.3f}"}
        for column, note in notes.items():
            row[column].text(
                0.5, -0.02, note, size=9.5, color=FAINT, ha="center", va="top",
                transform=row[column].transAxes,
            )  # fmt: skip
    for axes, title in zip(cells[0], COLUMNS, strict=True):
        axes.set_title(title, size=12, color=INK)
    style.save_figure(figure, path)
