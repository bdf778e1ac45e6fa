"""What light is like before any photograph: the logarithm of its radiance is a Gaussian field.

Positive, of unknown level, and smooth at two scales [log-Gaussian Cox fields, Moller et al. 1998]:

    log L_c(w) = u(w) + v_c(w),    cov u(w) u(w') = l^2 + b^2 k(angle / 40 deg)
                                                    + n^2 k(angle / 12 deg) + o^2 [w = w'],

the same for the colours v, which are weaker, with k(t) = exp(-t^2 / 2). The amplitudes are those of
the lights that come with svu_mi.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from svu_mi.light.cells import fibonacci

BROAD, NARROW = np.radians(40), np.radians(12)


class Amplitudes(NamedTuple):
    """Standard deviations: of the level, the broad, the narrow and the cell's own part."""

    level: float
    broad: float
    narrow: float
    own: float


BRIGHTNESS = Amplitudes(level=3.0, broad=0.9, narrow=0.8, own=0.35)
SD = float(np.linalg.norm(BRIGHTNESS[1:]))  # of a cell at a given level, the channels' mean
COLOR = Amplitudes(level=0.5, broad=0.25, narrow=0.15, own=0.05)


@dataclass(frozen=True)
class Prior:
    """Of the logarithms x (N, 3) of the radiance of N even cells.

    Attributes:
        brightness: (N, N) float64, precision of the channels' mean.
        color: (N, N) float64, precision of what a channel differs by from it.
    """

    brightness: np.ndarray
    color: np.ndarray

    def pull(self, x: np.ndarray) -> np.ndarray:
        """Return the gradient of the energy at x, (N, 3)."""
        u = x.mean(axis=1, keepdims=True)
        return self.brightness @ u / 3 + self.color @ (x - u)

    def precision(self) -> np.ndarray:
        """Return the whole precision, (3 N, 3 N) float64, channel by channel."""
        between = np.full((3, 3), 1 / 3)
        return np.kron(between / 3, self.brightness) + np.kron(np.eye(3) - between, self.color)


@lru_cache(maxsize=2)
def prior_of(number: int) -> Prior:
    """Return the prior of N even cells."""
    cells = fibonacci(number)
    brightness, color = (
        np.linalg.inv(_covariance(cells, cells, a)) for a in (BRIGHTNESS, COLOR)
    )
    return Prior(brightness, color)


def refined(x: np.ndarray, number: int) -> np.ndarray:
    """Return what is to be expected of other cells: (number, 3), given x (N, 3)."""
    old, new = fibonacci(len(x)), fibonacci(number)
    u = x.mean(axis=1, keepdims=True)
    parts = zip((u, x - u), (BRIGHTNESS, COLOR), strict=True)
    return sum(
        values.mean(axis=0)
        + _covariance(new, old, a, own=False)
        @ np.linalg.solve(_covariance(old, old, a), values - values.mean(axis=0))
        for values, a in parts
    )


def _covariance(a: np.ndarray, b: np.ndarray, of: Amplitudes, own: bool = True) -> np.ndarray:
    angle = np.arccos(np.clip(a @ b.T, -1, 1))
    covariance = of.level**2 + of.broad**2 * np.exp(-0.5 * (angle / BROAD) ** 2)
    covariance += of.narrow**2 * np.exp(-0.5 * (angle / NARROW) ** 2)
    return covariance + of.own**2 * np.eye(len(a)) if own else covariance
