"""Reflection model for rendering: a roughness per lane, prefiltered light, no rays traced.

Prefiltered light and albedo are interpolated linearly between two roughness levels. An oblique lobe
is replaced by a symmetric one of equal solid angle, with width alpha sqrt(cos theta_h).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.geometry.sample_view import mirror_direction
from svu_mi.light.band_limited import Lighting
from svu_mi.light.prefiltered import LightStack, stack_levels
from svu_mi.presets import AngularPreset
from svu_mi.reflection.albedo_table import AlbedoTable
from svu_mi.reflection.lobes import dominance
from svu_mi.reflection.mix_columns import Parts, combine_parts, diffuse_shading
from svu_mi.reflection.narrow_lobes import NarrowLobes
from svu_mi.reflection.principled import alpha_from_roughness

NARROWEST = 1e-3  # minimum cosine of the viewing angle


@dataclass(frozen=True)
class PrefilteredModel:
    """Prefiltered light and albedo of lobes.

    Attributes:
        light: light prefiltered at R roughness levels, uniform on [0, 1].
        narrow: True: oblique lobes are narrower; False: as in Eq. 6.
    """

    switches: AngularPreset
    light: LightStack
    albedo: AlbedoTable
    narrow: bool

    @property
    def channels(self) -> int:
        """Number of channels of the light, 3 or 1."""
        return self.light.channels


def prefiltered_model(
    lighting: Lighting, switches: AngularPreset, levels: int = 16, channels: int = 3
) -> PrefilteredModel:
    """Prefilter the light at roughness levels that are uniform on [0, 1]."""
    lobes = NarrowLobes.of(
        lighting, alpha_from_roughness(np.linspace(0, 1, levels)), switches, channels
    )
    narrow = switches.lobe == "ggx" and switches.off_specular
    return PrefilteredModel(switches, stack_levels(lobes.levels), lobes.albedo, narrow)


def shade(
    model: PrefilteredModel,
    roughness: Any,
    normal: Any,
    direction: Any,
    moments: list[list[Any]],
    *,
    visible: Callable[[Any, Any], Any] | None = None,
    to_moments: Any | None = None,
) -> list[Parts]:
    """Return the parts (e, p, q, d) of each channel for one view per lane.

    ``moments`` are diffuse moments (``LightVisibility.diffuse``). ``to_moments`` rotates
    world space to the frame of ``moments``. ``visible(mirror, alpha)`` returns the visibility of
    the lobe.
    """
    normal, rule = mi.Vector3f(normal), model.switches.diffuse
    cosine = dr.maximum(dr.dot(normal, direction), NARROWEST)
    outgoing = direction if to_moments is None else to_moments @ mi.Vector3f(direction)
    shading = [diffuse_shading(rule, each, outgoing, cosine) for each in moments]
    lobe, albedo = lobe_light(model, roughness, normal, direction)
    if visible is not None:
        seen = visible(mirror_direction(normal, direction), alpha_from_roughness(roughness))
        lobe = [seen * value for value in lobe]
    return combine_parts(shading, roughness, albedo, lobe)


def lobe_light(
    model: PrefilteredModel, roughness: Any, normal: Any, direction: Any
) -> tuple[list[Any], tuple[Any, Any, Any]]:
    """Return the unoccluded light in a lobe, per channel, and the albedos (A, B, D)."""
    cosine = dr.maximum(dr.dot(normal, direction), NARROWEST)
    alpha = alpha_from_roughness(roughness)
    center = mirror_direction(normal, direction)
    if model.switches.off_specular:
        center = dr.normalize(dr.lerp(normal, center, dominance(alpha)))
    place = dr.clip(roughness, 0, 1) * (model.light.count - 1)
    light = model.light.radiance(place * _narrower(model, center, direction), center)
    level = mi.UInt32(dr.clip(mi.Int32(dr.detach(place)), 0, model.light.count - 2))
    here, above = (model.albedo.at(level + step, alpha, cosine) for step in (0, 1))
    A, B, D = (dr.lerp(a, b, place - level) for a, b in zip(here, above, strict=True))
    return light, (A, B, D)


def _narrower(model: PrefilteredModel, center: Any, direction: Any) -> Any:
    """Return the factor of roughness for oblique lobes, sqrt(sqrt(cos theta_h))."""
    if not model.narrow:
        return 1.0
    # Half vector of the lobe's centre: cos^2 theta_h = (1 + center . direction) / 2.
    square = (1 + dr.dot(center, mi.Vector3f(direction))) / 2
    return dr.maximum(square, NARROWEST) ** 0.125
