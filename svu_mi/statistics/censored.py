"""Clipped samples: at least this bright.

Of a channel that is clipped at b we know that the photograph, r + noise, is no less. Where the
model stays below b, that is an error; where it is above, it says nothing. The logarithm of that
probability, log Phi(z) with z = (r - b) / sigma, is not quadratic, but statistics are. So it is
replaced, around a model r' that is known already, by the parabola with the same slope and
curvature there (a censored normal [Tobin 1958] by re-weighted least squares [Green 1984]),

    -log Phi(z) ~ h (r - t)^2 / (2 sigma^2),   t = r' + sigma / (lambda + z'),
    h = lambda (lambda + z'),                  lambda = phi(z') / Phi(z'):

a sample of radiance t that counts h; b and 1 where the model is far below, none where it is far
above. Roughness levels have sums of their own, so each has a parabola around its own best model:
that one of them explains a highlight does not excuse the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.parameters import MIXED
from svu_mi.reflection.principled import mixture
from svu_mi.statistics.factors import PAIRS
from svu_mi.statistics.sums import Statistics

CLIPPED_PART = 0.05  # of a texel's pixels in a view, from which it counts as clipped
PASSES = 2  # parabolas, each around what the one before leads to
NODES = 5  # of what mixes the columns, that the best of is taken
PARAMETERS = 3.0  # of a texel at one roughness, in samples of three channels
FEWEST_FREE = 1.0  # samples more than those, by which noise is divided at least
ENOUGH = 3.0  # samples more than those, from which a texel knows its own noise
LEAST_NOISE = 0.01  # part of kappa
BELOW, ABOVE = 3.0, 5.0  # standard deviations below b where lambda is its bound [Sampford 1953],
# and above b where nothing is left to say


@dataclass(frozen=True)
class Models:
    """The best model of every texel at every level of roughness.

    Attributes:
        values: (S * (R * (M + C) + 1),) Float: of each level what mixes the columns, and base
            colours; then the standard deviation of a sample that counts 1.
        channels: C.
    """

    values: Any
    channels: int

    def of_level(self, lane: Any, level: int, levels: int) -> tuple[list[Any], list[Any]]:
        """Return what mixes the columns, and base colours, of lanes at a level: Floats."""
        size = len(MIXED) + self.channels
        start = lane * (levels * size + 1) + level * size
        found = [dr.gather(mi.Float, self.values, start + k) for k in range(size)]
        return found[: len(MIXED)], found[len(MIXED) :]

    def noise(self, lane: Any, levels: int) -> Any:
        """Return the standard deviation of lanes."""
        stride = levels * (len(MIXED) + self.channels) + 1
        return dr.gather(mi.Float, self.values, lane * stride + (stride - 1))


def parabola(model: Any, least: Any, noise: Any) -> tuple[Any, Any]:
    """Return t and h of a clipped sample: radiance, and how much it counts.

    Args:
        model: r', Float.
        least: b.
        noise: sigma.
    """
    z = dr.clip((model - least) / noise, -1e4, ABOVE)
    near, x = dr.maximum(z, -BELOW), dr.maximum(-z, BELOW)
    normal = 0.5 * (1 + dr.erf(near * dr.sqrt(0.5)))
    ratio = dr.exp(-0.5 * near * near) * dr.rcp(dr.sqrt(2 * dr.pi) * normal)
    # Single precision cannot tell what is left of 1; the ratio's upper bound is as good there.
    far = 2 * dr.rcp(dr.sqrt(x * x + 8) + x)
    above = dr.select(z < -BELOW, far, ratio + near)
    return model + noise / above, dr.select(z < -BELOW, far + x, ratio) * above


def best_models(statistics: Statistics) -> Models:
    """Return the models with the least squared error at every level, of all texels."""
    levels, channels, count = statistics.levels, statistics.channels, statistics.count
    mean = statistics.table() / np.maximum(statistics.weight, 1e-300)  # (R, C, P, S)
    least = np.full((levels, count), np.inf)
    chosen = np.zeros((levels, len(MIXED) + channels, count))
    axes = np.meshgrid(*[np.linspace(0, 1, NODES)] * len(MIXED), indexing="ij")
    for mixed in np.stack([axis.ravel() for axis in axes], axis=1):
        color, error = _best_color(mean, mixed)
        better = error < least
        least = np.where(better, error, least)
        own = np.broadcast_to(mixed[:, None], (levels, len(mixed), count))
        chosen = np.where(better[:, None], np.concatenate([own, color], axis=1), chosen)
    flat = np.concatenate([chosen.reshape(-1, count), _noise(statistics, least)[None]])
    return Models(owned(mi.Float, flat.T.astype(np.float32).ravel()), channels)


def _best_color(mean: np.ndarray, mixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the base colours (R, C, S) of least error, and that (R, S), given what mixes the
    columns and the weighted means (R, C, P, S) of their products."""
    start = np.array(mixture(*mixed).at(0.0), np.float64)
    slope = np.array(mixture(*mixed).at(1.0), np.float64) - start

    def form(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        factors = [a[i] * b[j] + (a[j] * b[i] if i != j else 0) for i, j in PAIRS]
        return np.asarray(np.einsum("rcps,p->rcs", mean, np.array(factors)))

    square, cross = form(slope, slope), form(slope, start)
    # A channel that is clipped in all views is as bright as can be, before anything is known of it.
    color = np.where(square > 0, np.clip(-cross / np.maximum(square, 1e-300), 0, 1), 1)
    error = square * color**2 + 2 * cross * color + form(start, start)
    return color, error.sum(axis=1)


def _noise(statistics: Statistics, least: np.ndarray) -> np.ndarray:
    """Return the standard deviation (S,) of samples that count 1, given errors (R, S)."""
    views = np.asarray(statistics.views.numpy(), np.float64)
    error = np.maximum(least.min(axis=0), 0) / statistics.channels
    variance = error * statistics.weight / np.maximum(views - PARAMETERS, FEWEST_FREE)
    enough = views >= PARAMETERS + ENOUGH
    # Of texels that are clipped in nearly all views, nothing is known; they are like others.
    usual = float(np.median(variance[enough])) if enough.any() else 0.0
    variance = np.where(enough, variance, np.maximum(variance, usual))
    return np.maximum(np.sqrt(variance), LEAST_NOISE * statistics.kappa)
