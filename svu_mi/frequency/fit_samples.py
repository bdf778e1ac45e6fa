"""Samples and fits of Eq. 12: radiance of texels, and the light that they mirror."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError
from svu_mi.frequency.fit_sh import SolverGroup, fit_lanes, solver_groups
from svu_mi.frequency.harmonics import FitSystem
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import TexelLanes, mirror_direction
from svu_mi.geometry.texels import Texels
from svu_mi.geometry.visibility import Visibility
from svu_mi.light.band_limited import Lighting
from svu_mi.light.light_visibility import trace_mirror
from svu_mi.presets import Fit, Preset

Masking = Callable[[Any, Any], list[Any]]
"""Cosines and numbers of texels to F factors."""


class FitSource(Protocol):
    """Photographs of texels under a light, as ``observations.Observed`` has them."""

    @property
    def views(self) -> Views:
        """The packed capture."""

    @property
    def lighting(self) -> Lighting:
        """Its band-limited light."""

    @property
    def texels(self) -> Texels:
        """The T texels."""

    @property
    def visibility(self) -> Visibility:
        """Which views see which texels."""


@dataclass(frozen=True)
class FitSamples:
    """Rows of Eq. 12, of the texels ``surface``.

    Attributes:
        occluded: exclude light that the object occludes.
        channels: C of the photographs, 1 or 3; 0 leaves them out.
        light_channels: of the light, C or 1.
        masking: factors of the light, by cos theta_i (cos theta_o of a mirror) and texel: one
            right-hand side per factor and channel. Default 1.
    """

    observed: FitSource
    surface: TexelLanes
    occluded: bool
    channels: int
    light_channels: int
    masking: Masking | None = None

    def at(self, slot: Any) -> tuple[Any, Any, list[Any]]:
        """Return view direction, w = |cos theta|, and both right-hand sides of one row."""
        views, lighting = self.observed.views, self.observed.lighting
        visibility = self.observed.visibility
        seen = visibility.sample(views, self.surface, slot)
        lit = visibility.needs_work(seen.seen)
        if self.occluded:
            lit = trace_mirror(views.scene, self.surface, seen, lit)
        incoming = dr.if_stmt(
            args=(seen.direction, mi.Vector3f(self.surface.normal)),
            cond=lit,
            true_fn=lambda view, normal: lighting.radiance(mirror_direction(normal, view)),
            false_fn=lambda *_: dr.zeros(mi.Color3f),
        )
        light = as_channels(incoming, self.light_channels)
        if self.masking is not None:
            factors = self.masking(seen.cosine, self.surface.index)
            light = [factor * value for factor in factors for value in light]
        shown = as_channels(seen.radiance, self.channels) if self.channels else []
        return seen.direction, seen.cosine, [*shown, *light]


@dataclass(frozen=True)
class FitJob:
    """Fit of all texels, (T,) ``counts`` views each; may be repeated with another masking."""

    observed: FitSource
    switches: Preset | Fit
    counts: np.ndarray
    channels: int
    light_channels: int
    occluded: bool = False

    @cached_property
    def launches(self) -> list[tuple[SolverGroup, TexelLanes]]:
        """The texels of each solver."""
        groups = solver_groups(self.counts, self.switches.degree)
        return [(group, TexelLanes.of(self.observed.texels, group.selection)) for group in groups]

    def solutions(
        self, masking: Masking | None = None, factors: int = 1
    ) -> Iterator[tuple[Any, list[list[Any]]]]:
        """Yield the texels of each solver, UInt32, and their coefficients, not evaluated yet."""
        fit = self.switches
        system = FitSystem.of(
            fit.degree, self.channels + factors * self.light_channels, fit.regularizer,
            fit.penalize_constant,
        )  # fmt: skip
        # Made now: a texture that is made while a loop is recorded does not outlive the recording.
        dr.eval(self.observed.lighting.filtered)
        for group, surface in self.launches:
            samples = FitSamples(
                self.observed, surface, self.occluded, self.channels, self.light_channels, masking
            )
            yield (
                group.selection,
                fit_lanes(samples.at, self.observed.visibility.count, system, group.capacity),
            )


@dataclass(frozen=True)
class MirroredLight:
    """Light that S ``chosen`` texels mirror into their photographs, to be fitted (Eq. 12)."""

    observed: FitSource
    fit: Fit
    channels: int
    chosen: np.ndarray

    def allocate(self, rows: int) -> Any:
        """Return zeros for ``rows`` numbers per lane, evaluated: (rows S,) Float."""
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
        """(T,) UInt32, the lane of each texel; 0 for others."""
        lane = np.zeros(self.observed.texels.count, np.uint32)
        lane[self.chosen] = np.arange(len(self.chosen))
        return to_drjit(mi.UInt32, lane)

    def solutions(self, masking: Masking, count: int) -> Iterator[tuple[Any, list[list[Any]]]]:
        """Yield UInt32 lanes of seen texels, and (l* + 1)^2 lists of F C Floats, unevaluated."""
        for texel, coefficients in self._job.solutions(masking, count):
            yield dr.gather(mi.UInt32, self.lane, texel), coefficients

    @cached_property
    def _job(self) -> FitJob:
        """The fit, cached: texels keep their solver in all steps of a recovery."""
        counts = np.zeros(self.observed.texels.count, np.uint32)
        counts[self.chosen] = self.observed.visibility.coverage.numpy()[self.chosen]
        return FitJob(self.observed, self.fit, counts, 0, self.channels)
