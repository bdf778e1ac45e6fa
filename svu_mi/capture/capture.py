"""Captures: scene, target object, photographs, masks and exposures."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.capture.quantization import Rounding, Saturation
from svu_mi.core.io.array_cache import ArrayCache
from svu_mi.errors import OptionError, counted, warn


@dataclass(frozen=True)
class LightUncertainty:
    """Uncertainty of a light that was estimated from the photographs.

    Attributes:
        widening: Factor, at least 1, of the overdispersion tau, and thus of posterior variances.
        scale: Standard deviation of log(brightness) per channel. The error is shared by the base
            colour of all texels.
    """

    widening: float = 1.0
    scale: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Flash:
    """Point lamp fixed to the camera.

    Attributes:
        position: In the camera's frame (+X left, +Y up, +Z forward), in units of the scene.
        intensity: Radiant intensity R, G and B: at distance r, the irradiance is intensity / r^2.
    """

    position: tuple[float, float, float]
    intensity: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, repr=False)
class Capture:
    """A scene, its target object, and one photograph per sensor.

    Attributes:
        scene: The ``mi.Scene``, with the geometry and the light.
        shape: Target object in the scene, an ``mi.Mesh``.
        mesh: The same surface with the UVs that define the texels: ``shape``, or an unwrapped copy.
        sensors: V perspective sensors, in the order of the scene.
        images: V arrays (H, W, 3) float32 of linear radiance, divided by the exposure. Unusable
            values (NaN, infinite, negative, saturated) are NaN.
        masks: V arrays (H, W) bool, True on the object; None for a view without a mask.
        exposures: V exposure gains; the photographs were divided by them.
        exposures_known: True if the exposures are recorded; otherwise they are 1, but may differ.
        exposures_relative: True if they are those of EXIF, in another unit than the light's.
        names: V names of the photographs for messages: the imported names, or file names.
        unusable: V counts of pixels that are NaN.
        used: V booleans; False for unused views, such as an entirely black photograph.
        source: Path of the folder or file that was loaded; None for captures made in memory.
        clipped: V saturation records, None for a photograph without clipped channels. Empty if no
            photograph has any.
        rounding: V quantisation steps, None for a floating-point photograph. Empty if no
            photograph stores integers.
        warnings: Warnings and notes of loading, one sentence each.
        files: V file names in ``source``; empty for captures made in memory.
        flash: Lamp fixed to the camera, which is lit in all photographs; None without one.
        light_uncertainty: Uncertainty of an estimated light; None if the light was given.
        found_light: The ``LightEstimate`` in use (see ``with_light``); None if the light was given.
        buffer: Contiguous pixels of ``images`` for kernels; None for captures made in memory.
            Not used if ``images`` were replaced by other arrays.
        cache: results of estimates that other commands can read; keeps nothing by default.

    Example:
        >>> capture.count
        12
        >>> capture.images[0].shape, capture.exposures[0]
        ((96, 96, 3), 1.0)
        >>> sum(capture.used), len(capture.warnings)
        (12, 0)
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
    flash: Flash | None = None
    light_uncertainty: LightUncertainty | None = None
    found_light: Any | None = None
    buffer: PixelBuffer | None = None
    cache: ArrayCache = ArrayCache()
    exposures_known: bool = True
    exposures_relative: bool = False

    def __reduce__(self) -> NoReturn:
        raise OptionError("A Mitsuba scene cannot be pickled or copied; load the capture again.")

    def __repr__(self) -> str:
        sizes = sorted({image.shape[1::-1] for image in self.images})
        size = " x ".join(map(str, sizes[-1])) if sizes else "0 x 0"
        unused = self.count - sum(self.used)
        lights = dict.fromkeys(emitter.class_name() for emitter in self.scene.emitters())
        lights |= {} if self.flash is None else {"flash": None}
        parts = [
            f"{counted(self.count, 'photograph')} of {'up to ' if len(sizes) > 1 else ''}{size}",
            *([f"{unused} unused"] if unused else []),
            f"light {', '.join(lights)}" if lights else "no light",
            *([] if self.source is None else [f"from {self.source}"]),
        ]
        return f"<Capture {self.shape.id()}: {', '.join(parts)}>"

    def warned(self, *sentences: str) -> "Capture":
        """Issue warnings; return a copy that lists them in records and reports."""
        for sentence in sentences:
            warn(sentence)
        return replace(self, warnings=(*self.warnings, *sentences)) if sentences else self

    @property
    def count(self) -> int:
        """Number of views V."""
        return len(self.sensors)

    @property
    def environment(self) -> Any:
        """The environment emitter; None if the scene has no light."""
        return self.scene.environment()

    @property
    def used_sensors(self) -> tuple[Any, ...]:
        """Sensors of the used views, in order."""
        return tuple(s for s, used in zip(self.sensors, self.used, strict=True) if used)
