"""Prior learned from all texels of an object (empirical Bayes [Robbins 1956]).

Expectation maximisation [Dempster, Laird and Rubin 1977] finds the prior of largest likelihood. In
each step the new prior is the mean of the posteriors under the current one,

    p(psi) <- mean over texels of p(psi | B_p, L).

This replaces the paper's global sharing (Sec. 5.2), without seeds: texels share probabilities, not
values. The mean is blurred by the uncertainty of each texel, so it is raised to a power > 1.
More steps gain more where materials repeat, and lose where textures vary smoothly.

The blur favours what is determined precisely, as the roughness of a metal beside that of rough
paint, whose highlight is weak. So learning must not raise the mean probability of metals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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

SHARPNESS = 1.3  # exponent of the mean


@dataclass(frozen=True)
class Learning:
    """How strongly texels share a prior.

    Attributes:
        rounds: number of steps; more amplify errors that all texels share.
        otherwise: weight of the original prior, for texels or colours unlike all others.
        capped: number of steps that lower the prior of metals, until texels are not called metal
            more often than without sharing.
    """

    rounds: int
    otherwise: float
    capped: int = 0


CAREFUL = Learning(1, 0.1, 10)  # loses little where nothing repeats; chosen on our own scenes
FIRM = Learning(2, 1e-3)  # most accurate where materials repeat
SAMPLE = 1500  # number of texels that the prior is learned from
LEAST = 1e-30  # replaces 0 in a logarithm


def with_empirical_prior(
    posterior: Posterior[CalibratedKernel], how: Learning = CAREFUL
) -> Posterior[CalibratedKernel]:
    """Return the posterior under a prior learned by expectation maximisation.

    R, G and B have separate base colour priors, given all other parameters. Bins that the present
    prior excludes stay excluded. A posterior with a learned prior is returned unchanged.
    """
    problem = posterior.kernel.problem
    seen = np.flatnonzero(np.array(problem.factors.views))
    if posterior.kernel.learned or len(seen) == 0:
        return posterior
    chosen = seen[evenly_spaced(len(seen), SAMPLE)]
    sample, alone = problem.subset(chosen), prior_tables(problem)
    own = _mean(sample)
    learned = _sharpened(own, alone, how.otherwise)
    for _ in range(how.rounds - 1):
        learned = _sharpened(_mean(_with_prior(sample, learned)), alone, how.otherwise)
    for _ in range(how.capped):
        metals = _mean(_with_prior(sample, learned))[:, -1].sum()
        learned[:, -1] *= min(1, own[:, -1].sum() / max(metals, LEAST))
        learned /= learned.sum(axis=(0, 1, 2))
    problem = _with_prior(problem, learned)
    summary = kernel.summarize(problem)
    of_texels = replace(posterior.kernel, problem=problem, summary=summary, learned=True)
    return replace(posterior, kernel=of_texels)


def _mean(sample: CalibratedProblem) -> np.ndarray:
    """Return the mean posterior of the sample's texels, (R, M, K, C)."""
    everyone = np.arange(sample.factors.count)
    return np.asarray(kernel.bin_probabilities(sample, everyone).mean(axis=0, dtype=float))


def _sharpened(mean: np.ndarray, alone: np.ndarray, otherwise: float) -> np.ndarray:
    """Sharpen the mean posterior, (R, M, K, C), and mix it with the prior ``alone``."""
    sharp = mean**SHARPNESS
    result = (1 - otherwise) * sharp / np.maximum(sharp.sum(axis=(0, 1, 2)), LEAST)
    result += otherwise * alone
    rows = result.sum(axis=2, keepdims=True)  # per channel; averaged below
    given = (1 - otherwise) * result / np.maximum(rows, LEAST)
    given += otherwise * alone / np.maximum(alone.sum(axis=2, keepdims=True), LEAST)
    return given * rows.mean(axis=3, keepdims=True)


def _with_prior(problem: CalibratedProblem, prior: np.ndarray) -> CalibratedProblem:
    """Return the problem with bin probabilities ``prior``, (R, M, K, C)."""
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
