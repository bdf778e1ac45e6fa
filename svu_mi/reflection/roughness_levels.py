"""Roughness levels of the statistics, and interpolation between them.

Levels are closer together where lobes are narrow: level k of R has the roughness
(k / (R - 1))^``POWER``. Interpolation is uniform in k.
"""

from typing import Any

import drjit as dr
import numpy as np

POWER = 4 / 3
SMOOTHEST = 1e-3  # roughness below which the derivative of the place is constant
SPLINE_LEVELS = 4  # number of levels that a spline interpolates


def roughness_levels(count: int) -> np.ndarray:
    """Return the roughness of levels, (R,) float64 from 0 to 1."""
    return np.linspace(0, 1, count) ** POWER


def level_place(roughness: Any, last: Any) -> Any:
    """Return where roughness in [0, 1] is among levels, in [0, ``last``]."""
    return last * roughness ** (1 / POWER)


def level_slope(roughness: Any, last: Any) -> Any:
    """Return the derivative of ``level_place``, which is infinite at 0 and limited here."""
    return last / POWER * dr.maximum(roughness, SMOOTHEST) ** (1 / POWER - 1)


def linear_weights(roughness: Any, levels: int) -> list[Any]:
    """Return weights of linear interpolation between roughness levels: Floats."""
    place = level_place(roughness, levels - 1)
    return [dr.maximum(1 - dr.abs(place - k), 0) for k in range(levels)]


def catmull_rom(t: Any) -> list[Any]:
    """Return Catmull-Rom weights of four values; t in [0, 1] is between second and third."""
    return [
        0.5 * t * (-1 + t * (2 - t)),
        0.5 * (2 + t * t * (-5 + 3 * t)),
        0.5 * t * (1 + t * (4 - 3 * t)),
        0.5 * t * t * (t - 1),
    ]


def continued(weights: list[Any], begin: Any, last: Any) -> list[Any]:
    """Return weights of levels from ``begin`` - 1 that continue as a parabola behind ``last``."""
    before, first, second, after = weights
    beyond = after * ((begin == last - 1) & (begin > 0))  # of a - 3 b + 3 c, not of c again
    return [before + beyond, first - 3 * beyond, second + 3 * beyond, after - beyond]


def spline_weights(roughness: np.ndarray, levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return level indices and weights of Catmull-Rom interpolation, (N, 4) int64 and float64."""
    last = levels - 1
    place = level_place(np.clip(roughness, 0, 1), last)
    begin = np.minimum(np.floor(place), last - 1)
    weights = continued(catmull_rom(place - begin), begin, last)
    near = np.clip(begin[:, None] + np.arange(-1, 3), 0, last).astype(int)
    return near, np.stack(weights, axis=1)


def level_shares(roughness: np.ndarray, levels: int) -> np.ndarray:
    """Return the spline weight of each of R levels at (n,) values, (n, R) float64."""
    near, weights = spline_weights(roughness.astype(np.float64), levels)
    shares = np.zeros((len(roughness), levels))
    np.add.at(shares, (np.arange(len(roughness))[:, None], near), weights)
    return shares
