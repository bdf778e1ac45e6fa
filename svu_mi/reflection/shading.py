"""What one sample reflects, in parts that base colour and metallic mix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr


@dataclass(frozen=True)
class Shading:
    """e, p, q and d of one sample per lane: a Float per channel of the light each."""

    diffuse: list[Any]
    scaled: list[Any]
    added: list[Any]
    dielectric: list[Any]

    @property
    def parts(self) -> tuple[list[Any], ...]:
        """e, p, q and d."""
        return self.diffuse, self.scaled, self.added, self.dielectric

    def radiance(self, base_color: Any, metallic: Any) -> list[Any]:
        """Outgoing radiance, a Float per channel of the base colour.

        Args:
            base_color: sequence of Floats in [0, 1].
            metallic: Float in [0, 1].
        """
        result = []
        for k, color in enumerate(base_color):
            c = k % len(self.diffuse)  # grey light has one channel for all
            dielectric = dr.fma(color, self.diffuse[c], self.dielectric[c])
            metal = dr.fma(color, self.scaled[c], self.added[c])
            result.append(dr.lerp(dielectric, metal, metallic))
        return result
