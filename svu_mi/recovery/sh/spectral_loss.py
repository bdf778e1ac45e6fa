"""Losses in the SH domain: the fit (Eq. 12) compared with the model (Eq. 7 to 11).

Photographs are read once, by the fit. The cost of a step is independent of the number of views.
With R the directional albedo of a lobe (1 unless enabled by the preset),

    c_model(l, m) = Ks R exp(-(alpha l)^2) c_L(l, m)        for l > 0       (Eq. 7)
    c_model(0, 0) = 2 Kd E / sqrt(pi) + Ks R c_L(0, 0)
    S_model(l)    = c_model^2 with S_L(l) in place of c_L(l, m)^2           (Eq. 11)

The loss is the mean absolute difference over n coefficients (l, m) or degrees l, S texels and C
channels, divided by the unit: the mean radiance or power of the capture.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.frequency.spectra import Coefficients, fit_coefficients
from svu_mi.posterior.observations import Observed
from svu_mi.presets import Preset
from svu_mi.recovery.sh.quadratic_error import look_up
from svu_mi.reflection.lobes import mean_albedo
from svu_mi.reflection.principled import (
    alpha_from_roughness,
    diffuse_from_principled,
    specular_from_principled,
)
from svu_mi.statistics.gather_statistics import Values, mixing_values

Domain = Literal["coefficients", "spectrum"]

ALBEDO_LEVELS = 33  # roughness nodes of the albedo, interpolated linearly


@dataclass(frozen=True, kw_only=True)
class SpectralObjective:
    """Mean absolute error of SH coefficients or power spectra of S observed texels.

    Attributes:
        domain: ``coefficients`` or ``spectrum``.
        coefficients: SH coefficients of photographs and light of all T texels; empty if the
            domain is the spectrum.
        power: (2 (l* + 1) C S,) Float: rows S_B and S_L by degree and channel.
        irradiance: Irradiance E, a Float (S,) per channel.
        texel: (S,) UInt32, index of each observed texel.
        place: (S,) UInt32, flat index of each observed texel in a texture.
        prefilter: Opaque Float, alpha'^2 of the light's prefilter, which the model undoes; or 0.
        albedo: (ALBEDO_LEVELS,) Float, R by roughness.
        factor: Opaque Float, 1 / (S C n unit).
    """

    domain: Domain
    coefficients: Coefficients
    power: Any
    irradiance: list[Any]
    texel: Any
    place: Any
    prefilter: Any
    albedo: Any
    factor: Any

    def __call__(self, textures: Mapping[str, Any], _: int = 0) -> Any:
        """Return the loss, a Float that is differentiable in the textures."""
        return dr.sum(self.errors(look_up(textures, self.place))) * self.factor

    def errors(self, values: Values) -> Any:
        """Return the sum of absolute differences per texel, (S,) Float."""
        (roughness,), mixed = values["roughness"], mixing_values(values)
        alpha = alpha_from_roughness(roughness)
        width = dr.maximum(dr.square(alpha) - self.prefilter, 0)
        lobe, total = self._albedo(roughness), mi.Float(0)
        for c, color in enumerate(values["base_color"]):
            specular = lobe * specular_from_principled(color, *mixed)
            diffuse = diffuse_from_principled(color, *mixed)
            constant = diffuse * self.irradiance[c % len(self.irradiance)] * 2 / math.sqrt(math.pi)
            for l in range(self.coefficients.degree + 1):
                scale = specular * dr.exp(-width * (l * l)) if l else specular
                offset = constant if l == 0 else mi.Float(0)
                total += self._differences(l, c, scale, offset)
        return total

    def _differences(self, l: int, channel: int, scale: Any, offset: Any) -> Any:
        """Return |observed - model| of degree l, for the model ``scale`` c_L + ``offset``."""
        if self.domain == "spectrum":
            count = dr.width(self.texel)
            lane, row = dr.arange(mi.UInt32, count), 2 * (3 * l + channel)
            S_B, S_L = (
                dr.gather(mi.Float, self.power, lane + dr.opaque(mi.UInt32, (row + k) * count))
                for k in (0, 1)
            )
            # At degree 0 the diffuse term and the lobe add up before squaring.
            model = dr.square(offset + scale * dr.sqrt(S_L)) if l == 0 else scale * scale * S_L
            return dr.abs(S_B - model)
        read, total = self.coefficients, mi.Float(0)
        for index in range(l * l, (l + 1) ** 2):
            observed = read.outgoing(index, channel, self.texel)
            light = read.incoming(index, channel, self.texel)
            total += dr.abs(observed - dr.fma(scale, light, offset))
        return total

    def _albedo(self, roughness: Any) -> Any:
        place = dr.clip(roughness, 0, 1) * (ALBEDO_LEVELS - 1)
        first = dr.minimum(mi.UInt32(dr.detach(place)), ALBEDO_LEVELS - 2)
        low, high = (dr.gather(mi.Float, self.albedo, first + k) for k in (0, 1))
        return dr.lerp(low, high, place - first)


def spectral_objective(observed: Observed, switches: Preset, domain: Domain) -> SpectralObjective:
    """Return the loss of a capture; fits SH to photographs and light."""
    visibility, lighting, texels = observed.visibility, observed.lighting, observed.texels
    light = 1 if lighting.environment.grey else 3
    seen = observed.coverage > 0
    texel = to_drjit(mi.UInt32, np.flatnonzero(seen).astype(np.uint32))
    fitted = fit_coefficients(observed, switches, light_channels=light)
    power, mean_power = _powers(fitted, texel)
    unit = visibility.scale if domain == "coefficients" else mean_power
    terms = (switches.degree + 1) ** (2 if domain == "coefficients" else 1)
    if domain == "spectrum":
        fitted = replace(fitted, values=mi.Float())
    undone = lighting.prefilter**2 if switches.undo_prefilter else 0.0
    lanes = to_drjit(mi.UInt32, observed.lane[seen].astype(np.uint32))
    albedo = np.ones(ALBEDO_LEVELS)
    if switches.albedo:
        albedo = mean_albedo(alpha_from_roughness(np.linspace(0, 1, ALBEDO_LEVELS)))
    return SpectralObjective(
        domain=domain,
        coefficients=fitted,
        power=power,
        irradiance=[dr.gather(mi.Float, E, lanes) for E in observed.irradiance(switches, light)],
        texel=texel,
        place=dr.gather(mi.UInt32, texels.index, texel),
        prefilter=dr.opaque(mi.Float, undone),
        albedo=to_drjit(mi.Float, albedo),
        factor=dr.opaque(mi.Float, 1 / (3.0 * dr.width(texel) * terms * unit)),
    )


def _powers(fitted: Coefficients, texel: Any) -> tuple[Any, float]:
    """Return power spectra of observed texels (Eq. 8), and the mean observed power."""
    rows = []
    for l in range(fitted.degree + 1):
        orders = range(l * l, (l + 1) ** 2)
        for c in range(3):
            for read in (fitted.outgoing, fitted.incoming):
                rows.append(sum(dr.square(read(index, c, texel)) for index in orders))
    dr.eval(rows)
    total = sum(float(row.numpy().sum(dtype=np.float64)) for row in rows[::2])
    return dr.concat(rows), total / (3 * dr.width(texel))
