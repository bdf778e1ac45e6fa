"""The noise of a texel's samples, from the photographs themselves.

A sample is b = r(psi) + e, with Var e = s^2 / w: the weights w of the sums say how noise grows
with radiance, s says how much of it a texel has. That is what its best parameters leave,

    s^2 = (nu s_0^2 + t Q_min) / (nu + t max(N - 5, 1)),    Q = sum w e^2 over N samples,

for a prior of nu samples of the variance s_0^2 that the median texel has (Student's t with nu
degrees of freedom, were there no data): light tails where the model fits, heavy ones where it
does not, as on seams and in detail below a pixel.

That a few views agree tells nothing: whatever they show has parameters that explain it, and R, G
and B of one photograph are wrong together. So t grows from 0 at 5 views to 1 at 8, and s_0 from
what is assumed, by its logarithm, to the median of texels with 2 x 5 samples, reached when the mean
of t over all seen texels is 1/2: no photograph lowers it at once. That views contradict each other
by more than s_0 tells, however few they are: then t = 1, as it is for s_0, if the median does.

Errors of neighbouring views are not independent: light cells, pixel footprints and normals are
the same in both. N samples say what N / tau independent ones would. The overdispersion tau, the
views that it takes, and the assumed s_0 are constants, chosen on the scenes that come with svu_mi
(BENCHMARKS.md).
"""

from __future__ import annotations

import numpy as np

from svu_mi.parameters import CHANNELS

SMALLEST = 1e-3  # noise, in the unit: no photograph, and no model of it, is better than that
FITTED = sum(CHANNELS.values())  # 5 parameters, which every texel has used up
FULL = 8  # views from which on a texel tells all that it can


def noise_variance(
    least: np.ndarray, views: np.ndarray, channels: int, degrees: float, assumed: float,
    rounding: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return s^2 of every texel, in the square of a unit of radiance.

    Args:
        least: (S,) Q_min, weighted sum of squared errors of the best parameters.
        views: (S,) how many see the texel; 0 where none does.
        channels: samples that each view gives.
        degrees: nu.
        assumed: s_0, where too few views tell.
        rounding: (S,) variance by rounding alone (``gather.rounding_sums``), which photographs that
            round alike do not show; None of floats.

    Returns:
        (S,) float64, not below ``rounding`` and the square of ``SMALLEST``.
    """
    samples, seen = views * channels, views > 0
    own = np.maximum(samples - FITTED, 1)
    tells = np.clip((views - FITTED) / (FULL - FITTED), 0, 1)
    usual = assumed**2
    if (enough := samples >= 2 * FITTED).any():
        median = max(float(np.median((least / own)[enough])), SMALLEST**2)
        usual *= (median / usual) ** (1 if median > usual else min(2 * tells[seen].mean(), 1))
    tells = np.where(least / own > usual, 1, tells)
    found = (degrees * usual + tells * least) / (degrees + tells * own)
    return np.maximum(found, SMALLEST**2 if rounding is None else np.maximum(rounding, SMALLEST**2))
