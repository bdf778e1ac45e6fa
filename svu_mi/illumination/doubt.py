"""What else the light may be: its level, its details, and what that means for textures.

Details are as uncertain as the normal equations say (Laplace's approximation). The level is not:
brighter light and darker materials explain photographs almost as well, and what decides between
them, the 4 % that dielectrics mirror and that base colour is at most 1, is as small as the errors
of the model, which do not average out over samples. So a level is as probable as the photographs
are explained under it: one whose noise is 4.6 % above that of the best lies at the end of the 90 %
interval (a constant of the scenes that come with svu_mi).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from statistics import NormalDist

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.linalg import solve_triangular

from svu_mi.illumination.materials import Moments, columns_of, materials_of, noise_of
from svu_mi.illumination.prior import SD
from svu_mi.illumination.record import NINETY, UNANCHORED
from svu_mi.illumination.refine import Fit
from svu_mi.illumination.samples import Samples
from svu_mi.illumination.transport import Columns, Transport
from svu_mi.options import AngularPreset
from svu_mi.parameters import NAMES
from svu_mi.reflection.principled import diffuse_from_principled

TOLERANCE = 1.046  # noise at the ends of the 90 % interval of the level, relative to the least
FURTHEST = 1.5  # logarithm of the largest factor of the light that is asked about
STEPS = 13  # factors that are asked about
UNKNOWN = 0.25  # part of the prior's variance of half of the light below which little is known
FEWEST_DIELECTRIC = 0.2  # part of the surface that fixes the level
LOOSE = 0.5  # standard deviation of its logarithm where too little does
MOST_WIDENED = 1e4  # such textures are the prior's
COLOR_SD = 0.05  # of the logarithm of one channel's scale beside that of all


@dataclass(frozen=True)
class Level:
    """A factor of the light: its logarithm is normally distributed.

    Attributes:
        best: the most probable logarithm.
        sd: of the logarithm, by the width of its 90 % interval.
        anchored: whether enough of the surface is dielectric, which mirrors 4 % in any colour.
    """

    best: float
    sd: float
    anchored: bool


def level_of(samples: Samples, columns: Columns, switches: AngularPreset) -> Level:
    """Ask how well light explains the photographs if it is brighter or dimmer.

    Base colours are marginalised: the brighter the light, the fewer of them explain a texel, by one
    factor per channel [MacKay 1992, the Occam factor]. Without it, next to nothing would speak
    against light that is too bright. Texels repeat each other as samples do: tau of either count as
    one. Steep views are left out: there, what a pixel shows of the texel's neighbours looks like
    Fresnel's reflection of brighter light on darker paint.

    Args:
        samples: of the texels.
        columns: ``columns_of`` the light.
        switches: of the posterior.
    """
    samples, kept = samples.facing()
    moments = Moments.of(samples, columns.some(kept))
    steps = np.linspace(-FURTHEST, FURTHEST, STEPS)
    noise = [
        noise_of(moments.posterior(switches, float(np.exp(step))), samples.unit) for step in steps
    ]
    fine = np.linspace(-FURTHEST, FURTHEST, 601)
    smooth = PchipInterpolator(steps, np.log(noise))(fine)
    worse = smooth + samples.texels / samples.count * fine  # per sample
    p = np.exp(-0.5 * NINETY**2 / log(TOLERANCE) * (worse - worse.min()))
    below = np.cumsum(p) / p.sum()
    low, high = (float(np.interp(part, below, fine)) for part in (0.05, 0.95))
    best, sd = float(fine[worse.argmin()]), (high - low) / 2 / NINETY
    materials = materials_of(moments.posterior(switches, float(np.exp(best))))
    diffuse = diffuse_from_principled(1.0, *materials.mixed.T)
    anchored = bool((diffuse > 0.5).mean() >= FEWEST_DIELECTRIC)
    return Level(best, sd if anchored else max(sd, LOOSE), anchored)


@dataclass(frozen=True)
class Possible:
    """Lights that explain the samples about as well.

    Attributes:
        draws: (K, N, 3) logarithms of radiance, all of the level of the best.
        cell_sd: (N,) standard deviation of the channels' mean of a cell, relative to that level.
    """

    draws: np.ndarray
    cell_sd: np.ndarray


def possible(fit: Fit, count: int, seed: int = 0) -> Possible:
    """Draw from the Gaussian of the normal equations.

    Args:
        fit: light, and its normal equations.
        count: K.
        seed: of the draws.
    """
    number, root = len(fit.x), np.linalg.cholesky(fit.system.matrix)
    inverse = solve_triangular(root, np.eye(3 * number), lower=True, check_finite=False)
    noise = np.random.default_rng(seed).standard_normal((3 * number, count))
    free = (inverse.T @ noise).T.reshape(count, 3, number).transpose(0, 2, 1)
    mean = sum(inverse[:, c * number : (c + 1) * number] for c in range(3)) / 3
    light = np.exp(fit.x).mean(axis=1)
    mean -= (mean @ light / light.sum())[:, None]  # the level is asked about by itself
    return Possible(
        _at_level(fit.x + free, fit.x), np.sqrt(np.square(mean).sum(axis=0, dtype=np.float64))
    )


def _at_level(draws: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Give draws (K, N, 3) the mean radiance of x (N, 3)."""
    own = np.log(np.exp(draws).mean(axis=1, keepdims=True))
    return draws - own + np.log(np.exp(x).mean(axis=0))


def remarks_of(level: Level, found: Possible) -> tuple[str, ...]:
    """Return sentences about what photographs do not tell of the light."""
    remarks = []
    known = 1 - np.square(found.cell_sd / SD)
    if np.median(known) < UNKNOWN:
        remarks.append(
            "Hardly any detail of the light is known: the object mirrors too little of it, which "
            "is no harm to its own textures."
        )
    if not level.anchored:
        remarks.append(UNANCHORED)
    return tuple(remarks)


def widening_of(
    transport: Transport, columns: Columns, draws: np.ndarray, level: Level,
    switches: AngularPreset,
) -> float:  # fmt: skip
    """Return how many times less certain textures are for the light being one of several.

    The means of the posterior differ from light to light: their variance adds to that which each
    of them has. The factor that base colours have in common is left out: that is told apart.

    Args:
        transport: samples and cells.
        columns: ``columns_of`` the light.
        draws: (K, N, 3) logarithms of others, of its level.
        level: what it may be.
        switches: of the posterior.
    """
    samples, parts = transport.samples, []
    own = Moments.of(samples, columns).posterior(switches, float(np.exp(level.best)))
    # Levels at even quantiles, as many as there are lights.
    quantiles = (np.arange(len(draws)) + 0.5) / len(draws)
    factors = np.exp([NormalDist(level.best, level.sd).inv_cdf(float(q)) for q in quantiles])
    others = [
        Moments.of(samples, columns_of(transport, np.exp(x), switches))
        .posterior(switches, float(factor))
        for x, factor in zip(draws, factors, strict=True)
    ]
    for name in NAMES:
        within = np.square(np.array(own.sd(name)), dtype=np.float64).mean()
        common = factors / np.exp(level.best) if name == "base_color" else np.ones(len(draws))
        means = [np.array(p.mean(name)) * c for p, c in zip(others, common, strict=True)]
        between = np.var(means, axis=0, ddof=1, dtype=np.float64).mean()
        parts.append(between / max(float(within), 1e-12))
    return float(min(1 + np.mean(parts), MOST_WIDENED))
