"""Narrow specular lobes, evaluated by reading prefiltered light.

A lobe is approximated by a rotationally symmetric one. Its Fresnel term is averaged over the lobe
(split sum) or taken at the viewing angle (Eq. 6). The narrower the lobe, the smaller the error. A
ray in the mirror direction determines the visibility of the light.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.geometry.sample_view import mirror_direction
from svu_mi.light.band_limited import Lighting
from svu_mi.light.light_tree import LightCells, disk_cells
from svu_mi.light.prefiltered import FilteredLight, filter_light
from svu_mi.presets import AngularPreset
from svu_mi.reflection.albedo_table import AlbedoTable
from svu_mi.reflection.lobes import Normals, dominance, lobe_profile
from svu_mi.reflection.wide_lobes import Lobe, LobeSums, added_lobes


@dataclass(frozen=True)
class NarrowLobes:
    """Narrow lobes of K widths.

    Attributes:
        levels: light prefiltered for each width.
        sun: cells of the sun's disk if the prefiltered light excludes it, else None.
    """

    switches: AngularPreset
    alpha: np.ndarray
    levels: FilteredLight
    albedo: AlbedoTable
    sun: LightCells | None = None

    @staticmethod
    def of(
        lighting: Lighting, alpha: np.ndarray, switches: AngularPreset, channels: int,
        *, disk: bool = True,
    ) -> "NarrowLobes":  # fmt: skip
        """Prefilter the light. If ``disk`` is False, the sun's disk is summed separately."""
        profile = lobe_profile(switches.lobe)
        return NarrowLobes(
            switches=switches,
            alpha=alpha,
            levels=filter_light(lighting, alpha.tolist(), profile, grey=channels == 1, disk=disk),
            albedo=AlbedoTable.of(alpha, switches.fresnel),
            sun=None if disk else disk_cells(lighting.environment),
        )

    def reflect(self, normals: Normals, direction: Any, cosine: Any, free: Any) -> list[Lobe]:
        """Return light reflected by each width's lobe; 0 where the mirror ray is not ``free``."""
        several = normals.around or [normals.mean]
        mirrors = [mirror_direction(normal, direction) for normal in several]
        result = []
        for level, alpha in enumerate(self.alpha.tolist()):
            centers = mirrors
            if self.switches.off_specular:
                pairs, part = zip(several, mirrors, strict=True), dominance(alpha)
                centers = [dr.normalize(dr.lerp(*pair, part)) for pair in pairs]
            A, B, D = self.albedo.at(level, alpha, cosine)
            of_normals = [self.levels.radiance(level, center) for center in centers]
            light = [sum(values) / len(centers) for values in zip(*of_normals, strict=True)]
            light = [dr.select(free, value, 0) for value in light]
            result.append([(A * value, B * value, D * value) for value in light])
        if self.sun is None:
            return result
        # The sun's disk is visible where the mirror direction is.
        sums = LobeSums(self.alpha, len(result[0]), normals, direction)
        return added_lobes(result, sums.of_cells(self.sun, self.sun.count, free, cosine))
