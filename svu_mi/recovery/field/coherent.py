"""Random fields that vary smoothly over an object, by random Fourier features.

A sum of waves of random direction and length is a Gaussian field in the limit of many
[Rahimi and Recht 2007]; here its correlation is exp(-d^2 / (2 l^2)) at a distance d in space.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned

WAVES = 96


@dataclass(frozen=True)
class Waves:
    """N fields of mean 0 and variance 1.

    Attributes:
        number: N.
        frequencies: (N WAVES,) Vector3f, of unit length scale.
        phases: (N WAVES,) Float.
    """

    number: int
    frequencies: Any
    phases: Any

    @staticmethod
    def draw(number: int, random: np.random.Generator) -> Waves:
        """Draw N fields."""
        frequencies = random.standard_normal((3, number * WAVES)).astype(np.float32)
        phases = random.uniform(0, 2 * np.pi, number * WAVES).astype(np.float32)
        return Waves(number, owned(mi.Vector3f, frequencies), owned(mi.Float, phases))

    def at(self, place: Any) -> list[Any]:
        """Return the fields, Floats (T,).

        Args:
            place: (T,) Point3f in units of the length l.
        """
        found = []
        for field in range(self.number):
            first = dr.opaque(mi.UInt32, field * WAVES)

            def add(wave: Any, total: Any, first: Any = first) -> tuple[Any, Any]:
                w = dr.gather(mi.Vector3f, self.frequencies, first + wave)
                phase = dr.gather(mi.Float, self.phases, first + wave)
                return wave + 1, total + dr.cos(dr.dot(w, mi.Vector3f(place)) + phase)

            start = (mi.UInt32(0), dr.zeros(mi.Float, dr.width(place)))
            total = dr.while_loop(start, lambda wave, _: wave < WAVES, add)[1]
            found.append(float(np.sqrt(2 / WAVES)) * total)
        dr.eval(found)
        return found
