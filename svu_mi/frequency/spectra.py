"""Spherical harmonic fits and power spectra of radiance and mirrored light."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.local_memory import scatter_rows, scatter_strided
from svu_mi.frequency.fit_samples import FitJob, FitSource
from svu_mi.frequency.harmonics import power_per_degree
from svu_mi.presets import Preset


@dataclass(frozen=True)
class Spectra:
    """Power spectra of light and radiance, (T, l* + 1, C) in squared radiance."""

    incoming: Any
    outgoing: Any


def fit_spectra(
    observed: FitSource,
    switches: Preset,
    *,
    channels: int | None = None,
    light_channels: int | None = None,
    skip_unseen: bool = True,
) -> Spectra:
    """Return the power spectra of all texels, without storing samples."""
    colors = channels or switches.colors
    light = light_channels or colors
    counts = np.maximum(observed.visibility.coverage.numpy(), 0 if skip_unseen else 1)
    shape = (observed.texels.count, switches.degree + 1, colors)
    outgoing, incoming = dr.zeros(mi.TensorXf, shape), dr.zeros(mi.TensorXf, shape)
    dr.eval(outgoing, incoming)
    job = FitJob(observed, switches, counts, colors, light, switches.occluded)
    for texel, coefficients in job.solutions():
        power, copies = power_per_degree(coefficients), colors // light
        scatter_rows(outgoing.array, [row[:colors] for row in power], texel)
        scatter_rows(incoming.array, [row[colors:] * copies for row in power], texel)
        dr.eval(outgoing, incoming)
    return Spectra(incoming=incoming, outgoing=outgoing)


@dataclass(frozen=True)
class Coefficients:
    """SH coefficients of radiance (C channels) and mirrored light (C') of T texels.

    Attributes:
        values: (K (C + C') T,) Float, by l*l + l + m, channel (first of radiance, then of light)
            and texel; 0 where unseen.
    """

    values: Any
    degree: int
    channels: int
    light_channels: int
    count: int

    def outgoing(self, index: int, channel: int, texel: Any) -> Any:
        """Return a coefficient of the radiance of texels."""
        return self._read(index, channel, texel)

    def incoming(self, index: int, channel: int, texel: Any) -> Any:
        """Return a coefficient of the light of texels, for a channel in [0, C)."""
        return self._read(index, self.channels + channel % self.light_channels, texel)

    def _read(self, index: int, row: int, texel: Any) -> Any:
        first = (index * (self.channels + self.light_channels) + row) * self.count
        return dr.gather(mi.Float, self.values, texel + dr.opaque(mi.UInt32, first))


def fit_coefficients(
    observed: FitSource, switches: Preset, *, light_channels: int = 3
) -> Coefficients:
    """Return the coefficients of three channels, fitted as in ``fit_spectra``."""
    count = observed.texels.count
    values = dr.zeros(mi.Float, (switches.degree + 1) ** 2 * (3 + light_channels) * count)
    dr.eval(values)
    coverage = observed.visibility.coverage.numpy()
    job = FitJob(observed, switches, coverage, 3, light_channels, switches.occluded)
    for texel, coefficients in job.solutions():
        flat = [value for row in coefficients for value in row]
        values = scatter_strided(values, flat, texel, dr.opaque(mi.UInt32, count))
        dr.eval(values)
    return Coefficients(values, switches.degree, 3, light_channels, count)
