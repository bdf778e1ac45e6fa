"""Light of a flash: a point lamp fixed to the camera, whose place differs between views."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Flash
from svu_mi.capture.scene import to_world
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.sample_view import TexelLanes, ViewSample
from svu_mi.light.band_limited import diffuse_moments
from svu_mi.light.lamps import END
from svu_mi.light.light_visibility import SampleBits, is_unoccluded


class FlashCell:
    """The flash of one view as seen from texels, with the interface of ``LightCells``."""

    # Not a dataclass, because Dr.Jit would treat the fields as loop state.

    def __init__(self, direction: Any, irradiance: Sequence[Any]) -> None:
        self.direction, self.irradiance = direction, list(irradiance)

    def at(self, _: Any) -> tuple[Any, Any]:
        """Return direction (Vector3f) and radius (Float)."""
        return self.direction, mi.Float(0)

    def light(self, _: Any, channels: int) -> list[Any]:
        """Return the irradiance R, G and B, or their mean if ``channels`` is 1."""
        return self.irradiance if channels == 3 else [sum(self.irradiance) / 3]

    def moments(self, normal: Any, channels: int) -> list[list[Any]]:
        """Return the diffuse moments (``LightVisibility.diffuse``): 8 Floats per channel."""
        cosine = dr.maximum(dr.dot(normal, self.direction), 0)
        return [diffuse_moments(x, cosine, self.direction) for x in self.light(0, channels)]

    def retroreflection(self, normal: Any, channels: int, view: Any, cosine: Any) -> list[Any]:
        """Return the term R^2 F_o F_i / pi, without roughness^2, that ``diffuse_shading`` lacks.

        It matters near the camera only, where the lamp is. ``view`` is the direction to the camera,
        at an angle of ``cosine`` to the normal.
        """
        incident = dr.maximum(dr.dot(normal, self.direction), 0)
        towards = dr.square(1 + dr.dot(view, self.direction))
        both = incident * ((1 - incident) * (1 - cosine)) ** 5 * towards / np.pi
        return [value * both for value in self.light(0, channels)]


@dataclass(frozen=True)
class FlashLight:
    """Flash of all views.

    Attributes:
        position: (N,) Point3f, place of the lamp by slot.
        intensity: Radiant intensity R, G and B, Floats.
        lit: samples on which it shines, by slots of ``Visibility.order``; None: all.
        scene: Scene in which shadows are traced instead; None: none are.
    """

    position: Any
    intensity: Any
    lit: SampleBits | None = None
    scene: Any = None

    @staticmethod
    def of(flash: Flash, sensors: Sequence[Any]) -> "FlashLight":
        """Place the flash of each sensor, whose index is its slot."""
        poses = np.stack([to_world(sensor) for sensor in sensors])
        position = (poses @ np.append(flash.position, 1))[:, :3]
        return FlashLight(
            to_drjit(mi.Point3f, position.T.astype(np.float32)),
            [dr.opaque(mi.Float, x) for x in flash.intensity],
        )

    def seen_from(self, surface: TexelLanes, slot: Any) -> FlashCell:
        """Return the flash of a slot as seen from texels; it has no irradiance where hidden."""
        way = dr.gather(mi.Point3f, self.position, slot) - surface.position
        square = dr.squared_norm(way)
        direction = mi.Vector3f(way * dr.rsqrt(square))
        free = dr.dot(surface.geometric_normal, direction) > 0
        if self.lit is not None:
            free &= self.lit.test(slot, surface.index)
        if self.scene is not None:
            free &= self._is_free(self.scene, surface, slot, free)
        return FlashCell(direction, [dr.select(free, x / square, 0) for x in self.intensity])

    def trace(
        self, scene: Any, surface: TexelLanes, seen: ViewSample, slot: Any, active: Any
    ) -> Any:
        """Return whether nothing hides the flash of visible samples."""
        return seen.seen & self._is_free(scene, surface, slot, active)

    def _is_free(self, scene: Any, surface: TexelLanes, slot: Any, active: Any) -> Any:
        way = mi.Vector3f(dr.gather(mi.Point3f, self.position, slot) - surface.position)
        return is_unoccluded(scene, surface, way, active, coherent=True, distance=1 - END)
