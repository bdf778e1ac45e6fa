"""Saturated samples as lower bounds (censored normal distribution [Tobin 1958]).

A channel saturated at b has the likelihood Phi(z), z = (r - b) / sigma. Around a model r' it is
approximated by a parabola with equal slope and curvature (re-weighted least squares [Green 1984]),

    -log Phi(z) ~ h (r - t)^2 / (2 sigma^2),   t = r' + sigma / (lambda + z'),
    h = lambda (lambda + z'),                  lambda = phi(z') / Phi(z').

This is a sample of radiance t and weight h. If the model is far below b, t is about b and h about
1; if it is far above, h is 0. Each roughness level uses parabolas around its own best model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.geometry.bitset import Bits
from svu_mi.parameters import MIXED
from svu_mi.reflection.principled import mixture
from svu_mi.statistics.cholesky_factors import PAIRS
from svu_mi.statistics.statistics import Statistics
from svu_mi.statistics.texel_blocks import BlockReader

CLIPPED_PART = 0.05  # fraction of saturated pixels from which a sample counts as saturated
PASSES = 2  # number of passes of re-weighted least squares
NODES = 5  # number of nodes per mixing parameter in the search for the best model
PARAMETERS = 3.0  # degrees of freedom that the best model uses, in views
FEWEST_FREE = 1.0  # minimum of the remaining degrees of freedom
ENOUGH = 3.0  # remaining degrees of freedom from which a texel's own noise is used
LEAST_NOISE = 0.01  # minimum noise, relative to kappa
TIE = 1e-9  # relative difference below which errors count as equal
BELOW = 3.0  # standard deviations below b from which lambda is its upper bound [Sampford 1953]
ABOVE = 5.0  # standard deviations above b from which the weight is negligible


@dataclass(frozen=True)
class BestModels:
    """Best model of each texel at each roughness level.

    Attributes:
        values: (S * R * (M + C),) Float: mixing parameters and base colours of each level.
        sigma: (S,) Float, standard deviation of a sample of weight 1.
        samples: one bit per sample, set if it is saturated (``clipped_samples``); None: read all.
    """

    values: Any
    sigma: Any
    channels: int
    samples: Bits | None = None

    def parameters(self, lane: Any, level: int, levels: int) -> tuple[list[Any], list[Any]]:
        """Return mixing parameters and base colours of texels at a level: Floats."""
        start = (lane * levels + level) * (len(MIXED) + self.channels)
        values = [
            dr.gather(mi.Float, self.values, start + k) for k in range(len(MIXED) + self.channels)
        ]
        return values[: len(MIXED)], values[len(MIXED) :]

    def noise(self, lane: Any) -> Any:
        """Return each texel's standard deviation of a sample of weight 1."""
        return dr.gather(mi.Float, self.sigma, lane)


def parabola(model: Any, bound: Any, noise: Any) -> tuple[Any, Any]:
    """Return radiance t and weight h of a sample saturated at ``bound``."""
    z = dr.clip((model - bound) / noise, -1e4, ABOVE)
    near, x = dr.maximum(z, -BELOW), dr.maximum(-z, BELOW)
    normal = 0.5 * (1 + dr.erf(near * dr.sqrt(0.5)))
    ratio = dr.exp(-0.5 * near * near) * dr.rcp(dr.sqrt(2 * dr.pi) * normal)
    # ratio + near cancels in single precision; the upper bound of the ratio is accurate enough.
    far = 2 * dr.rcp(dr.sqrt(x * x + 8) + x)
    above = dr.select(z < -BELOW, far, ratio + near)
    return model + noise / above, dr.select(z < -BELOW, far + x, ratio) * above


def find_best_models(statistics: Statistics) -> BestModels:
    """Return the model with the least squared error for each texel and roughness level."""
    levels, channels, count = statistics.levels, statistics.channels, statistics.count
    size = len(MIXED) + channels
    reader, lane = BlockReader(statistics.sums, statistics.rows, count), dr.arange(mi.UInt32, count)
    weight = reader.read(dr.opaque(mi.UInt32, statistics.rows - 1))
    scale = dr.select(weight > 0, dr.rcp(dr.select(weight > 0, weight, 1)), 0)
    values = dr.zeros(mi.Float, count * levels * size)
    axes = np.meshgrid(*[np.linspace(0, 1, NODES)] * len(MIXED), indexing="ij")
    nodes = np.stack([axis.ravel() for axis in axes], axis=1)
    dr.eval(values, scale)

    def search(level: Any, least: Any) -> tuple[Any, Any]:
        first = level * (channels * len(PAIRS))
        mean = [[scale * reader.read(first + c * len(PAIRS) + p) for p in range(len(PAIRS))]
                for c in range(channels)]  # fmt: skip
        error, best = mi.Float64(dr.inf), [mi.Float64(0)] * size
        for mixed in nodes:
            colors, here = _best_color(mean, mixed)
            better = here < error * (1 - TIE)
            error = dr.select(better, here, error)
            best = [dr.select(better, new, old)
                    for new, old in zip([*mixed, *colors], best, strict=True)]  # fmt: skip
        place = (lane * levels + level) * size
        for k, value in enumerate(best):
            dr.scatter(values, mi.Float(value), place + k, mode=dr.ReduceMode.NoConflicts)
        return level + 1, dr.minimum(least, error)

    end = dr.opaque(mi.UInt32, levels)
    (least,) = fold(0, end, search, dr.full(mi.Float64, dr.inf, count))
    dr.eval(least, values)
    sigma = _noise(statistics, least.numpy(), weight.numpy())
    return BestModels(values, to_drjit(mi.Float, sigma.astype(np.float32)), channels)


def _best_color(mean: list[list[Any]], mixed: np.ndarray) -> tuple[list[Any], Any]:
    """Return the base colours of least squared error, and the error summed over channels."""
    start = mixture(*mixed).at(0.0)
    slope = [float(b - a) for a, b in zip(start, mixture(*mixed).at(1.0), strict=True)]
    colors, error = [], mi.Float64(0)
    for of_channel in mean:
        square = _quadratic_form(of_channel, slope, slope)
        cross = _quadratic_form(of_channel, slope, start)
        # A channel without unsaturated samples starts at the brightest colour.
        inside = dr.clip(-cross / dr.select(square > 0, square, 1), 0, 1)
        color = dr.select(square > 0, inside, 1)
        colors.append(color)
        constant = _quadratic_form(of_channel, start, start)
        error += square * color * color + 2 * cross * color + constant
    return colors, error


def _quadratic_form(mean: list[Any], a: Sequence[float], b: Sequence[float]) -> Any:
    """Return the weighted mean of the products (a . columns) (b . columns) over samples."""
    total = mi.Float64(0)
    for (i, j), value in zip(PAIRS, mean, strict=True):
        factor = float(a[i] * b[j] + (a[j] * b[i] if i != j else 0))
        if factor:
            total = dr.fma(value, factor, total)
    return total


def _noise(statistics: Statistics, least: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the standard deviation of samples of weight 1 from (S,) least squared errors."""
    views = np.asarray(statistics.views.numpy(), np.float64)
    error = np.maximum(least, 0) / statistics.channels
    variance = error * weight / np.maximum(views - PARAMETERS, FEWEST_FREE)
    enough = views >= PARAMETERS + ENOUGH
    # Texels that are saturated in nearly all views get at least the median noise.
    usual = float(np.median(variance[enough])) if enough.any() else 0.0
    variance = np.where(enough, variance, np.maximum(variance, usual))
    return np.maximum(np.sqrt(variance), LEAST_NOISE * statistics.kappa)
