"""Lobes of light from other surfaces (``light/near_light.py``).

A lobe of width alpha averages the radiance of what it meets, by zonal factors of each degree. Its
hidden part is averaged likewise, or, for lobes narrower than the expansion, decided by the ray in
the mirror direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.geometry.sample_view import TexelLanes, mirror_direction
from svu_mi.light.near_light import DEGREE, NearLight
from svu_mi.presets import AngularPreset
from svu_mi.reflection.albedo_table import AlbedoTable
from svu_mi.reflection.lobes import dominance, lobe_profile, zonal_factors
from svu_mi.reflection.wide_lobes import Lobe

FAINT = 0.02  # smallest hidden part by which radiance is divided


@dataclass(frozen=True)
class NearLobes:
    """Lobes of K widths.

    Attributes:
        channels: 3, or 1 for the mean of R, G and B.
        zonal: (K, DEGREE + 1) factors of the degrees.
        sharp: (K,) weights of the mirror ray, nearly 1 for the narrowest lobes.
        centers: (K,) centres: 0 is the normal, 1 half way, 2 the mirror direction.
    """

    near: NearLight
    channels: int
    alpha: np.ndarray
    albedo: AlbedoTable
    zonal: np.ndarray
    sharp: np.ndarray
    centers: np.ndarray

    @staticmethod
    def of(
        near: NearLight, channels: int, alpha: np.ndarray, switches: AngularPreset
    ) -> NearLobes:  # fmt: skip
        """Tabulate the lobes of (K,) widths."""
        profile = lobe_profile(switches.lobe)
        centers = dominance(alpha) if switches.off_specular else np.ones(len(alpha))
        return NearLobes(
            near, channels, alpha, AlbedoTable.of(alpha, switches.fresnel),
            zonal=np.array([zonal_factors(profile, a, DEGREE) for a in alpha.tolist()]),
            sharp=np.exp(-((alpha * (DEGREE + 1)) ** 2)), centers=2 * centers,
        )  # fmt: skip

    @property
    def moments(self) -> list[list[Any]]:
        """Diffuse moments, 8 (S,) Floats per channel."""
        of_color = self.near.moments
        return (
            of_color if self.channels == 3 else [[sum(x) / 3 for x in zip(*of_color, strict=True)]]
        )

    def reflect(self, surface: TexelLanes, direction: Any, cosine: Any, free: Any) -> list[Lobe]:
        """Return the light reflected by each lobe; ``free`` marks unoccluded mirror rays."""
        normal = mi.Vector3f(surface.normal)
        mirror = mi.Frame3f(normal).to_local(mirror_direction(normal, direction))
        up = mi.Vector3f(0, 0, 1)
        directions = up, dr.normalize(up + mirror), mirror
        parts = [self.near.at(surface.lane, local) for local in directions]
        result = []
        for level, alpha in enumerate(self.alpha.tolist()):
            *color, hidden = self._averaged(level, parts)
            part = hidden
            if free is not None:
                met = dr.select(free, mi.Float(0), 1)
                part = dr.lerp(hidden, met, dr.opaque(mi.Float, self.sharp[level]))
            scale = dr.maximum(part, 0) / dr.maximum(hidden, FAINT)
            color = [sum(color) / 3] if self.channels == 1 else color
            light = [scale * dr.maximum(value, 0) for value in color]
            A, B, D = self.albedo.at(level, alpha, cosine)
            result.append([(A * value, B * value, D * value) for value in light])
        return result

    def _averaged(self, level: int, parts: list[list[list[Any]]]) -> list[Any]:
        """Return R, G, B and H averaged by a lobe, between two of the three directions."""
        first = min(int(self.centers[level]), 1)
        zonal = [dr.opaque(mi.Float, x) for x in self.zonal[level].tolist()]
        low, high = (
            [sum(z * x for z, x in zip(zonal, part, strict=True)) for part in parts[first + step]]
            for step in (0, 1)
        )
        place = dr.opaque(mi.Float, self.centers[level] - first)
        return [dr.lerp(a, b, place) for a, b in zip(low, high, strict=True)]
