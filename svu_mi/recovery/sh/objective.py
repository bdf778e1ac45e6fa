"""What SH recovery descends on: what the photographs of every texel say, and where that points.

Both are of the calibrated posterior (``posterior/calibrated.py``), with its noise per texel, and
cost the same for any number of photographs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.posterior import CalibratedPosterior
from svu_mi.recovery.sh.energy import energy
from svu_mi.recovery.sh.gradient import carry, look_up
from svu_mi.statistics import Factors
from svu_mi.statistics.gather import Values
from svu_mi.surface import Texels

SURE = 1e-2  # standard deviation below which a texel pulls no more: nothing is known better


@dataclass(frozen=True)
class Likelihood:
    """-log p(B | psi), in nats, the mean over the texels that photographs show.

    Attributes:
        factors: of S texels.
        place: (S,) UInt32, where in a texture each of them is.
        weight: (S,) Float, nats per mean squared error of a channel, in squared radiance.
    """

    factors: Factors
    place: Any
    weight: Any

    @staticmethod
    def of(posterior: CalibratedPosterior, texels: Texels) -> Likelihood:
        """Take the statistics and the noise of a posterior in colour."""
        problem = posterior.problem
        weight = 0.5 * problem.factors.channels * problem.copies * dr.square(problem.scale)
        place = dr.gather(mi.UInt32, texels.index, problem.factors.texel)
        dr.eval(weight, place)
        return Likelihood(problem.factors, place, weight)

    def __call__(self, textures: Mapping[str, Any], step: int = 0) -> Any:
        """Return the loss, a Float of one value.

        Args:
            textures: (H, W, C) tensors by name.
            step: not used: the loss is the same in every step.
        """
        del step
        values = look_up(textures, self.place)
        with dr.suspend_grad():
            error, slopes = energy(self.factors, Values(*(dr.detach(v) for v in values)))
            error, slopes = self.weight * error, [self.weight * slope for slope in slopes]
            dr.eval(error, slopes)  # once: they are needed for the value and for the gradient
        return carry(error, slopes, values, dr.opaque(mi.Float, 1 / self.factors.count))


@dataclass(frozen=True)
class Pull:
    """Weighted squared distance of texels to what they probably are, the mean over texels.

    Attributes:
        place: (S,) UInt32, where in a texture each texel is.
        target: five (S,) Floats.
        weight: five (S,) Floats.
    """

    place: Any
    target: Values
    weight: Values

    @staticmethod
    def of(posterior: CalibratedPosterior, texels: Texels) -> Pull:
        """-log of a normal distribution with each parameter's posterior mean and variance.

        A mean hedges where a likelihood has several valleys, and its neighbours decide.
        """
        means, sds = moments(posterior)
        return Pull._to(posterior, texels, means, 0.5 / (sds**2 + SURE**2))

    @staticmethod
    def by_trust(posterior: CalibratedPosterior, texels: Texels) -> Pull:
        """Squared distances to posterior means, the less the photographs have told, the less they
        count: by 1 - variance / the prior's."""
        means, sds = moments(posterior)
        usual = np.concatenate([
            np.broadcast_to(posterior.prior_moments(name)[1], CHANNELS[name]) for name in NAMES
        ])  # fmt: skip
        trust = 1 - (sds / np.maximum(usual, SURE)[:, None]) ** 2
        return Pull._to(posterior, texels, means, np.clip(trust, 0, 1))

    @staticmethod
    def _to(
        posterior: CalibratedPosterior, texels: Texels, means: np.ndarray, weight: np.ndarray
    ) -> Pull:
        seen = posterior.problem.factors.texel
        place = dr.gather(mi.UInt32, texels.index, seen)
        chosen = seen.numpy()
        return Pull(place, values_of(means[:, chosen]), values_of(weight[:, chosen]))

    def __call__(self, textures: Mapping[str, Any], step: int = 0) -> Any:
        """Return the loss, a Float of one value; arguments as for ``Likelihood``."""
        del step
        values = look_up(textures, self.place)
        with dr.suspend_grad():
            offsets = [dr.detach(v) - t for v, t in zip(values, self.target, strict=True)]
            pairs = list(zip(self.weight, offsets, strict=True))
            loss = sum(w * dr.square(offset) for w, offset in pairs)
            slopes = [2 * w * offset for w, offset in pairs]
            dr.eval(loss, slopes)
        return carry(loss, slopes, values, dr.opaque(mi.Float, 1 / dr.width(self.place)))


def moments(posterior: CalibratedPosterior) -> tuple[np.ndarray, np.ndarray]:
    """Return means and standard deviations of red, green, blue, roughness and metallic of all T
    texels: (5, T) float64 both."""
    found = [
        [np.array(getattr(posterior, what)(name), np.float64).reshape(posterior.count, -1).T
         for name in NAMES]
        for what in ("mean", "sd")
    ]  # fmt: skip
    means, sds = (np.concatenate(rows) for rows in found)
    return means, sds


def values_of(table: np.ndarray) -> Values:
    """Return parameters (5, S) as Floats."""
    return Values(*(owned(mi.Float, row.astype(np.float32)) for row in table))
