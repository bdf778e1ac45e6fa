"""What SH recovery descends on: how far every texel is from what its views say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.recovery.sh.energy import energy
from svu_mi.recovery.sh.gradient import carry, look_up
from svu_mi.statistics import Factors
from svu_mi.statistics.gather import Values


@dataclass(frozen=True)
class StatisticsLoss:
    """How unlikely textures are, in nats, the mean over seen texels.

    Errors of a texel's views are neither all the same nor all different; its nats count in
    proportion to the number of views, one for as many as the mean texel has. The cost does not
    depend on that number. Unseen texels have no gradient.

    Attributes:
        factors: of S seen texels.
        place: (S,) UInt32, where in a texture each of them is.
        variance: (S,) Float, squared radiance, of each texel's error: that of ``Start``,
            times the mean number of views, over the texel's own.
    """

    factors: Factors
    place: Any
    variance: Any

    def __call__(self, textures: Mapping[str, Any], step: int = 0) -> Any:
        """Return 1/S sum_p d_p / (2 variance_p), a Float of one value.

        Args:
            textures: (H, W, C) tensors by name.
            step: not used: the loss is the same in every step.
        """
        del step
        values = look_up(textures, self.place)
        with dr.suspend_grad():
            error, slopes = energy(self.factors, Values(*(dr.detach(v) for v in values)))
            weight = dr.rcp(2 * self.variance)
            error, slopes = weight * error, [weight * slope for slope in slopes]
            dr.eval(error, slopes)  # once: they are needed for the value and for the gradient
        return carry(error, slopes, values, dr.opaque(mi.Float, 1 / self.factors.count))
