"""Noise of a texel's samples, estimated from the photographs.

A sample is b = r(psi) + e with Var e = s^2 / w. The weights w model how noise grows with radiance;
s is the texel's noise level, from the residual of its best parameters,

    s^2 = (nu s_0^2 + t Q_min) / (nu + t max(N - 5, 1)),    Q = sum w e^2 over N samples,

with a prior of nu samples of the median texel's variance s_0^2 (Student's t, nu degrees).

A few views fit any parameters, so t grows from 0 at 5 views to 1 at 8, and log s_0 moves from the
assumed value to the median of texels with 2 x 5 samples, reached when the mean of t is 1/2.
Exception: if the residual exceeds s_0, t = 1 for any N (for s_0: if the median residual does).

Errors of neighbouring views are correlated: N samples count as N / tau (overdispersion tau). The
constants were chosen on the scenes that come with svu_mi (BENCHMARKS.md).
"""

from __future__ import annotations

import numpy as np

from svu_mi.parameters import CHANNELS

SMALLEST = 1e-3  # least noise, in the unit
FITTED = sum(CHANNELS.values())  # 5 parameters, which every texel has used up
FULL = 8  # views from which a texel's own residual counts fully


def noise_variance(
    residual: np.ndarray, views: np.ndarray, channels: int, degrees: float, assumed: float,
    rounding: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return s^2 of every texel, (S,) float64, in squared radiance, at least ``rounding``.

    ``residual`` is (S,) Q_min, ``degrees`` nu, ``assumed`` s_0, ``rounding`` the (S,) variance by
    rounding (``gather_statistics.rounding_sums``); None for floating point photographs.
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
