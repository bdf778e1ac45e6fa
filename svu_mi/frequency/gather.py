"""SH fits and power spectra of what every texel shows, and of the light that it mirrors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.frequency.arrays import scatter_rows, scatter_strided
from svu_mi.frequency.fit import fit_lanes
from svu_mi.frequency.groups import SolverGroup, solver_groups
from svu_mi.frequency.spectrum import power_lanes
from svu_mi.interop import owned
from svu_mi.light import Lighting
from svu_mi.options import Fit, Preset
from svu_mi.surface import Texels
from svu_mi.visibility import Surface, Survey, Views
from svu_mi.visibility.observe import mirror_direction
from svu_mi.visibility.pixels import as_channels
from svu_mi.visibility.reach import mirror_free

Masking = Callable[[Any, Any], list[Any]]
"""Cosines and numbers of texels to F factors."""


@dataclass(frozen=True)
class Spectra:
    """Power spectra of T texels, TensorXf (T, l* + 1, C) in squared radiance; C is 3, or 1."""

    incoming: Any
    outgoing: Any


@dataclass(frozen=True)
class Samples:
    """Where the rows of Eq. 12 come from.

    Attributes:
        views: the packed capture.
        lighting: its band-limited light.
        surface: the texels of the launch.
        found: who sees whom.
        occluded: leave out light from where the object itself stands.
        channels: C of the photographs, 1 or 3; 0 leaves them out.
        light_channels: of the light, the same or 1.
        masking: factors of the light, by cos theta_i (cos theta_o, of a mirror) and by texel: each
            is a right-hand side per channel. By default 1.
    """

    views: Views
    lighting: Lighting
    surface: Surface
    found: Survey
    occluded: bool
    channels: int
    light_channels: int
    masking: Masking | None = None

    def at(self, slot: Any) -> tuple[Any, Any, list[Any]]:
        """One row: view direction, w = |cos theta|, and both right-hand sides.

        Outgoing radiance B is indexed by the direction to the camera; so is incoming radiance
        L, which is looked up where the mirror sends that direction.

        Args:
            slot: UInt32, which view: ``found.order[slot]``.
        """
        seen = self.found.look(self.views, self.surface, slot)
        lit = self.found.asked(seen.seen)
        if self.occluded:
            lit = mirror_free(self.views.scene, self.surface, seen, lit)

        def mirrored(direction: Any, normal: Any) -> Any:
            return self.lighting.radiance(mirror_direction(normal, direction))

        incoming = dr.if_stmt(
            args=(seen.direction, mi.Vector3f(self.surface.normal)),
            cond=lit,
            true_fn=mirrored,
            false_fn=lambda *_: dr.zeros(mi.Color3f),
        )
        light = as_channels(incoming, self.light_channels)
        if self.masking is not None:
            factors = self.masking(seen.cosine, self.surface.index)
            light = [factor * value for factor in factors for value in light]
        shown = as_channels(seen.radiance, self.channels) if self.channels else []
        return seen.direction, seen.cosine, [*shown, *light]


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
    job = _Job(
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
    job = _Job(
        views, lighting, texels, found, switches, switches.occluded, 3, light_channels,
        found.coverage.numpy(),
    )  # fmt: skip
    for group, coefficients in job.solutions():
        flat = [value for row in coefficients for value in row]
        values = scatter_strided(values, flat, group.selection, dr.opaque(mi.UInt32, texels.count))
        dr.eval(values)
    return Coefficients(values, switches.degree, 3, light_channels, texels.count)


@dataclass(frozen=True)
class MirroredLight:
    """The light that texels mirror into their photographs, to be fitted (Eq. 12).

    Attributes:
        views: the packed capture.
        lighting: its band-limited light.
        texels: the T texels.
        found: who sees whom.
        fit: degree, regulariser and R_00.
        channels: C of the light, 3 or 1.
        chosen: (S,) numbers of the texels to fit: their lanes.
    """

    views: Views
    lighting: Lighting
    texels: Texels
    found: Survey
    fit: Fit
    channels: int
    chosen: np.ndarray

    def room(self, rows: int) -> Any:
        """Return zeros for so many numbers per lane, evaluated: (rows S,) Float.

        Raises:
            OptionError: more than one array can hold.
        """
        size = rows * len(self.chosen)
        if size >= 2**32:
            raise OptionError(
                f"The SH model keeps {rows} numbers per texel, which is too much for "
                f"{len(self.chosen)} texels that are seen: {(2**32 - 1) // rows} at most; lower "
                "the resolution, or the degree of the fit."
            )
        values = dr.zeros(mi.Float, size)
        dr.eval(values)
        return values

    @cached_property
    def lane(self) -> Any:
        """(T,) UInt32, which lane a texel has; 0 for others."""
        lane = np.zeros(self.texels.count, np.uint32)
        lane[self.chosen] = np.arange(len(self.chosen))
        return owned(mi.UInt32, lane)

    def solutions(self, masking: Masking, count: int) -> Iterator[tuple[Any, list[list[Any]]]]:
        """Fit masked light.

        Args:
            masking: what the light is multiplied by. It should read opaque numbers, so that one
                kernel serves all.
            count: F, how many factors it returns.

        Yields:
            UInt32 lanes of texels that some view sees, and their (l* + 1)^2 coefficients: lists
            of F C Floats, not evaluated yet.
        """
        counts = np.zeros(self.texels.count, np.uint32)
        counts[self.chosen] = self.found.coverage.numpy()[self.chosen]
        job = _Job(
            self.views, self.lighting, self.texels, self.found, self.fit, False, 0, self.channels,
            counts, masking, count,
        )  # fmt: skip
        for group, coefficients in job.solutions():
            yield dr.gather(mi.UInt32, self.lane, group.selection), coefficients


@dataclass(frozen=True)
class _Job:
    """What a fit of all texels was asked for; ``counts`` (T,) are the views of each to fit."""

    views: Views
    lighting: Lighting
    texels: Texels
    found: Survey
    switches: Preset | Fit
    occluded: bool
    channels: int
    light_channels: int
    counts: np.ndarray
    masking: Masking | None = None
    factors: int = 1

    def solutions(self) -> Iterator[tuple[SolverGroup, list[list[Any]]]]:
        """Yield the lanes of each solver and their coefficients, not evaluated yet."""
        switches = self.switches
        # Made now: a texture that is made while a loop is recorded does not outlive the recording.
        dr.eval(self.lighting.filtered)
        for group in solver_groups(self.counts, switches.degree):
            samples = Samples(
                self.views, self.lighting, Surface.of(self.texels, group.selection), self.found,
                self.occluded, self.channels, self.light_channels, self.masking,
            )  # fmt: skip
            yield (
                group,
                fit_lanes(
                    samples.at,
                    self.found.count,
                    degree=switches.degree,
                    channels=self.channels + self.factors * self.light_channels,
                    regularizer=switches.regularizer,
                    penalize_constant=switches.penalize_constant,
                    method=group.method,
                    capacity=group.capacity,
                ),
            )
