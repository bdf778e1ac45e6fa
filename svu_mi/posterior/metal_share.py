"""Share of metals on an object, learned from a sample of its texels.

Expectation maximisation [Dempster, Laird and Rubin 1977] of the prior probability q that a pure
material (metallic 0 or 1) is a metal: in each round

    q <- (P_1 + e / 2) / (P_0 + P_1 + e),

with P_0 and P_1 the mean posterior probabilities of the outermost bins of metallic. e limits the
odds to 1 + 2 / e, because errors of the model are alike on the whole object.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from svu_mi.posterior.calibrated import calibrated_posterior
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.presets import AngularPreset
from svu_mi.statistics.cholesky_factors import Factors

ROUNDS = 2
EVEN = 0.3  # e
METAL_SAMPLE = 400  # number of texels


def knows_metals(grid: PrincipledGrid) -> bool:
    """Return whether metallic is known."""
    return "metallic" in grid.known


def learned_metal_share(
    factors: Factors, grid: PrincipledGrid, scale: float, switches: AngularPreset, **options: Any
) -> float:
    """Return the share q of metals; ``options`` are those of ``calibrated_posterior``."""
    texels, share = factors.texel.numpy(), 0.5
    for _ in range(ROUNDS if len(texels) else 0):
        known = replace(switches, metal_share=share)
        posterior = calibrated_posterior(factors, grid, scale, known, **options)
        ends = np.array(posterior.marginal("metallic", texels), np.float64)[:, [0, -1]].mean(axis=0)
        share = float((ends[1] + EVEN / 2) / (ends.sum() + EVEN))
    return share
