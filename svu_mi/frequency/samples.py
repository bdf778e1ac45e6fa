"""Samples of Eq. 12: what texels show, and the light that they mirror; and fits to them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.frequency.fit import fit_lanes
from svu_mi.frequency.groups import SolverGroup, solver_groups
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


@dataclass(frozen=True)
class Job:
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

    @cached_property
    def launches(self) -> list[tuple[SolverGroup, Surface]]:
        """The texels of each solver."""
        groups = solver_groups(self.counts, self.switches.degree)
        return [(group, Surface.of(self.texels, group.selection)) for group in groups]

    def solutions(
        self, masking: Masking | None = None, factors: int = 1
    ) -> Iterator[tuple[SolverGroup, list[list[Any]]]]:
        """Yield the lanes of each solver and their coefficients, not evaluated yet.

        Args:
            masking: of the light, as for ``Samples``.
            factors: how many it returns.
        """
        switches = self.switches
        # Made now: a texture that is made while a loop is recorded does not outlive the recording.
        dr.eval(self.lighting.filtered)
        for group, surface in self.launches:
            samples = Samples(
                self.views, self.lighting, surface, self.found, self.occluded, self.channels,
                self.light_channels, masking,
            )  # fmt: skip
            yield (
                group,
                fit_lanes(
                    samples.at,
                    self.found.count,
                    degree=switches.degree,
                    channels=self.channels + factors * self.light_channels,
                    regularizer=switches.regularizer,
                    penalize_constant=switches.penalize_constant,
                    method=group.method,
                    capacity=group.capacity,
                ),
            )
