"""Noise of a texel's samples, estimated from the photographs.

A sample is b = r(psi) + e with Var e = s^2 / w. The weights w model the increase of noise with
radiance. The noise level s of a texel follows from the residual of its best parameters,

    s^2 = (nu s_0^2 + t Q_min) / (nu + t max(N - 5, 1)),    Q = sum w e^2 over N samples,

under a prior of nu samples with the median texel's variance s_0^2 (Student's t, nu degrees).

Five parameters fit the samples of five views exactly, so t rises from 0 at 5 views to 1 at 8.
Likewise, log s_0 is interpolated: it is the assumed value if the mean of t is 0, and the median of
texels with at least 10 samples if it is 1/2 or more. Exceptions: t is 1 if a texel's residual
exceeds s_0, and s_0 is the median if the median exceeds the assumed value.

Errors of neighbouring views are correlated: N samples count as N / tau (overdispersion tau). The
constants were chosen on the example scenes (notebooks/design/calibration.md).
"""

import numpy as np

from svu_mi.parameters import CHANNELS

SMALLEST = 4e-3  # minimum of s and s_0, relative to the radiance unit: errors of the model
FITTED = sum(CHANNELS.values())  # number of fitted values per texel, 5
FULL = 8  # number of views at which t = 1


def noise_variance(
    residual: np.ndarray, views: np.ndarray, channels: int, degrees: float, assumed: float,
    rounding: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the noise variance s^2 of each texel, (S,) float64, in squared radiance.

    ``residual`` is Q_min, (S,); ``degrees`` is nu; ``assumed`` is the initial s_0. ``rounding`` is
    the minimum of s^2, (S,) (``Observed.rounding``); None for floating point photographs.
    """
    samples, seen = views * channels, views > 0
    own = np.maximum(samples - FITTED, 1)
    trust = np.clip((views - FITTED) / (FULL - FITTED), 0, 1)
    usual = assumed**2
    if (enough := samples >= 2 * FITTED).any():
        median = max(float(np.median((residual / own)[enough])), SMALLEST**2)
        usual *= (median / usual) ** (1 if median > usual else min(2 * trust[seen].mean(), 1))
    trust = np.where(residual / own > usual, 1, trust)
    variance = (degrees * usual + trust * residual) / (degrees + trust * own)
    least = SMALLEST**2 if rounding is None else np.maximum(rounding, SMALLEST**2)
    return np.maximum(variance, least)
