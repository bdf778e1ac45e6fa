"""How bright the light is, and of which colour: what photographs hardly tell from base colour.

Brighter light and darker materials explain photographs almost as well, and what decides between
them, the 4 % that dielectrics mirror and that base colour is at most 1, is as small as the errors
of the model, which do not average out over samples. So a factor of the light is as probable as the
photographs are explained under it: noise 2.5 % above the least is as improbable as the end of a
90 % interval. Much of those errors is the same for R, G and B, and says nothing of colour. Both are
constants of the scenes that come with svu_mi, and of others like them of dark wood and slate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import log

import numpy as np
import scipy

from svu_mi.illumination.materials import Moments, materials_of, noise_of
from svu_mi.illumination.prior import COLOR
from svu_mi.illumination.record import NINETY
from svu_mi.illumination.samples import Samples
from svu_mi.illumination.transport import Columns
from svu_mi.options import AngularPreset
from svu_mi.reflection.principled import diffuse_from_principled

COLORS = 1.5  # of the object that are each as likely from 0 to 1: R, G and B, which go together
TOLERANCE = 1.025  # noise at the ends of the 90 % interval of the level, relative to the least
COLORS_SHARPER = 2.0  # how many times more noise says of colour than of the level
FURTHEST = 1.5  # logarithm of the largest factor of the light that is asked about
STEPS = 13  # factors that are asked about
TINT_ROUNDS, SMALLEST = 3, 0.01  # of Newton's method, and the least change that matters
TINT = 0.2  # logarithm of a channel's factor beside the others' by which colours are asked about
MOST_TINTED = 0.5  # logarithm of a channel's factor beside that of all
FEWEST_DIELECTRIC = 0.2  # part of the surface that fixes the level
LOOSE = 0.5  # standard deviation of its logarithm where too little does

# How probable noise is: exp(-SHARPNESS log(noise / least)).
SHARPNESS = 0.5 * NINETY**2 / log(TOLERANCE)

# Factors of R, G and B that change colour only: one channel against the others.
TINTS = np.eye(3) - 1 / 3
PLANE = np.array([[2, -1, -1], [0, 3**0.5, -(3**0.5)]]).T / 6**0.5  # that they lie in


@dataclass(frozen=True)
class Level:
    """A factor of the light per channel: its logarithm is normally distributed.

    Attributes:
        best: (3,) what is to be expected of the logarithm.
        common: standard deviation of what the channels have in common.
        tint: (3,) that of what each of them has by itself.
        anchored: whether enough of the surface is dielectric, which mirrors 4 % in any colour.
    """

    best: np.ndarray
    common: float
    tint: np.ndarray
    anchored: bool

    @property
    def sd(self) -> np.ndarray:
        """(3,) standard deviation of the logarithm of each channel's factor."""
        return np.asarray(np.hypot(self.common, self.tint))


def level_of(samples: Samples, columns: Columns, switches: AngularPreset) -> Level:
    """Ask how well light explains the photographs if it is brighter, dimmer, or of another colour.

    The object's base colour may be anything from 0 to 1: the brighter the light, the fewer of them
    explain it, by one factor per channel [MacKay 1992, the Occam factor]. Texels are not counted
    one by one: they are of few materials. Steep views are left out: there, what a pixel shows of
    the texel's neighbours looks like Fresnel's reflection of brighter light on darker paint.

    Args:
        samples: of the texels.
        columns: ``columns_of`` the light.
        switches: of the posterior.
    """
    samples, kept = samples.facing()
    moments = Moments.of(samples, columns.some(kept))

    def worse(logarithm: np.ndarray) -> float:
        posterior = moments.posterior(switches, np.exp(logarithm))
        return SHARPNESS * log(noise_of(posterior, samples.unit))

    common, sd = _common(worse)
    tint, tint_sd = _tint(worse, common)
    best = common + tint
    materials = materials_of(moments.posterior(switches, np.exp(best)))
    diffuse = diffuse_from_principled(1.0, *materials.mixed.T)
    anchored = bool((diffuse > 0.5).mean() >= FEWEST_DIELECTRIC)
    return Level(best, sd if anchored else max(sd, LOOSE), tint_sd, anchored)


def _common(worse: Callable[[np.ndarray], float]) -> tuple[float, float]:
    """Return the median and the standard deviation of the factor of all channels."""
    steps = np.linspace(-FURTHEST, FURTHEST, STEPS)
    noise = scipy.interpolate.PchipInterpolator(steps, [worse(np.full(3, step)) for step in steps])
    fine = np.linspace(-FURTHEST, FURTHEST, 601)
    energy = noise(fine) + COLORS * fine
    p = np.exp(energy.min() - energy)
    low, middle, high = np.interp((0.05, 0.5, 0.95), np.cumsum(p) / p.sum(), fine)
    return float(middle), float(high - low) / 2 / NINETY


def _tint(worse: Callable[[np.ndarray], float], level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviations (3,) of the colour at a level, by Newton's method."""

    def energy(tint: np.ndarray) -> float:
        # What noise does not tell is as the prior of light has it.
        return COLORS_SHARPER * worse(level + tint) + 0.5 * float(tint @ tint) / COLOR.level**2

    best, least = np.zeros(3), energy(np.zeros(3))
    for _ in range(TINT_ROUNDS):
        slope, covariance = _parabola(energy, best, least)
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


def _parabola(
    energy: Callable[[np.ndarray], float], tint: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return slope (3,) and inverse curvature (3, 3) of what speaks against colours."""
    steps = TINT * np.concatenate([TINTS, -TINTS])
    excess = np.array([energy(tint + step) for step in steps]) - least
    a, b = (steps @ PLANE).T
    terms = np.stack([a, b, a * a / 2, a * b, b * b / 2], axis=1)
    *slope, aa, ab, bb = np.linalg.lstsq(terms, excess, rcond=None)[0]
    values, vectors = np.linalg.eigh([[aa, ab], [ab, bb]])
    axes = PLANE @ vectors
    curvature = np.maximum(values, COLOR.level**-2)  # no less than the prior's own
    return PLANE @ slope, axes @ np.diag(1 / curvature) @ axes.T
