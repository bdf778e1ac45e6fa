"""Specular lobes of lamps: sums over their cells with the exact BRDF.

Cells may be larger than narrow lobes. GGX is widened by the half-angle of the cell, which conserves
energy and hides gaps between cells: alpha^2 + rho^2 / 4, as the half vector turns half as far.
"""

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.light.lamps import Lamps
from svu_mi.reflection.lobes import Normals, widened_ggx
from svu_mi.reflection.wide_lobes import Lobe, LobeSums


@dataclass(frozen=True)
class LampLobes:
    """Lobes of (K,) widths under lamps; ``channels`` is 3, or 1 for the mean of R, G and B."""

    lamps: Lamps
    channels: int
    alpha: np.ndarray

    def reflect(self, lane: Any, normals: Normals, direction: Any, cosine: Any) -> list[Lobe]:
        """Return the light of lamps that each lobe reflects towards a camera."""
        sums = LobeSums(self.alpha, self.channels, normals, direction, widened_ggx)
        cells, every = self.lamps.seen_from(lane), mi.Bool(True)
        return sums.of_cells(cells, self.lamps.number, every, cosine)
