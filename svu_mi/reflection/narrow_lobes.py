"""Narrow specular lobes, evaluated by reading prefiltered light.

A lobe is approximated by a rotationally symmetric one. Its Fresnel term is averaged over the lobe
(split sum) or taken at the viewing angle (Eq. 6). The narrower the lobe, the smaller the error. A
ray in the mirror direction determines the visibility of the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.sample_view import mirror_direction
from svu_mi.light.band_limited import Lighting
from svu_mi.light.light_tree import LightCells, disk_cells
from svu_mi.light.prefiltered import FilteredLight, filter_light
from svu_mi.presets import AngularPreset
from svu_mi.reflection.lobes import (
    ALBEDO_NODES,
    dielectric_albedo,
    dominance,
    lobe_profile,
    split_sum,
    view_albedo,
)
from svu_mi.reflection.wide_lobes import Lobe, LobeSums


@dataclass(frozen=True)
class NarrowLobes:
    """Narrow lobes of K widths.

    Attributes:
        levels: light prefiltered for each width.
        albedo: (K * ALBEDO_NODES * 2,) Float, split-sum pairs (A, B).
        dielectric: (K * ALBEDO_NODES,) Float, albedo with exact dielectric reflectance.
        sun: cells of the sun's disk if the prefiltered light excludes it, else None.
    """

    switches: AngularPreset
    alpha: np.ndarray
    levels: FilteredLight
    albedo: Any
    dielectric: Any
    sun: LightCells | None = None

    @staticmethod
    def of(
        lighting: Lighting, alpha: np.ndarray, switches: AngularPreset, channels: int,
        *, disk: bool = True,
    ) -> NarrowLobes:  # fmt: skip
        """Prefilter the light. If ``disk`` is False, the sun's disk is summed separately."""
        profile = lobe_profile(switches.lobe)
        return NarrowLobes(
            switches=switches,
            alpha=alpha,
            levels=filter_light(lighting, alpha.tolist(), profile, grey=channels == 1, disk=disk),
            albedo=to_drjit(mi.Float, split_sum(alpha).ravel()),
            dielectric=to_drjit(mi.Float, dielectric_albedo(alpha).ravel()),
            sun=None if disk else disk_cells(lighting.environment),
        )

    def reflect(self, normal: Any, direction: Any, cosine: Any, free: Any) -> list[Lobe]:
        """Return light reflected by each width's lobe; 0 where the mirror ray is not ``free``."""
        mirror = mirror_direction(normal, direction)
        result = []
        for level, alpha in enumerate(self.alpha.tolist()):
            center = mirror
            if self.switches.off_specular:
                center = dr.normalize(dr.lerp(mi.Vector3f(normal), mirror, dominance(alpha)))
            A, B, D = self._reflected(level, alpha, cosine)
            light = self.levels.radiance(level, center)
            light = [dr.select(free, value, 0) for value in light]
            result.append([(A * value, B * value, D * value) for value in light])
        if self.sun is None:
            return result
        return self._with_sun(result, normal, direction, cosine, free)

    def _with_sun(
        self, lobes: list[Lobe], normal: Any, direction: Any, cosine: Any, free: Any
    ) -> list[Lobe]:
        """Add the sun's disk, with the visibility ``free`` of the mirror direction."""
        sun = self.sun
        assert sun is not None
        sums = LobeSums(self.alpha, len(lobes[0]), normal, direction)

        def add(cell: Any, memory: Any) -> tuple[Any, Any]:
            return (cell + 1, *sums.add(sun, cell, sums.angles(sun, cell), free, memory))

        added = sums.integrate(sun.count, add, cosine)
        return [
            [tuple(a + b for a, b in zip(*pair, strict=True)) for pair in zip(*both, strict=True)]
            for both in zip(lobes, added, strict=True)
        ]  # type: ignore[misc]

    def _reflected(self, level: int, alpha: float, cosine: Any) -> tuple[Any, Any, Any]:
        """Return (A, B, D): the albedo of a metal is R0 A + B, of a dielectric D."""
        rule = self.switches.fresnel
        if rule != "split_sum":
            return view_albedo(rule, cosine, alpha)
        place = dr.clip(cosine * ALBEDO_NODES - 0.5, 0, ALBEDO_NODES - 1.001)
        first = mi.UInt32(place)
        part = place - first
        index = first + level * ALBEDO_NODES
        here, after = (dr.gather(mi.Vector2f, self.albedo, index + step) for step in (0, 1))
        pair = dr.lerp(here, after, part)
        low, high = (dr.gather(mi.Float, self.dielectric, index + step) for step in (0, 1))
        return pair.x, pair.y, dr.lerp(low, high, part)
