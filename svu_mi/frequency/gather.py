"""SH fits and power spectra of what every texel shows, and of the light that it mirrors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.frequency.arrays import scatter_rows, scatter_strided
from svu_mi.frequency.samples import Job
from svu_mi.frequency.spectrum import power_lanes
from svu_mi.light import Lighting
from svu_mi.options import Preset
from svu_mi.surface import Texels
from svu_mi.visibility import Survey, Views


@dataclass(frozen=True)
class Spectra:
    """Power spectra of T texels, TensorXf (T, l* + 1, C) in squared radiance; C is 3, or 1."""

    incoming: Any
    outgoing: Any


def fit_spectra(
    views: Views,
    lighting: Lighting,
    texels: Texels,
    found: Survey,
    switches: Preset,
    *,
    channels: int | None = None,
    light_channels: int | None = None,
    skip_unseen: bool = True,
) -> Spectra:
    """Gather, fit and take power spectra in one kernel per solver; samples are never stored.

    Args:
        views: the packed capture.
        lighting: its band-limited light.
        texels: the T texels.
        found: who sees whom.
        switches: degree, regulariser, R_00 of Eq. 12 and occlusion.
        channels: C of the photographs to fit, 1 or 3; the preset's own by default.
        light_channels: of the light; 1 stands for all C of grey light.
        skip_unseen: False solves for texels that no view sees, too; they stay 0.
    """
    colors = channels or switches.colors
    light = light_channels or colors
    shape = (texels.count, switches.degree + 1, colors)
    outgoing, incoming = dr.zeros(mi.TensorXf, shape), dr.zeros(mi.TensorXf, shape)
    dr.eval(outgoing, incoming)
    job = Job(
        views, lighting, texels, found, switches, switches.occluded, colors, light,
        found.coverage.numpy() if skip_unseen else np.maximum(found.coverage.numpy(), 1),
    )  # fmt: skip
    for group, coefficients in job.solutions():
        power = power_lanes(coefficients)
        copies = colors // light
        scatter_rows(outgoing.array, [row[:colors] for row in power], group.selection)
        scatter_rows(incoming.array, [row[colors:] * copies for row in power], group.selection)
        dr.eval(outgoing, incoming)
    return Spectra(incoming=incoming, outgoing=outgoing)


@dataclass(frozen=True)
class Coefficients:
    """SH coefficients of what T texels show, and of the light that they mirror.

    Attributes:
        values: (K (C + C') T,) Float: for coefficient l*l + l + m, then channel of the
            photographs or of the light, one value per texel, in radiance; 0 where not seen.
        degree: l*, so that K = (l* + 1)^2.
        channels: C of the photographs.
        light_channels: C' of the light, the same or 1.
        count: T.
    """

    values: Any
    degree: int
    channels: int
    light_channels: int
    count: int

    def outgoing(self, index: int, channel: int, texel: Any) -> Any:
        """Read a coefficient of the photographs for texels."""
        return self._read(index, channel, texel)

    def incoming(self, index: int, channel: int, texel: Any) -> Any:
        """Read a coefficient of the light, where channel may be any of the photographs'."""
        return self._read(index, self.channels + channel % self.light_channels, texel)

    def _read(self, index: int, row: int, texel: Any) -> Any:
        first = (index * (self.channels + self.light_channels) + row) * self.count
        return dr.gather(mi.Float, self.values, texel + dr.opaque(mi.UInt32, first))


def fit_coefficients(
    views: Views,
    lighting: Lighting,
    texels: Texels,
    found: Survey,
    switches: Preset,
    *,
    light_channels: int = 3,
) -> Coefficients:
    """Gather and fit as ``fit_spectra`` does, in three channels, and keep the coefficients.

    Memory: 24 bytes per texel and coefficient, 1.2 kB per texel at degree 6.

    Args:
        views: the packed capture, in three channels.
        lighting: its band-limited light.
        texels: the T texels.
        found: who sees whom.
        switches: degree, regulariser, R_00 of Eq. 12 and occlusion.
        light_channels: of the light, 3, or 1 if it is grey.
    """
    rows = (switches.degree + 1) ** 2 * (3 + light_channels)
    values = dr.zeros(mi.Float, rows * texels.count)
    dr.eval(values)
    job = Job(
        views, lighting, texels, found, switches, switches.occluded, 3, light_channels,
        found.coverage.numpy(),
    )  # fmt: skip
    for group, coefficients in job.solutions():
        flat = [value for row in coefficients for value in row]
        values = scatter_strided(values, flat, group.selection, dr.opaque(mi.UInt32, texels.count))
        dr.eval(values)
    return Coefficients(values, switches.degree, 3, light_channels, texels.count)
