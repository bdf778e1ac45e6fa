"""Albedo of specular lobes by level and viewing angle."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.presets import Fresnel
from svu_mi.reflection.lobes import ALBEDO_NODES, dielectric_albedo, split_sum, view_albedo


@dataclass(frozen=True)
class AlbedoTable:
    """Albedo of lobes of K widths.

    Attributes:
        metal: (K * ALBEDO_NODES * 2,) Float, split-sum pairs (A, B).
        dielectric: (K * ALBEDO_NODES,) Float, albedo with exact dielectric reflectance.
    """

    rule: Fresnel
    metal: Any
    dielectric: Any

    @staticmethod
    def of(alpha: np.ndarray, rule: Fresnel) -> "AlbedoTable":
        """Tabulate lobes of (K,) widths."""
        return AlbedoTable(
            rule, to_drjit(mi.Float, split_sum(alpha).ravel()),
            to_drjit(mi.Float, dielectric_albedo(alpha).ravel()),
        )  # fmt: skip

    def at(self, level: int, alpha: float, cosine: Any) -> tuple[Any, Any, Any]:
        """Return (A, B, D): the albedo of a metal is R0 A + B, of a dielectric D."""
        if self.rule != "split_sum":
            return view_albedo(self.rule, cosine, alpha)
        place = dr.clip(cosine * ALBEDO_NODES - 0.5, 0, ALBEDO_NODES - 1.001)
        first = mi.UInt32(place)
        part = place - first
        index = first + level * ALBEDO_NODES
        here, after = (dr.gather(mi.Vector2f, self.metal, index + step) for step in (0, 1))
        pair = dr.lerp(here, after, part)
        low, high = (dr.gather(mi.Float, self.dielectric, index + step) for step in (0, 1))
        return pair.x, pair.y, dr.lerp(low, high, part)
