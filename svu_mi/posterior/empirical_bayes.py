"""Prior shared by the texels of an object, learned from all of them.

Expectation maximisation [Dempster, Laird and Rubin 1977] finds the prior of largest likelihood. It
is the mean of the posteriors that it leads to (empirical Bayes [Robbins 1956]),

    p(psi) <- mean over texels of p(psi | B_p, L).

Global sharing (Sec. 5.2 of the paper) without seeds: texels share probabilities, not values. Each
posterior is blurred by its texel's uncertainty, and so is the mean: a power sharpens it.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import evenly_spaced, to_drjit
from svu_mi.posterior import calibrated_kernel as kernel
from svu_mi.posterior import row_entropy
from svu_mi.posterior.calibrated import CalibratedKernel, prior_tables
from svu_mi.posterior.calibrated_problem import CalibratedProblem
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.quadrature import bin_widths

ROUNDS = 2  # more of them drift where all texels err alike; chosen on our own scenes
SHARPNESS = 1.3
OTHERWISE = 1e-3  # probability that a texel, or its colour, is like no other
SAMPLE = 1500  # texels that the prior is learned from
LEAST = 1e-30  # probability that stands for 0 in a logarithm


def with_empirical_prior(
    posterior: Posterior[CalibratedKernel], rounds: int = ROUNDS
) -> Posterior[CalibratedKernel]:
    """Return the posterior with a shared prior, learned in ``rounds`` of expectation maximisation.

    Base colours of R, G and B each have a prior, given all others. Bins that the given prior
    excludes stay excluded. A posterior that has a learned prior is returned unchanged.
    """
    problem = posterior.kernel.problem
    seen = np.flatnonzero(np.array(problem.factors.views))
    if posterior.kernel.learned or len(seen) == 0:
        return posterior
    chosen = seen[evenly_spaced(len(seen), SAMPLE)]
    sample, everyone = problem.subset(chosen), np.arange(len(chosen))
    alone = prior_tables(problem)
    learned = _sharpened(
        kernel.bin_probabilities(sample, everyone).mean(axis=0, dtype=float), alone
    )
    for _ in range(rounds - 1):
        updated = _with_prior(sample, learned)
        learned = _sharpened(
            kernel.bin_probabilities(updated, everyone).mean(axis=0, dtype=float), alone
        )
    of_texels = replace(posterior.kernel, problem=_with_prior(problem, learned), learned=True)
    return replace(posterior, kernel=of_texels)


def _sharpened(mean: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Sharpen the mean (R, M, K, C) of posteriors and mix it with the prior ``alone``."""
    sharp = mean**SHARPNESS
    result = (1 - OTHERWISE) * sharp / np.maximum(sharp.sum(axis=(0, 1, 2)), LEAST)
    result += OTHERWISE * alone
    rows = result.sum(axis=2, keepdims=True)  # of one channel; all share the others
    given = (1 - OTHERWISE) * result / np.maximum(rows, LEAST)
    given += OTHERWISE * alone / np.maximum(alone.sum(axis=2, keepdims=True), LEAST)
    return given * rows.mean(axis=3, keepdims=True)


def _with_prior(problem: CalibratedProblem, prior: np.ndarray) -> CalibratedProblem:
    """Return the problem with a prior (R, M, K, C) of the masses of bins."""
    rows = prior.sum(axis=2).mean(axis=2).ravel()
    energies = np.where(rows > 0, -np.log(np.maximum(rows, LEAST)), row_entropy.IMPOSSIBLE)
    given = prior / np.maximum(prior.sum(axis=2, keepdims=True), LEAST)
    density = np.moveaxis(given, 3, 2) / bin_widths(problem.edges)
    density = to_drjit(mi.Float, density.ravel())
    problem = replace(problem, rows=energies, color_prior=density, tables=prior.shape[-1])
    # Energies are relative to the best node, which depends on the prior.
    above = kernel.min_energy(problem, excess=True)
    problem = replace(problem, min_energy=problem.min_energy + above)
    dr.eval(problem.min_energy)
    return problem
