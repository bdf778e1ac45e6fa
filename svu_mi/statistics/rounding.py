"""What rounding does to the samples of texels: noise that agreeing photographs do not show.

Where radiance is a few steps of the integers that it is stored in, all photographs of a texel may
round alike. They then agree, and are wrong together: the noise that they leave unexplained
(``posterior.noise``) is too small. So it is never less than a sample's rounding.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.rounding import variance
from svu_mi.statistics.gather import Weighting
from svu_mi.statistics.sums import noise_weight
from svu_mi.visibility import Observation, Survey, Views
from svu_mi.visibility.observe import Surface


def rounding_sums(
    views: Views, found: Survey, surface: Surface, weighting: Weighting
) -> np.ndarray | None:
    """Return the variance of a sample of weight 1 by rounding alone, summed over samples.

    Args:
        views: the packed capture.
        found: which views see which texels, of all texels.
        surface: S texels.
        weighting: how much samples count.

    Returns:
        (S,) float64, squared radiance, of a mean channel; None where no photograph is of integers.
    """
    if views.rounding is None:
        return None
    first, slope = views.rounding
    knee, eta = dr.opaque(mi.Float, weighting.kappa), dr.opaque(mi.Float, weighting.edges)

    def consume(seen: Observation, slot: Any, total: Any) -> tuple[Any]:
        view = dr.gather(mi.UInt32, found.order, slot)
        steps = (dr.gather(mi.Color3f, of_views, view) for of_views in (first, slope))
        of_channels = [variance(*of) for of in zip(seen.radiance, *steps, strict=True)]
        weight = noise_weight(sum(seen.radiance) / 3, knee, seen.contrast, eta)
        added = weight * sum(of_channels) / len(of_channels)
        return (dr.fma(dr.select(seen.seen, mi.Float(1), 0), added, total),)

    (total,) = found.over_views(views, surface, consume, (dr.zeros(mi.Float, surface.count),))
    dr.eval(total)
    return np.array(total, np.float64)
