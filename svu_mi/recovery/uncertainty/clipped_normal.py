"""Clipped normal distributions: min(max(x, 0), 1) of normal x."""

import numpy as np
import scipy

SMALLEST_WIDTH = 1e-9  # standard deviation of x below which the distribution is constant
WIDEST = 2.0  # upper limit of the standard deviation of x; most of its mass is clipped there
FAR = 3.0  # distance to 0 and 1 in standard deviations, beyond which clipping is ignored (2.5e-3)
STEPS = 4  # Newton steps; error 2e-5 on average, 1e-3 near the largest possible sd
CHUNK = 2**18  # values per chunk, to limit temporary memory
ROOT = np.sqrt(2 * np.pi)


def moments(place: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and sd of clipped x, for x with mean ``place`` and sd ``width``."""
    mean, sd = np.empty(place.size), np.zeros(place.size)
    places, widths = place.ravel(), width.ravel()
    for part in _chunks(place.size):
        mean[part], variance, _ = _moments(places[part], np.maximum(widths[part], SMALLEST_WIDTH))
        np.sqrt(np.maximum(variance, 0), out=sd[part], where=widths[part] > SMALLEST_WIDTH)
    return mean.reshape(place.shape), sd.reshape(place.shape)


def width_of(place: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return the sd of x (at most ``WIDEST``) for which clipped x has ``sd``."""
    width, places = np.array(sd, np.float64).ravel(), place.ravel()
    for part in _chunks(place.size):
        mean, wanted = places[part], width[part]
        near = (np.minimum(mean, 1 - mean) < FAR * wanted) & (wanted > SMALLEST_WIDTH)
        wanted[near] = _newton(mean[near], wanted[near])
    return width.reshape(place.shape)


def _newton(mean: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    width = wanted.copy()
    for _ in range(STEPS):
        # The clipped standard deviation is a concave function of the width and never exceeds it,
        # so steps from below never overshoot.
        _, variance, slope = _moments(mean, width)
        now = np.sqrt(np.maximum(variance, SMALLEST_WIDTH**2))
        step = (wanted - now) * 2 * now / np.maximum(slope, SMALLEST_WIDTH)
        width = np.clip(width + step, width, WIDEST)
    return width


def _chunks(count: int) -> list[slice]:
    """Return slices of at most CHUNK values."""
    return [slice(first, first + CHUNK) for first in range(0, count, CHUNK)]


def _moments(place: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and variance of clipped x, and the derivative of the variance in s."""
    low, high = -place / s, (1 - place) / s
    below, above = scipy.special.ndtr(low), scipy.special.ndtr(-high)
    inside = np.clip(1 - below - above, 0, 1)
    first, last = (np.exp(-0.5 * z * z) / ROOT for z in (low, high))
    shift = first - last  # d mean / d s
    mean = inside * place + s * shift + above
    # Second moment about ``place``, to avoid cancellation inside (0, 1).
    spread = s * (inside + low * first - high * last)
    square = s * spread + 2 * place * (mean - above) + above - place**2 * inside
    return mean, square - mean**2, 2 * (place * shift + spread) - 2 * mean * shift


def interval(place: np.ndarray, width: np.ndarray, mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of the central interval with a probability mass."""
    half = scipy.special.ndtri((1 + mass) / 2) * width
    return np.clip(place - half, 0, 1), np.clip(place + half, 0, 1)
