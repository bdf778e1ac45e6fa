"""Share of metals on an object, learned from a sample of its texels.

Expectation maximisation [Dempster, Laird and Rubin 1977] of the prior probability q that a pure
material (metallic 0 or 1) is a metal: in each round

    q <- (P_1 + e u) / (P_0 + P_1 + e),

with P_0 and P_1 the mean posterior probabilities under q of the outermost bins of metallic. Rounds
are cheap and many: texels whose light does not separate metals from dielectrics hold q where it is.
e weighs the usual share u of metals, and limits the odds, because errors of the model are alike on
the whole object. Both were chosen on our own scenes.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from svu_mi.posterior.calibrated import calibrated_posterior
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.presets import AngularPreset
from svu_mi.statistics.cholesky_factors import Factors

ROUNDS = 60
USUAL, WEIGHT = 0.25, 0.3  # u, e
METAL_SAMPLE = 400  # number of texels


def knows_metals(grid: PrincipledGrid) -> bool:
    """Return whether metallic is known."""
    return "metallic" in grid.known


def learned_metal_share(
    factors: Factors, grid: PrincipledGrid, scale: float, switches: AngularPreset, **options: Any
) -> float:
    """Return the share q of metals; ``options`` are those of ``calibrated_posterior``."""
    share = 0.5
    even = replace(switches, metal_share=share)
    posterior = calibrated_posterior(factors, grid, scale, even, **options)
    p = np.array(posterior.marginal("metallic", factors.texel.numpy()), np.float64)
    for _ in range(ROUNDS if len(p) else 0):
        weighted = p * np.r_[2 - 2 * share, np.ones(p.shape[1] - 2), 2 * share]
        ends = (weighted / weighted.sum(axis=1, keepdims=True))[:, [0, -1]].mean(axis=0)
        share = float((ends[1] + WEIGHT * USUAL) / (ends.sum() + WEIGHT))
    return share
