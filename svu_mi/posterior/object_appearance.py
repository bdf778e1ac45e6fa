"""Appearance of the object, estimated from photographs, for the light that it reflects itself."""

from typing import TYPE_CHECKING

import numpy as np

from svu_mi.capture.scene import lamps_of
from svu_mi.capture.surroundings import Appearance, mean_reflectance
from svu_mi.core.arrays import evenly_spaced
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.geometry.texels import filled_image
from svu_mi.light.lamps import trace_lamps
from svu_mi.light.light_visibility import trace_light_visibility
from svu_mi.presets import AngularPreset

if TYPE_CHECKING:
    from svu_mi.posterior.observations import Observed

REFLECTING = 1024  # number of texels from which the reflectance of unseen ones is estimated


def object_appearance(observed: "Observed", switches: AngularPreset) -> Appearance:
    """Return mean radiance of seen texels; unseen ones get the object's mean reflectance."""
    every = observed.lanes(np.arange(observed.texels.count))
    radiance = observed.visibility.mean_color(observed.views, every)
    seen = np.flatnonzero(observed.coverage)
    some = seen[evenly_spaced(len(seen), REFLECTING)]
    irradiance = _direct_irradiance(observed, observed.lanes(some), switches)
    return Appearance(
        filled_image(observed.texels, radiance), mean_reflectance(radiance[some], irradiance)
    )


def _direct_irradiance(
    observed: "Observed", surface: TexelLanes, switches: AngularPreset
) -> np.ndarray:
    """Return the irradiance of environment and lamps, (S, 3)."""
    scene, occluded = observed.views.scene, switches.occluded
    tree, lamps = observed.light_tree(switches.cells), lamps_of(observed.capture.scene)
    cells = trace_light_visibility(scene, surface, tree, occluded=occluded)
    moments = cells.diffuse(surface, observed.distant_light, 3)
    total = np.stack([of_channel[0].numpy() for of_channel in moments], axis=-1)
    if lamps:
        near = trace_lamps(scene, lamps, surface, occluded=occluded).moments
        total += np.stack([of_channel[0].numpy() for of_channel in near], axis=-1)
    return total
