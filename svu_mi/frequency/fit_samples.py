"""Samples and fits of Eq. 12: radiance of texels, and mirrored light."""

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
"""``(cosine, texel) -> F factors``: masking of the light (see ``FitSamples``)."""


class FitSource(Protocol):
    """Interface: the part of ``observations.Observed`` that fits use."""

    @property
    def views(self) -> Views:
        """Packed photographs and cameras."""

    @property
    def lighting(self) -> Lighting:
        """Band-limited light."""

    @property
    def texels(self) -> Texels:
        """T texels."""

    @property
    def visibility(self) -> Visibility:
        """Visibility of texels in views."""


@dataclass(frozen=True)
class FitSamples:
    """Samples of Eq. 12 for the texels ``surface``.

    Attributes:
        occluded: exclude light that the object occludes.
        channels: number of channels C of the photographs, 1 or 3; 0: fit the light only.
        light_channels: number of channels of the light, C or 1.
        masking: function from cos theta_i and texel to F factors of the light; each factor adds
            right-hand sides to the equations. Default: one factor of 1.
    """

    observed: FitSource
    surface: TexelLanes
    occluded: bool
    channels: int
    light_channels: int
    masking: Masking | None = None

    def at(self, slot: Any) -> tuple[Any, Any, list[Any]]:
        """Return view direction, w = |cos theta|, and radiance of photographs and light."""
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
    """Fits of all texels; ``counts``, (T,), is the number of views of each texel."""

    observed: FitSource
    switches: Preset | Fit
    counts: np.ndarray
    channels: int
    light_channels: int
    occluded: bool = False

    @cached_property
    def launches(self) -> list[tuple[SolverGroup, TexelLanes]]:
        """Groups of texels that share a solver (``solver_groups``)."""
        groups = solver_groups(self.counts, self.switches.degree)
        return [(group, TexelLanes.of(self.observed.texels, group.selection)) for group in groups]

    def solutions(
        self, masking: Masking | None = None, factors: int = 1
    ) -> Iterator[tuple[Any, list[list[Any]]]]:
        """Yield the texels of each solver, UInt32, and their unevaluated coefficients."""
        fit = self.switches
        system = FitSystem.of(
            fit.degree, self.channels + factors * self.light_channels, fit.regularizer,
            fit.penalize_constant,
        )  # fmt: skip
        # Evaluated here: Dr.Jit frees a texture that is created while a loop is recorded.
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
    """Light that S ``chosen`` texels mirror into their views, to be fitted (Eq. 12)."""

    observed: FitSource
    fit: Fit
    channels: int
    chosen: np.ndarray

    def allocate(self, rows: int) -> Any:
        """Return evaluated zeros, (rows S,) Float."""
        size = rows * len(self.chosen)
        if size >= 2**32:
            raise OptionError(
                f"The SH model stores {rows} numbers per texel, so at most {(2**32 - 1) // rows} "
                f"seen texels are possible, got {len(self.chosen)}; lower the resolution or the "
                "degree of the fit."
            )
        values = dr.zeros(mi.Float, size)
        dr.eval(values)
        return values

    @cached_property
    def lane(self) -> Any:
        """(T,) UInt32, lane of each texel; 0 if not chosen."""
        lane = np.zeros(self.observed.texels.count, np.uint32)
        lane[self.chosen] = np.arange(len(self.chosen))
        return to_drjit(mi.UInt32, lane)

    def solutions(self, masking: Masking, count: int) -> Iterator[tuple[Any, list[list[Any]]]]:
        """Yield lanes of texels, UInt32, and (l* + 1)^2 lists of F C unevaluated Floats."""
        for texel, coefficients in self._job.solutions(masking, count):
            yield dr.gather(mi.UInt32, self.lane, texel), coefficients

    @cached_property
    def _job(self) -> FitJob:
        """Fit of the chosen texels; cached, because all steps of a recovery use it."""
        counts = np.zeros(self.observed.texels.count, np.uint32)
        counts[self.chosen] = self.observed.visibility.coverage.numpy()[self.chosen]
        return FitJob(self.observed, self.fit, counts, 0, self.channels)
