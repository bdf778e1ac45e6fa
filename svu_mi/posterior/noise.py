"""The noise of a texel's samples, from the photographs themselves.

A sample is b = r(psi) + e, with Var e = s^2 / w: the weights w of the sums say how noise grows
with radiance, s says how much of it a texel has. That is what its best parameters leave,

    s^2 = (nu s_0^2 + Q_min) / (nu + max(N - 5, 1)),    Q = sum w e^2 over N samples,

for a prior of nu samples of the variance s_0^2 that the median texel has (Student's t with nu
degrees of freedom, were there no data): light tails where the model fits, heavy ones where it
does not, as on seams and in detail below a pixel. From few samples nobody can tell: whatever they
show has parameters that explain it. Where no texel has 2 x 5 of them (three photographs in colour,
nine in grey), s_0 is assumed.

Errors of neighbouring views are not independent: light cells, pixel footprints and normals are
the same in both. N samples say what N / tau independent ones would. The overdispersion tau is a
constant, chosen on the scenes that come with svu_mi (BENCHMARKS.md).
"""

from __future__ import annotations

import numpy as np

SMALLEST = 1e-3  # noise, in the unit: no photograph, and no model of it, is better than that
FITTED = 5  # roughness, metallic and three channels of base colour, which every texel has used up


def noise_variance(
    least: np.ndarray, samples: np.ndarray, degrees: float, assumed: float
) -> np.ndarray:
    """Return s^2 of every texel, in the square of a unit of radiance.

    Args:
        least: (S,) Q_min, weighted sum of squared errors of the best parameters.
        samples: (S,) N, number of views and channels; 0 of a texel that no view sees.
        degrees: nu.
        assumed: s_0, if no texel has samples enough to tell.

    Returns:
        (S,) float64, not below the square of ``SMALLEST``.
    """
    own = np.maximum(samples - FITTED, 1)
    telling = samples >= 2 * FITTED
    usual = float(np.median(least[telling] / own[telling])) if telling.any() else assumed**2
    usual = max(usual, SMALLEST**2)
    return np.maximum((degrees * usual + least) / (degrees + own), SMALLEST**2)
