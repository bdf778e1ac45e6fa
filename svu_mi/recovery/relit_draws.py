"""How sure a picture is: the object in textures drawn from the field around the recovered ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.traced import Pictures
from svu_mi.errors import OptionError
from svu_mi.recovery.path.scene import PathScene
from svu_mi.recovery.relight import path_length, under
from svu_mi.recovery.textures import Textures

FEWEST = 2  # draws that a standard deviation is of


@dataclass(frozen=True)
class RelitView:
    """One picture of an object in textures of which nobody is sure.

    Attributes:
        picture: (H, W, 3) float32, linear radiance in the recovered textures, with what is around
            the object.
        mean, sd: (H, W, 3) float32, over draws; ``picture`` and 0 beside the object.
        inside: (H, W) bool, pixels that show something of the object.
    """

    picture: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    inside: np.ndarray


def relight_draws(
    capture: Capture,
    textures: Textures,
    draws: Iterable[Textures],
    environment: Any | None = None,
    sensors: Sequence[Any] | None = None,
    spp: int = 16,
    *,
    seed: int = 0,
    max_depth: int | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> list[RelitView]:
    """Path-trace the object in recovered textures, and in others that are as likely.

    All draws are rendered with the same random numbers, so noise of the path tracer is no part of
    the standard deviation.

    Args:
        capture: its scene, but for the object's material and the light; it is not modified.
        textures: the recovered ones.
        draws: at least two, such as ``TextureField.draw(16)``.
        environment: an emitter, or a dictionary for ``mi.load_dict``; the capture's by default.
        sensors: where from; by default those of the capture.
        spp: samples per pixel, rounded to a square.
        seed: of the samples.
        max_depth: longest path; by default that of the scene's own integrator.
        progress: called with the number of draws that are done.

    Raises:
        OptionError: fewer than two draws, or less than one sample per pixel.
        ShapeError: a draw has another resolution.
    """
    if spp < 1:
        raise OptionError(f"relight_draws(): spp must be at least 1, got {spp}.")
    sensors = capture.sensors if sensors is None else sensors
    painted = PathScene.of(capture, textures)
    scene = under(painted.scene, environment)
    depth = path_length(capture.scene) if max_depth is None else max_depth
    integrator = mi.load_dict({"type": "path", "max_depth": depth})
    pictures = Pictures(sensors)
    inside = [part > 0 for part in pictures.covered(painted.scene, painted.shape)]
    everything = [np.ones_like(mask) for mask in inside]
    middle = pictures.traced(scene, integrator, everything, spp, seed)
    # Relative to pictures that have the same noise, so that nothing cancels.
    base = pictures.traced(scene, integrator, inside, spp, seed)
    total, squares, count = _zeros(base), _zeros(base), 0
    for count, draw in enumerate(draws, 1):  # noqa: B007
        painted.paint(dict(draw.items()))
        found = pictures.traced(scene, integrator, inside, spp, seed)
        for image, start, first, second in zip(found, base, total, squares, strict=True):
            change = image.astype(np.float64) - start
            first += change
            second += change**2
        progress(count)
    if count < FEWEST:
        raise OptionError(f"relight_draws(): needs at least {FEWEST} draws, got {count}.")
    views = []
    for image, mask, first, second in zip(middle, inside, total, squares, strict=True):
        mean = first / count
        sd = np.sqrt(np.maximum(second - count * mean**2, 0) / (count - 1))
        views.append(RelitView(image, (image + mean).astype(np.float32),
                               sd.astype(np.float32), mask))  # fmt: skip
    return views


def _zeros(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [np.zeros(image.shape, np.float64) for image in images]
