"""Reflection model (Eq. 6): radiance of texels at each roughness level.

Radiance is a mixture of four parts e, p, q and d (``principled.py``). Narrow lobes read prefiltered
light, wide lobes sum light cells. ``fast`` has no wide lobes; ``paper`` uses spherical harmonics.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.band_limited import Lighting, moment_map
from svu_mi.light.flash_light import FlashLight
from svu_mi.light.lamps import Lamps
from svu_mi.light.light_visibility import LightVisibility
from svu_mi.light.near_light import NearLight
from svu_mi.presets import AngularPreset
from svu_mi.reflection.albedo_table import AlbedoTable
from svu_mi.reflection.lobes import Normals
from svu_mi.reflection.mix_columns import Parts, diffuse_shading
from svu_mi.reflection.narrow_lobes import NarrowLobes
from svu_mi.reflection.near_lobes import NearLobes
from svu_mi.reflection.principled import alpha_from_roughness
from svu_mi.reflection.wide_lobes import NARROW, Lobe, LobeSums, WideLobes, added, added_lobes


@dataclass(frozen=True)
class IncidentLight:
    """Light, visibility of its cells (None: unoccluded), and number of channels, 3 or 1.

    ``near`` is light from other surfaces, ``lamps`` and ``flash`` that of lamps; None without any.
    """

    lighting: Lighting
    visibility: LightVisibility | None
    channels: int
    near: NearLight | None = None
    lamps: Lamps | None = None
    flash: FlashLight | None = None


class FittedLobes(Protocol):
    """Lobes that use a fit of each texel's light (``ShLobes``)."""

    def reflect(self, direction: Any, cosine: Any) -> list[Lobe]:
        """Return the light that the lobe of each level reflects towards a camera."""


@dataclass(frozen=True)
class ReflectionModel:
    """Reflection of S texels at R roughness levels.

    Attributes:
        roughness: (R,) float64, roughness of the levels, ascending.
        narrow: narrow lobes, of the first levels; or None.
        wide: wide lobes, of the remaining levels; or None.
        fitted: lobes of all levels if light is fitted per texel; or None.
        near: lobes of all levels for light from other surfaces; or None.
        lamps, flash: lamps, which all levels add; or None.
        moments: moments of diffuse light (``LightVisibility.diffuse``), 8 (S,) Floats per channel.
    """

    roughness: np.ndarray
    surface: TexelLanes
    switches: AngularPreset
    narrow: NarrowLobes | None
    wide: WideLobes | None
    fitted: FittedLobes | None
    moments: list[list[Any]]
    near: NearLobes | None = None
    lamps: Lamps | None = None
    flash: FlashLight | None = None

    @staticmethod
    def of(
        surface: TexelLanes, light: IncidentLight, roughness: np.ndarray, switches: AngularPreset,
        fitted: FittedLobes | None = None,
    ) -> "ReflectionModel":  # fmt: skip
        """Prefilter the light (unless lobes are fitted) and sum its diffuse moments."""
        if np.any(np.diff(roughness) <= 0):
            raise OptionError(f"Roughness levels must be ascending, got {roughness.tolist()}.")
        lighting, visibility, channels = light.lighting, light.visibility, light.channels
        alpha = alpha_from_roughness(roughness)
        split = len(alpha) if visibility is None else int(np.searchsorted(alpha, NARROW, "right"))
        narrow, wide = None, None
        if fitted is None and split > 0:
            disk = visibility is None
            narrow = NarrowLobes.of(lighting, alpha[:split], switches, channels, disk=disk)
        if visibility is not None and split < len(alpha):
            wide = WideLobes(visibility, alpha[split:], channels)
        if visibility is None:
            moments = moment_map(lighting.environment, channels).in_world(surface.normal)
        else:
            moments = visibility.diffuse(surface, lighting, channels)
        near = None
        if light.near is not None:
            near = NearLobes(light.near, channels, alpha, AlbedoTable.of(alpha, switches.fresnel))
        for others in (light.near, light.lamps):
            if others is not None:
                grey = [[sum(x) / 3 for x in zip(*others.moments, strict=True)]]
                moments = added(moments, others.moments if channels == 3 else grey)
        dr.eval(moments)
        return ReflectionModel(
            roughness, surface, switches, narrow, wide, fitted, moments, near, light.lamps,
            light.flash,
        )  # fmt: skip

    @property
    def channels(self) -> int:
        """Number of channels of the light."""
        return len(self.moments)

    @property
    def levels(self) -> int:
        """Number of roughness levels R."""
        return len(self.roughness)

    @property
    def reads_mirrors(self) -> bool:
        """True if ``columns`` depends on the visibility of the mirror direction."""
        return self.narrow is not None and self.switches.traced and self.switches.occluded

    def columns(
        self, direction: Any, cosine: Any, free: Any, slot: Any | None = None,
        bend: tuple[Any, Any] | None = None,
    ) -> list[list[Parts]]:  # fmt: skip
        """Return (e, p, q, d) by level and channel.

        ``free`` marks unoccluded mirror rays. ``slot`` is the view, which a flash needs. ``bend``
        are deviations of the normal (``normal_deviations``), which count only if light is traced.
        """
        normals = Normals.of(self.surface.normal, bend if self.switches.traced else None)
        lobes, shown = [], self.moments
        if self.fitted is not None:
            lobes += self.fitted.reflect(direction, cosine)
        if self.narrow is not None:
            lobes += self.narrow.reflect(normals, direction, cosine, free)
        if self.wide is not None:
            lobes += self.wide.reflect(self.surface.lane, normals, direction, cosine)
        if self.near is not None:
            lobes = added_lobes(lobes, self.near.reflect(self.surface, direction, cosine))
        every = mi.Bool(True)
        sums = LobeSums(alpha_from_roughness(self.roughness), self.channels, normals, direction)
        if self.lamps is not None:
            first = dr.gather(mi.UInt32, self.lamps.place, self.surface.lane)
            cells = self.lamps.cells
            lit = sums.of_cells(cells, cells.count, every, cosine, first, self.lamps.lanes)
            lobes = added_lobes(lobes, lit)
        retro = [mi.Float(0)] * self.channels
        if self.flash is not None:
            if slot is None:
                raise OptionError("Views that are not photographs have no flash; use other light.")
            cell, normal = self.flash.seen_from(self.surface, slot), self.surface.normal
            lit = sums.of_cells(cell, dr.opaque(mi.UInt32, 1), every, cosine)
            lobes = added_lobes(lobes, lit)
            shown = added(shown, cell.moments(normal, self.channels))
            if self.switches.diffuse == "disney":
                retro = cell.retroreflection(normal, self.channels, direction, cosine)
        shading = [
            diffuse_shading(self.switches.diffuse, moments, direction, cosine) for moments in shown
        ]
        return [
            [
                (a + r * b + r * r * c, *lobe)
                for (a, b), c, lobe in zip(shading, retro, lobes[k], strict=True)
            ]
            for k, r in enumerate(self.roughness.tolist())
        ]
