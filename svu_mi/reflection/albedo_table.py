"""Albedo of specular lobes by level and viewing angle."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.presets import Fresnel
from svu_mi.reflection.lobes import ALBEDO_NODES, split_sum, view_albedo


@dataclass(frozen=True)
class AlbedoTable:
    """Albedo of lobes of K widths.

    Attributes:
        values: (K * ALBEDO_NODES * 4,) Float: A and B (split sum), D with exact dielectric
            reflectance, and 0 per node.
    """

    rule: Fresnel
    values: Any

    @staticmethod
    def of(alpha: np.ndarray, rule: Fresnel) -> "AlbedoTable":
        """Tabulate lobes of (K,) widths."""
        table = np.zeros((len(alpha), ALBEDO_NODES, 4))
        if rule == "split_sum":
            table[..., :3] = split_sum(alpha)
        return AlbedoTable(rule, to_drjit(mi.Float, table.ravel()))

    def at(self, level: Any, alpha: Any, cosine: Any) -> tuple[Any, Any, Any]:
        """Return (A, B, D): the albedo of a metal is R0 A + B, of a dielectric D."""
        if self.rule != "split_sum":
            return view_albedo(self.rule, cosine, alpha)
        place = dr.clip(cosine * ALBEDO_NODES - 0.5, 0, ALBEDO_NODES - 1.001)
        first = mi.UInt32(dr.detach(place))
        index = first + level * ALBEDO_NODES
        here, after = (dr.gather(mi.Vector4f, self.values, index + step) for step in (0, 1))
        A, B, D, _ = dr.lerp(here, after, place - first)
        return A, B, D
