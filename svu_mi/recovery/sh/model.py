"""The reflection model of recovery: narrow lobes look filtered light up, wide ones sum cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.angular import Reflection, reflection
from svu_mi.angular.model import terms
from svu_mi.brdf.diffuse import diffuse_shading
from svu_mi.brdf.principled import alpha_from_roughness
from svu_mi.options import preset
from svu_mi.radiance import Lighting
from svu_mi.radiance.cells import adaptive_cells
from svu_mi.radiance.observe import Surface
from svu_mi.recovery.sh.wide import WideLobes

CELLS = 256
NARROW = 0.1  # widest lobe alpha that is looked up; cells are twice as far apart

Column = tuple[Any, Any, Any, Any]


@dataclass(frozen=True)
class Model:
    """What S texels reflect, at R levels of roughness.

    Attributes:
        roughness: (R,) uniform on [0, 1].
        narrow: the levels whose alpha is at most ``NARROW``.
        wide: the others.
    """

    roughness: np.ndarray
    narrow: Reflection
    wide: WideLobes

    @staticmethod
    def of(scene: Any, surface: Surface, lighting: Lighting, levels: int) -> Model:
        """Filter the light, and trace what reaches every texel.

        Args:
            scene: what occludes.
            surface: S texels.
            lighting: the capture's light.
            levels: R.
        """
        roughness = np.linspace(0, 1, levels)
        alpha = alpha_from_roughness(roughness)
        switches = preset("default", method="angular", channels="joint")
        cells = adaptive_cells(lighting.environment, CELLS)
        wide = WideLobes.trace(scene, surface, cells, alpha[alpha > NARROW])
        narrow = reflection(scene, surface, lighting, roughness[alpha <= NARROW], switches)
        return Model(roughness, narrow, wide)

    def columns(
        self, surface: Surface, direction: Any, cosine: Any, free: Any
    ) -> list[list[Column]]:
        """Evaluate the model for one view of every texel.

        Args:
            surface: the texels.
            direction: unit Vector3f to the camera.
            cosine: Float, between it and the shading normal, positive.
            free: Bool, nothing stands in the mirror direction.

        Returns:
            For each level and channel (e, p, q, d): see ``statistics.py``.
        """
        normal = mi.Vector3f(surface.normal)
        part = terms(self.narrow, normal, direction, cosine, free)
        lobes = [
            list(zip(*level, strict=True))
            for level in zip(part.scaled, part.added, part.dielectric, strict=True)
        ]
        lobes += self.wide.reflect(surface.lane, normal, direction, cosine)
        shading = [
            diffuse_shading(self.narrow.switches.diffuse, moments, direction, cosine)
            for moments in self.narrow.arriving.diffuse
        ]
        return [
            [(a + r * b, *lobe) for (a, b), lobe in zip(shading, lobes[k], strict=True)]
            for k, r in enumerate(self.roughness.tolist())
        ]
