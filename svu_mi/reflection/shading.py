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

    @staticmethod
    def of(
        diffuse: list[tuple[Any, Any]], roughness: Any, reflected: tuple[Any, Any, Any],
        light: list[Any],
    ) -> Shading:  # fmt: skip
        """Put diffuse and specular light together.

        Args:
            diffuse: a and b of a + b roughness, per channel (``diffuse_shading``).
            roughness: Float.
            reflected: (A, B, D), what a lobe reflects: R0 A + B, and that of a dielectric D.
            light: under the lobe, per channel.
        """
        A, B, D = reflected
        return Shading(
            diffuse=[dr.fma(roughness, b, a) for a, b in diffuse],
            scaled=[A * value for value in light],
            added=[B * value for value in light],
            dielectric=[D * value for value in light],
        )

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
