"""Reflection of lamps and of a flash: sums over their cells with the exact BRDF."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.band_limited import diffuse_moments
from svu_mi.light.flash_light import FlashCell, FlashLight
from svu_mi.light.lamps import Lamps
from svu_mi.reflection.lobes import Normals
from svu_mi.reflection.wide_lobes import Lobe, LobeSums


@dataclass(frozen=True)
class LampLobes:
    """Lobes of (K,) widths under lamps; ``channels`` is 3, or 1 for the mean of R, G and B."""

    lamps: Lamps
    channels: int
    alpha: np.ndarray

    def reflect(self, lane: Any, normals: Normals, direction: Any, cosine: Any) -> list[Lobe]:
        """Return the light of lamps that each lobe reflects towards a camera."""
        sums = LobeSums(self.alpha, self.channels, normals, direction)
        first, cells = dr.gather(mi.UInt32, self.lamps.place, lane), self.lamps.cells
        return sums.of_cells(cells, cells.count, mi.Bool(True), cosine, first, self.lamps.lanes)


@dataclass(frozen=True)
class FlashLobes:
    """Diffuse reflection and lobes under a flash, whose direction differs between views."""

    light: FlashLight
    channels: int
    alpha: np.ndarray

    def moments(self, surface: TexelLanes, cell: FlashCell) -> list[list[Any]]:
        """Return the diffuse moments (``LightVisibility.diffuse``): 8 Floats per channel."""
        cosine = dr.maximum(dr.dot(surface.normal, cell.direction), 0)
        return [diffuse_moments(x, cosine, cell.direction) for x in cell.light(0, self.channels)]

    def retroreflection(
        self, surface: TexelLanes, cell: FlashCell, direction: Any, cosine: Any
    ) -> list[Any]:  # fmt: skip
        """Return the term R^2 F_o F_i / pi, without roughness^2, that ``diffuse_shading`` lacks.

        It matters near the camera only, where the lamp is.
        """
        incident = dr.maximum(dr.dot(surface.normal, cell.direction), 0)
        towards = dr.square(1 + dr.dot(direction, cell.direction))
        both = incident * ((1 - incident) * (1 - cosine)) ** 5 * towards / np.pi
        return [value * both for value in cell.light(0, self.channels)]

    def reflect(
        self, normals: Normals, cell: FlashCell, direction: Any, cosine: Any
    ) -> list[Lobe]:  # fmt: skip
        """Return the light that each lobe reflects towards the camera."""
        sums = LobeSums(self.alpha, self.channels, normals, direction)
        return sums.of_cells(cell, dr.opaque(mi.UInt32, 1), mi.Bool(True), cosine)
