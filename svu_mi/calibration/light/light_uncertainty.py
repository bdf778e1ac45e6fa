"""Uncertainty of estimated light: scale, details, and their effect on textures.

Brighter light and darker materials explain photographs almost equally well. Only the 4 %
reflectance of dielectrics and the bound 1 of base colour determine the scale. These effects are as
small as the errors of the model, which do not average out over samples. The probability of a scale
is therefore a function of the noise: the 90 % interval ends where the noise is 2.5 % above its
minimum. Much of the error is common to R, G and B and does not affect colour. Both constants were
fitted to the included scenes, and validated on dark wood and slate.

Details have the normal distribution of the normal equations (Laplace approximation).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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
)
from svu_mi.parameters import NAMES
from svu_mi.presets import AngularPreset
from svu_mi.reflection.principled import diffuse_from_principled

COLORS = 1.5  # effective number of independent base colour channels
TOLERANCE = 1.025  # noise at the ends of the 90 % interval, relative to the minimum
COLORS_SHARPER = 2.0  # weight of noise for colour relative to the level
FURTHEST = 1.5  # largest log factor of the light
STEPS = 13  # number of tested factors
TINT_ROUNDS, SMALLEST = 3, 0.01  # Newton iterations, and smallest step
TINT = 0.2  # log factor of a channel for finite differences
MOST_TINTED = 0.5  # largest log factor of a channel relative to the mean
FEWEST_DIELECTRIC = 0.2  # dielectric fraction of the surface that determines the level
LOOSE = 0.5  # standard deviation of the log level with less
UNKNOWN = 0.25  # median fraction of removed prior variance, below which a remark is made
WIDENING_TEXELS = 300  # texels that the widening is measured on
MOST_WIDENED = 1e4  # textures carry no information

# Negative log probability of noise: SHARPNESS log(noise / least).
SHARPNESS = 0.5 * NINETY**2 / log(TOLERANCE)

# Changes of colour at constant level: one channel against the others.
TINTS = np.eye(3) - 1 / 3
PLANE = np.array([[2, -1, -1], [0, 3**0.5, -(3**0.5)]]).T / 6**0.5  # basis of TINTS

Energy = Callable[[np.ndarray], np.ndarray]  # (F,) of log factors (F, 3) of the light


@dataclass(frozen=True)
class LightScale:
    """Normal distribution of the log scale of the light, per channel.

    Attributes:
        best: (3,) mean.
        common: Standard deviation of the part common to the channels.
        tint: (3,) standard deviations of the additional part of each channel.
        anchored: True if enough of the surface is dielectric to determine the scale.
    """

    best: np.ndarray
    common: float
    tint: np.ndarray
    anchored: bool

    @property
    def sd(self) -> np.ndarray:
        """(3,) standard deviation of the log scale of each channel."""
        return np.asarray(np.hypot(self.common, self.tint))


def scale_of(samples: TexelSamples, columns: Columns, switches: AngularPreset) -> LightScale:
    """Return the distribution of the scale of the light.

    The brighter the light, the smaller the range of base colours in [0, 1] that explain the object
    [MacKay 1992, the Occam factor]. This range counts once per channel, not per texel, as texels
    share few materials. Steep views are skipped, as their pixels also cover neighbours of the
    texel, which resembles Fresnel reflection of brighter light.
    """
    samples, kept = samples.without_steep_views()
    moments = SampleMoments.of(samples, columns.subset(kept))

    def worse(logarithms: np.ndarray) -> np.ndarray:
        return SHARPNESS * np.log(moments.noise(switches, np.exp(logarithms)))

    common, sd = _common_factor(worse)
    tint, tint_sd = _tint(worse, common)
    best = common + tint
    materials = materials_of(moments.posterior(switches, np.exp(best)))
    diffuse = diffuse_from_principled(1.0, *materials.mixed.T)
    anchored = bool((diffuse > 0.5).mean() >= FEWEST_DIELECTRIC)
    return LightScale(best, sd if anchored else max(sd, LOOSE), tint_sd, anchored)


def _common_factor(worse: Energy) -> tuple[float, float]:
    """Return median and standard deviation of the log factor common to all channels."""
    steps = np.linspace(-FURTHEST, FURTHEST, STEPS)
    noise = scipy.interpolate.PchipInterpolator(steps, worse(np.repeat(steps[:, None], 3, axis=1)))
    fine = np.linspace(-FURTHEST, FURTHEST, 601)
    energy = noise(fine) + COLORS * fine
    p = np.exp(energy.min() - energy)
    low, middle, high = np.interp((0.05, 0.5, 0.95), np.cumsum(p) / p.sum(), fine)
    return float(middle), float(high - low) / 2 / NINETY


def _tint(worse: Energy, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return means and standard deviations (3,) of log tint at a common log scale ``level``."""

    def energy(tints: np.ndarray) -> np.ndarray:
        prior = 0.5 * np.square(tints).sum(axis=1) / COLOR.scale**2
        return COLORS_SHARPER * worse(level + tints) + prior

    best = np.zeros(3)
    (least,) = energy(best[None])
    for _ in range(TINT_ROUNDS):
        slope, covariance = _slope_and_covariance(energy, best, least)
        step = -covariance @ slope
        step *= min(1.0, MOST_TINTED / max(float(np.abs(best + step).max()), 1e-12))
        (after,) = energy((best + step)[None])
        while after > least and np.abs(step).max() > SMALLEST:
            step = step / 2
            (after,) = energy((best + step)[None])
        if after > least:
            break
        best, least = best + step, after
    return best, np.sqrt(np.diag(covariance))


def _slope_and_covariance(
    energy: Energy, tint: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return gradient (3,) and inverse Hessian (3, 3) of ``energy`` at a tint."""
    steps = TINT * np.concatenate([TINTS, -TINTS])
    excess = energy(tint + steps) - least
    a, b = (steps @ PLANE).T
    terms = np.stack([a, b, a * a / 2, a * b, b * b / 2], axis=1)
    *slope, aa, ab, bb = np.linalg.lstsq(terms, excess, rcond=None)[0]
    values, vectors = np.linalg.eigh([[aa, ab], [ab, bb]])
    axes = PLANE @ vectors
    curvature = np.maximum(values, COLOR.scale**-2)  # at least the prior curvature
    return PLANE @ slope, axes @ np.diag(1 / curvature) @ axes.T


class LightSamples(NamedTuple):
    """Posterior samples of the light, normalised to the mean brightness of the estimate.

    Attributes:
        draws: (K, N, 3) log radiance of N cells.
        cell_sd: (N,) relative standard deviations of the mean over channels.
    """

    draws: np.ndarray
    cell_sd: np.ndarray


def sample_lights(fit: LightFit, count: int, seed: int = 0) -> LightSamples:
    """Draw ``count`` lights from the normal distribution of the normal equations."""
    number, root = len(fit.x), np.linalg.cholesky(fit.system.matrix)
    every = len(root)  # gains follow the cells of each channel
    solve = partial(scipy.linalg.solve_triangular, root, lower=True, check_finite=False)
    noise = np.random.default_rng(seed).standard_normal((every, count))
    free = solve(noise, trans="T").T.reshape(count, 3, -1)[..., :number].transpose(0, 2, 1)
    mean = solve(np.tile(np.eye(every // 3, number) / 3, (3, 1)))  # over channels
    light = np.exp(fit.x).mean(axis=1)
    mean -= (mean @ light / light.sum())[:, None]  # the level has its own distribution
    draws = fit.x + free
    draws += np.log(np.exp(fit.x).mean(axis=0) / np.exp(draws).mean(axis=1, keepdims=True))
    return LightSamples(draws, np.sqrt(np.square(mean).sum(axis=0, dtype=np.float64)))


def remarks_of(level: LightScale, cell_sd: np.ndarray) -> tuple[str, ...]:
    """Return sentences about undetermined parts of the light."""
    remarks = []
    if np.median(1 - np.square(cell_sd / SD)) < UNKNOWN:
        remarks.append(
            "The photographs hardly determine details of the light, since the object is too rough; "
            "its textures are not affected."
        )
    if not level.anchored:
        remarks.append(UNANCHORED)
    return tuple(remarks)


def widening_of(
    transport: Transport, x: np.ndarray, draws: np.ndarray, level: LightScale,
    switches: AngularPreset,
) -> float:  # fmt: skip
    """Return the ratio of texture variances with and without uncertainty of the light.

    The variance of the posterior means under K sampled lights (K, N, 3) adds to the posterior
    variance under the estimated light ``x`` (N, 3); both are logarithms. Base colours are first
    multiplied by the sampled scale of their light.
    """
    samples, parts = transport.samples.thinned(WIDENING_TEXELS), []
    few = Transport.of(samples, transport.number, transport.moves)
    # One level per light, at evenly spaced quantiles.
    quantiles = (np.arange(len(draws)) + 0.5) / len(draws)
    factors = np.exp([level.common * NormalDist().inv_cdf(float(q)) for q in quantiles])
    own, *others = [
        SampleMoments.of(samples, columns_of(few, np.exp(light), switches)).posterior(
            switches, factor * np.exp(level.best)
        )
        for light, factor in zip((x, *draws), (1.0, *factors), strict=True)
    ]
    for name in NAMES:
        within = np.square(np.array(own.sd(name)), dtype=np.float64).mean()
        common = factors if name == "base_color" else np.ones(len(draws))
        means = [np.array(p.mean(name)) * c for p, c in zip(others, common, strict=True)]
        between = np.var(means, axis=0, ddof=1, dtype=np.float64).mean()
        parts.append(between / max(float(within), 1e-12))
    return float(min(1 + np.mean(parts), MOST_WIDENED))
