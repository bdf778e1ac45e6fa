"""The capture: scene, photographs, masks and exposures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.capture.quantization import Rounding, Saturation


@dataclass(frozen=True)
class LightUncertainty:
    """Uncertainty of a light that was estimated from the photographs.

    Attributes:
        widening: how many times less certain textures are: a factor of their overdispersion.
        scale: standard deviation of the logarithm of one factor per channel, which base colour of
            all texels has in common.
    """

    widening: float = 1.0
    scale: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, repr=False)
class Capture:
    """A scene, its target object, and one photograph per sensor.

    Attributes:
        scene: the ``mi.Scene``; geometry and light of everything that follows.
        shape: the target in the scene, an ``mi.Mesh``.
        mesh: the same surface with UVs that texels are laid out in. It is ``shape`` itself
            unless that had to be unwrapped.
        sensors: V perspective sensors, in the order of the scene.
        images: V arrays (H, W, 3) float32, linear radiance, exposure divided out. A pixel
            that must not be used (NaN, infinite, negative, saturated) is NaN.
        masks: V arrays (H, W) bool, True on the object, or None for a view without a mask.
        exposures: V gains the photographs were divided by.
        names: V names of the photographs as the user knows them, for messages: those that were
            imported, or file names.
        unusable: V counts of pixels that were set to NaN.
        used: V booleans; False for a view left out, such as an entirely black photograph.
        source: the folder or file the capture was read from, None when made in memory.
        clipped: which channels of the photographs are clipped, V or none at all: they are NaN in
            ``images``, but at least as bright as is said here.
        rounding: the steps of photographs of integers, V or none at all; None for one of floats.
        warnings: sentences about what was found, repaired and ignored while loading.
        files: V names of their files in ``source``; empty when it was made in memory.
        light_uncertainty: None if the light was given.
        found_light: the ``LightEstimate`` that is its light (``with_light``); None if it was given.
        buffer: that the pixels of ``images`` lie in, where kernels read them in place; None, or
            other images than its own, if they were made in memory.
    """

    scene: Any
    shape: Any
    mesh: Any
    sensors: tuple[Any, ...]
    images: tuple[np.ndarray, ...]
    masks: tuple[np.ndarray | None, ...]
    exposures: tuple[float, ...]
    names: tuple[str, ...]
    unusable: tuple[int, ...]
    used: tuple[bool, ...]
    source: Path | None = None
    warnings: tuple[str, ...] = field(default=())
    clipped: tuple[Saturation | None, ...] = field(default=())
    rounding: tuple[Rounding | None, ...] = field(default=())
    files: tuple[str, ...] = ()
    light_uncertainty: LightUncertainty | None = None
    found_light: Any | None = None
    buffer: PixelBuffer | None = None

    def __repr__(self) -> str:
        sizes = sorted({image.shape[1::-1] for image in self.images})
        size = " x ".join(map(str, sizes[-1])) if sizes else "0 x 0"
        left_out = self.count - sum(self.used)
        parts = [
            f"{self.count} photographs of {'up to ' if len(sizes) > 1 else ''}{size}",
            *([f"{left_out} left out"] if left_out else []),
            f"light {self.environment.class_name()}" if self.environment else "no light",
            *([] if self.source is None else [f"from {self.source}"]),
        ]
        return f"<Capture {self.shape.id()}: {', '.join(parts)}>"

    @property
    def count(self) -> int:
        """Number of views V."""
        return len(self.sensors)

    @property
    def environment(self) -> Any:
        """The light, an environment emitter; None if the capture was loaded without one."""
        return self.scene.environment()

    @property
    def used_sensors(self) -> tuple[Any, ...]:
        """Sensors of the views that are used, in their order."""
        return tuple(s for s, used in zip(self.sensors, self.used, strict=True) if used)
