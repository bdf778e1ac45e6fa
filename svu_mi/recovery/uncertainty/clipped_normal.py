"""Normal distributions clipped to [0, 1]: values beyond an end stand at that end."""

from __future__ import annotations

import numpy as np
import scipy

SMALLEST_WIDTH = 1e-9  # width below which a distribution is one value
WIDEST = 2.0  # of x: most of it is beyond the ends
FAR = 3.0  # standard deviations from an end: clipping takes at most 2.5e-3 of one there
STEPS = 4  # of Newton's method: to 2e-5 on average, to 1e-3 where sd is close to the most there is
CHUNK = 2**18  # values that are worked on at a time
ROOT = np.sqrt(2 * np.pi)


def moments(place: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of min(max(x, 0), 1), where x is normal."""
    mean, sd = np.empty(place.size), np.zeros(place.size)
    places, widths = place.ravel(), width.ravel()
    for part in _chunks(place.size):
        mean[part], variance, _ = _moments(places[part], np.maximum(widths[part], SMALLEST_WIDTH))
        np.sqrt(np.maximum(variance, 0), out=sd[part], where=widths[part] > SMALLEST_WIDTH)
    return mean.reshape(place.shape), sd.reshape(place.shape)


def width_of(place: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return the standard deviation of x of which that of min(max(x, 0), 1) is ``sd``, by Newton's
    method; at most ``WIDEST``, for standard deviations of more than .46."""
    width, places = np.array(sd, np.float64).ravel(), place.ravel()
    for part in _chunks(place.size):
        mean, wanted = places[part], width[part]
        near = (np.minimum(mean, 1 - mean) < FAR * wanted) & (wanted > SMALLEST_WIDTH)
        wanted[near] = _newton(mean[near], wanted[near])
    return width.reshape(place.shape)


def _newton(mean: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    width = wanted.copy()
    for _ in range(STEPS):
        # The standard deviation is a concave function of the width and never above it: steps from
        # below stay below.
        _, variance, slope = _moments(mean, width)
        now = np.sqrt(np.maximum(variance, SMALLEST_WIDTH**2))
        step = (wanted - now) * 2 * now / np.maximum(slope, SMALLEST_WIDTH)
        width = np.clip(width + step, width, WIDEST)
    return width


def _chunks(count: int) -> list[slice]:
    """Return parts of so many values: what is in between takes little memory."""
    return [slice(first, first + CHUNK) for first in range(0, count, CHUNK)]


def _moments(place: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and variance, and the derivative of that by the standard deviation s of x."""
    low, high = -place / s, (1 - place) / s
    below, above = scipy.special.ndtr(low), scipy.special.ndtr(-high)
    inside = np.clip(1 - below - above, 0, 1)
    first, last = (np.exp(-0.5 * z * z) / ROOT for z in (low, high))
    shift = first - last  # d mean / d s
    mean = inside * place + s * shift + above
    # About the mean of x, where nothing cancels but what lies at the ends.
    spread = s * (inside + low * first - high * last)
    square = s * spread + 2 * place * (mean - above) + above - place**2 * inside
    return mean, square - mean**2, 2 * (place * shift + spread) - 2 * mean * shift


def interval(place: np.ndarray, width: np.ndarray, mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the central interval of this probability mass."""
    half = scipy.special.ndtri((1 + mass) / 2) * width
    return np.clip(place - half, 0, 1), np.clip(place + half, 0, 1)
