"""A normal distribution clipped to [0, 1]: what lies beyond an end stands at that end."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

LEAST = 1e-9  # width below which a distribution is one value
ROOT = np.sqrt(2 * np.pi)


def moments(place: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of min(max(x, 0), 1), where x is normal.

    Args:
        place: mean of x.
        width: standard deviation of x, at least 0.
    """
    s = np.maximum(width, LEAST)
    low, high = -place / s, (1 - place) / s
    below, above = ndtr(low), ndtr(-high)
    inside = np.clip(1 - below - above, 0, 1)
    first, last = (np.exp(-0.5 * z * z) / ROOT for z in (low, high))
    mean = inside * place + s * (first - last) + above
    # About the mean of x, where nothing cancels but what lies at the ends.
    square = s**2 * (inside + low * first - high * last) + 2 * place * (mean - above)
    square += above - place**2 * inside
    sd = np.sqrt(np.maximum(square - mean**2, 0))
    return mean, np.where(width > LEAST, sd, 0.0)


def interval(
    place: np.ndarray, width: np.ndarray, level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of what holds this much, in the middle."""
    half = ndtri((1 + level) / 2) * width
    return np.clip(place - half, 0, 1), np.clip(place + half, 0, 1)
