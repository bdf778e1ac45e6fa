"""Plane on which the object stands, if the scene lacks one and the photographs show it.

If an object may stand on something, a sample of its texels is fitted with the light of the scene,
and with grey planes instead of the light from below. A plane's gain is the mean fall of log s, with
the noise s of the samples. The darkest plane with nearly the largest gain is kept, because the
object's shadow, which is not modelled, darkens it (limits: notebooks/design/calibration.md).
"""

from dataclasses import replace

import numpy as np

from svu_mi.core.arrays import evenly_spaced
from svu_mi.posterior.calibrated_fit import noise_of_parts
from svu_mi.posterior.estimators import EstimatorInputs, gather_sums, posterior_inputs, view_counts
from svu_mi.posterior.folds import ENOUGH
from svu_mi.posterior.kept_results import pack_share, restore_share
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.support_error import may_stand
from svu_mi.presets import AngularPreset, AnyPreset

ALBEDOS = (0.15, 0.3, 0.5, 0.7)
SAMPLE = 400  # number of texels
LEAST, NEARLY = 0.02, 0.9  # gain of a plane that is kept; relative to the largest


def with_plane(inputs: EstimatorInputs, switches: AnyPreset) -> EstimatorInputs:
    """Return inputs with the plane that explains the photographs, if there is one."""
    observed = inputs.observed
    if not (isinstance(switches, AngularPreset) and switches.folds and observed.plane is None):
        return inputs
    enough = switches.noise == "estimated" and sum(observed.capture.used) >= ENOUGH
    if not enough or not may_stand(observed.capture):
        return inputs
    with inputs.progress.stage("Testing light from below"):
        albedo = observed.cache.recall(
            "plane", posterior_inputs(inputs, switches), lambda: best_albedo(inputs, switches),
            pack_share, restore_share,
        )  # fmt: skip
    return replace(inputs, observed=observed.on_plane(albedo)) if albedo else inputs


def best_albedo(inputs: EstimatorInputs, switches: AngularPreset) -> float:
    """Return the albedo of the plane on which the object stands; 0 without one."""
    seen = np.flatnonzero(view_counts(inputs.observed, switches))
    part = inputs.observed.subset(seen[evenly_spaced(len(seen), SAMPLE)])

    def noise(observed: Observed) -> float:
        sums = gather_sums(inputs, observed, switches)
        of_texels = noise_of_parts(sums, inputs.grid, observed.unit, switches, 1)
        return float(np.log(of_texels).mean())

    alone = noise(part)
    gains = np.array([alone - noise(part.on_plane(albedo)) for albedo in ALBEDOS])
    found = int(np.argmax(gains >= NEARLY * gains.max()))
    return ALBEDOS[found] if gains[found] > LEAST else 0.0
