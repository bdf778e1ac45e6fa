"""Uncertainty of estimated light: its scale, its details, and their effect on textures.

Brighter light and darker materials explain photographs almost equally well. The scale is decided
by the 4 % that dielectrics mirror and by base colour being at most 1, which is as small as the
errors of the model, and these do not average out over samples. So the probability of a factor is
taken from the noise: 2.5 % above the least is an end of the 90 % interval. Much of the error is
common to R, G and B and does not affect colour. Both constants were fitted to the scenes that come
with svu_mi, and checked on dark wood and slate.

Details are normally distributed by the normal equations (Laplace's approximation).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import log
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import scipy

from svu_mi.calibration.light.gauss_newton import LightFit
from svu_mi.calibration.light.light_estimate import NINETY, UNANCHORED
from svu_mi.calibration.light.light_prior import COLOR, SD
from svu_mi.calibration.light.light_samples import TexelSamples
from svu_mi.calibration.light.light_transport import (
    Columns,
    SampleMoments,
    Transport,
    columns_of,
    materials_of,
    noise_of,
)
from svu_mi.parameters import NAMES
from svu_mi.presets import AngularPreset
from svu_mi.reflection.principled import diffuse_from_principled

COLORS = 1.5  # number of independent base colours, uniform in [0, 1]: R, G and B are correlated
TOLERANCE = 1.025  # noise at the ends of the 90 % interval of the level, relative to the least
COLORS_SHARPER = 2.0  # weight of noise for colour, relative to that for the level
FURTHEST = 1.5  # logarithm of the largest factor of the light
STEPS = 13  # factors that are tried
TINT_ROUNDS, SMALLEST = 3, 0.01  # of Newton's method, and the least change that matters
TINT = 0.2  # logarithm of a channel's factor relative to the others, for finite differences
MOST_TINTED = 0.5  # logarithm of a channel's factor relative to the mean
FEWEST_DIELECTRIC = 0.2  # part of the surface that fixes the level
LOOSE = 0.5  # standard deviation of its logarithm with less
UNKNOWN = 0.25  # part of the prior's variance removed in half of the light, below which we say so
MOST_WIDENED = 1e4  # textures carry no information

# Negative log probability of noise: SHARPNESS log(noise / least).
SHARPNESS = 0.5 * NINETY**2 / log(TOLERANCE)

# Factors of R, G and B that change colour only: one channel against the others.
TINTS = np.eye(3) - 1 / 3
PLANE = np.array([[2, -1, -1], [0, 3**0.5, -(3**0.5)]]).T / 6**0.5  # basis of these


@dataclass(frozen=True)
class LightScale:
    """Normal distribution of the logarithm of a factor of the light, per channel.

    Attributes:
        best: (3,) mean.
        common: standard deviation of the channels' common part.
        tint: (3,) standard deviation of their own parts.
        anchored: whether enough of the surface is dielectric to fix the level.
    """

    best: np.ndarray
    common: float
    tint: np.ndarray
    anchored: bool

    @property
    def sd(self) -> np.ndarray:
        """(3,) standard deviation of the logarithm of each channel's factor."""
        return np.asarray(np.hypot(self.common, self.tint))


def scale_of(samples: TexelSamples, columns: Columns, switches: AngularPreset) -> LightScale:
    """Return the distribution of the light's scale.

    The brighter the light, the fewer base colours in [0, 1] explain the object, by one factor per
    channel [MacKay 1992, the Occam factor]. Texels are not counted one by one, since they share
    few materials. Steep views are skipped: there, neighbours of the texel in the same pixel look
    like Fresnel reflection of brighter light.
    """
    samples, kept = samples.without_steep_views()
    moments = SampleMoments.of(samples, columns.subset(kept))

    def worse(logarithm: np.ndarray) -> float:
        posterior = moments.posterior(switches, np.exp(logarithm))
        return SHARPNESS * log(noise_of(posterior, samples.unit))

    common, sd = _common_factor(worse)
    tint, tint_sd = _tint(worse, common)
    best = common + tint
    materials = materials_of(moments.posterior(switches, np.exp(best)))
    diffuse = diffuse_from_principled(1.0, *materials.mixed.T)
    anchored = bool((diffuse > 0.5).mean() >= FEWEST_DIELECTRIC)
    return LightScale(best, sd if anchored else max(sd, LOOSE), tint_sd, anchored)


def _common_factor(worse: Callable[[np.ndarray], float]) -> tuple[float, float]:
    """Return the median and the standard deviation of the factor of all channels."""
    steps = np.linspace(-FURTHEST, FURTHEST, STEPS)
    noise = scipy.interpolate.PchipInterpolator(steps, [worse(np.full(3, step)) for step in steps])
    fine = np.linspace(-FURTHEST, FURTHEST, 601)
    energy = noise(fine) + COLORS * fine
    p = np.exp(energy.min() - energy)
    low, middle, high = np.interp((0.05, 0.5, 0.95), np.cumsum(p) / p.sum(), fine)
    return float(middle), float(high - low) / 2 / NINETY


def _tint(worse: Callable[[np.ndarray], float], level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviations (3,) of colour at a level, by Newton's method."""

    def energy(tint: np.ndarray) -> float:
        return COLORS_SHARPER * worse(level + tint) + 0.5 * float(tint @ tint) / COLOR.scale**2

    best, least = np.zeros(3), energy(np.zeros(3))
    for _ in range(TINT_ROUNDS):
        slope, covariance = _slope_and_covariance(energy, best, least)
        step = -covariance @ slope
        step *= min(1.0, MOST_TINTED / max(float(np.abs(best + step).max()), 1e-12))
        after = energy(best + step)
        while after > least and np.abs(step).max() > SMALLEST:
            step = step / 2
            after = energy(best + step)
        if after > least:
            break
        best, least = best + step, after
    return best, np.sqrt(np.diag(covariance))


def _slope_and_covariance(
    energy: Callable[[np.ndarray], float], tint: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return slope (3,) and inverse curvature (3, 3) of the energy of colours."""
    steps = TINT * np.concatenate([TINTS, -TINTS])
    excess = np.array([energy(tint + step) for step in steps]) - least
    a, b = (steps @ PLANE).T
    terms = np.stack([a, b, a * a / 2, a * b, b * b / 2], axis=1)
    *slope, aa, ab, bb = np.linalg.lstsq(terms, excess, rcond=None)[0]
    values, vectors = np.linalg.eigh([[aa, ab], [ab, bb]])
    axes = PLANE @ vectors
    curvature = np.maximum(values, COLOR.scale**-2)  # no less than the prior's own
    return PLANE @ slope, axes @ np.diag(1 / curvature) @ axes.T


class LightSamples(NamedTuple):
    """Posterior samples (K, N, 3) of log radiance at the level of the mean, and standard deviations
    (N,) of the channels' mean of a cell, relative to that level."""

    draws: np.ndarray
    cell_sd: np.ndarray


def sample_lights(fit: LightFit, count: int, seed: int = 0) -> LightSamples:
    """Draw K = ``count`` lights from the Gaussian of the normal equations."""
    number, root = len(fit.x), np.linalg.cholesky(fit.system.matrix)
    every = len(root)  # gains of photographs follow the cells of each channel
    inverse = scipy.linalg.solve_triangular(root, np.eye(every), lower=True, check_finite=False)
    noise = np.random.default_rng(seed).standard_normal((every, count))
    free = (inverse.T @ noise).T.reshape(count, 3, -1)[..., :number].transpose(0, 2, 1)
    mean = inverse.reshape(every, 3, -1)[..., :number].mean(axis=1)
    light = np.exp(fit.x).mean(axis=1)
    mean -= (mean @ light / light.sum())[:, None]  # the level has its own distribution
    draws = fit.x + free
    draws += np.log(np.exp(fit.x).mean(axis=0) / np.exp(draws).mean(axis=1, keepdims=True))
    return LightSamples(draws, np.sqrt(np.square(mean).sum(axis=0, dtype=np.float64)))


def remarks_of(level: LightScale, cell_sd: np.ndarray) -> tuple[str, ...]:
    """Return sentences about unknown parts of the light."""
    remarks = []
    if np.median(1 - np.square(cell_sd / SD)) < UNKNOWN:
        remarks.append(
            "Hardly any detail of the light is known: the object mirrors too little of it, which "
            "is no harm to its own textures."
        )
    if not level.anchored:
        remarks.append(UNANCHORED)
    return tuple(remarks)


def widening_of(
    transport: Transport, columns: Columns, draws: np.ndarray, level: LightScale,
    switches: AngularPreset,
) -> float:  # fmt: skip
    """Return the factor of the variance of textures that the uncertainty of the light adds.

    The posterior means under K other lights, (K, N, 3) logarithms, differ: their variance adds to
    the posterior variance. The common factor of base colours has its own interval.
    """
    samples, parts = transport.samples, []
    own = SampleMoments.of(samples, columns).posterior(switches, np.exp(level.best))
    # Levels at even quantiles, as many as there are lights.
    quantiles = (np.arange(len(draws)) + 0.5) / len(draws)
    factors = np.exp([level.common * NormalDist().inv_cdf(float(q)) for q in quantiles])
    others = [
        SampleMoments.of(samples, columns_of(transport, np.exp(x), switches)).posterior(
            switches, factor * np.exp(level.best)
        )
        for x, factor in zip(draws, factors, strict=True)
    ]
    for name in NAMES:
        within = np.square(np.array(own.sd(name)), dtype=np.float64).mean()
        common = factors if name == "base_color" else np.ones(len(draws))
        means = [np.array(p.mean(name)) * c for p, c in zip(others, common, strict=True)]
        between = np.var(means, axis=0, ddof=1, dtype=np.float64).mean()
        parts.append(between / max(float(within), 1e-12))
    return float(min(1 + np.mean(parts), MOST_WIDENED))
