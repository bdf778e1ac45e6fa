"""What else the light may be in detail, and what all of that means for textures.

Details are as uncertain as the normal equations say (Laplace's approximation). How bright light
is, and of which colour, is asked about by itself (``level``).
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import scipy

from svu_mi.illumination.level import Level
from svu_mi.illumination.materials import Moments, columns_of
from svu_mi.illumination.prior import SD
from svu_mi.illumination.record import UNANCHORED
from svu_mi.illumination.refine import Fit
from svu_mi.illumination.transport import Columns, Transport
from svu_mi.options import AngularPreset
from svu_mi.parameters import NAMES

UNKNOWN = 0.25  # part of the prior's variance of half of the light below which little is known
MOST_WIDENED = 1e4  # such textures are the prior's


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
    every = len(root)  # gains of photographs follow the cells of each channel
    inverse = scipy.linalg.solve_triangular(root, np.eye(every), lower=True, check_finite=False)
    noise = np.random.default_rng(seed).standard_normal((every, count))
    free = (inverse.T @ noise).T.reshape(count, 3, -1)[..., :number].transpose(0, 2, 1)
    mean = inverse.reshape(every, 3, -1)[..., :number].mean(axis=1)
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
    own = Moments.of(samples, columns).posterior(switches, np.exp(level.best))
    # Levels at even quantiles, as many as there are lights.
    quantiles = (np.arange(len(draws)) + 0.5) / len(draws)
    factors = np.exp([level.common * NormalDist().inv_cdf(float(q)) for q in quantiles])
    others = [
        Moments.of(samples, columns_of(transport, np.exp(x), switches))
        .posterior(switches, factor * np.exp(level.best))
        for x, factor in zip(draws, factors, strict=True)
    ]
    for name in NAMES:
        within = np.square(np.array(own.sd(name)), dtype=np.float64).mean()
        common = factors if name == "base_color" else np.ones(len(draws))
        means = [np.array(p.mean(name)) * c for p, c in zip(others, common, strict=True)]
        between = np.var(means, axis=0, ddof=1, dtype=np.float64).mean()
        parts.append(between / max(float(within), 1e-12))
    return float(min(1 + np.mean(parts), MOST_WIDENED))
