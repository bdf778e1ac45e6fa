"""Power spectra of what every texel shows, and of the light that it mirrors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.frequency.arrays import scatter_rows
from svu_mi.frequency.fit import fit_lanes
from svu_mi.frequency.groups import solver_groups
from svu_mi.frequency.spectrum import power_lanes
from svu_mi.options import Preset
from svu_mi.radiance import Lighting, Surface, Survey, Views
from svu_mi.radiance.hemisphere import as_channels, mirror_free
from svu_mi.surface import Texels


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
        channels: C of the photographs, 1 or 3.
        light_channels: of the light, the same or 1.
    """

    views: Views
    lighting: Lighting
    surface: Surface
    found: Survey
    occluded: bool
    channels: int
    light_channels: int

    def at(self, slot: Any) -> tuple[Any, Any, list[Any]]:
        """One row: view direction, w = |cos theta|, and both right-hand sides.

        Outgoing radiance B is indexed by the direction to the camera; so is incoming radiance
        L, which is looked up where the mirror sends that direction.

        Args:
            slot: UInt32, which view: ``found.order[slot]``.
        """
        seen = self.found.look(self.views, self.surface, slot)
        asked = self.found.asked(seen.seen)
        lit = asked
        if self.occluded:
            lit = mirror_free(self.views.scene, self.surface, seen, asked)

        def mirrored(direction: Any, normal: Any) -> Any:
            return self.lighting.radiance(2 * dr.dot(normal, direction) * normal - direction)

        incoming = dr.if_stmt(
            args=(seen.direction, mi.Vector3f(self.surface.normal)),
            cond=lit,
            true_fn=mirrored,
            false_fn=lambda *_: dr.zeros(mi.Color3f),
        )
        both = (seen.radiance, self.channels), (incoming, self.light_channels)
        values = [value for color, channels in both for value in as_channels(color, channels)]
        return seen.direction, seen.cosine, values


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
    seen = found.coverage.numpy()
    shape = (texels.count, switches.degree + 1, colors)
    outgoing, incoming = dr.zeros(mi.TensorXf, shape), dr.zeros(mi.TensorXf, shape)
    dr.eval(outgoing, incoming)
    # Made now: a texture that is made while a loop is recorded does not outlive the recording.
    dr.eval(lighting.filtered.tensor())
    for group in solver_groups(seen if skip_unseen else np.maximum(seen, 1), switches.degree):
        surface = Surface.of(texels, group.selection)
        samples = Samples(views, lighting, surface, found, switches.occluded, colors, light)
        coefficients = fit_lanes(
            samples.at,
            found.count,
            degree=switches.degree,
            channels=colors + light,
            regularizer=switches.regularizer,
            penalize_constant=switches.penalize_constant,
            method=group.method,
            capacity=group.capacity,
        )
        power = power_lanes(coefficients)
        copies = colors // light
        scatter_rows(outgoing.array, [row[:colors] for row in power], group.selection)
        scatter_rows(incoming.array, [row[colors:] * copies for row in power], group.selection)
        dr.eval(outgoing, incoming)
    return Spectra(incoming=incoming, outgoing=outgoing)
