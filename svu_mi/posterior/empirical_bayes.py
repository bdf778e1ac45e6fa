"""Prior learned from all texels of an object (empirical Bayes [Robbins 1956]).

Expectation maximisation [Dempster, Laird and Rubin 1977] finds the prior of largest likelihood. In
each step the new prior is the mean of the posteriors under the current one,

    p(psi) <- mean over texels of p(psi | B_p, L).

This replaces the paper's global sharing (Sec. 5.2), without seeds: texels share probabilities, not
values. The mean is blurred by the uncertainty of each texel. For textures, a texel's neighbours
sharpen it: bins are weighted by a normal distribution around posterior means that were smoothed
over the surface, and the mean is raised to a power < 1, since smoothing counts the prior of each
texel. Without neighbours, the power is > 1.
"""

from collections.abc import Mapping
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.core.arrays import evenly_spaced, to_drjit
from svu_mi.posterior import calibrated_kernel as kernel
from svu_mi.posterior import row_entropy
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.calibrated_prior import prior_tables
from svu_mi.posterior.calibrated_problem import CalibratedProblem
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.quadrature import bin_edges, bin_widths

NEAR = 0.5  # standard deviation about smoothed means, relative to the texel's own
LEAST_SD = 0.03  # its minimum
# Number of steps (more amplify errors that all texels share), weight of the original prior (for
# texels or colours unlike all others), and exponent of the mean posterior:
CAREFUL = 1, 0.1, 0.8  # with neighbours; chosen on our own scenes
FIRM = 2, 1e-3, 1.3  # without; loses where textures vary smoothly
SAMPLE = 1500  # number of texels that the prior is learned from
LEAST = 1e-30  # replaces 0 in a logarithm


def with_empirical_prior(
    posterior: Posterior[CalibratedKernel], smoothed: Mapping[str, np.ndarray] | None = None
) -> Posterior[CalibratedKernel]:
    """Return the posterior under a prior learned by expectation maximisation.

    R, G and B have separate base colour priors, given all other parameters. Bins that the present
    prior excludes stay excluded. A posterior with a learned prior is returned unchanged.
    ``smoothed`` are posterior means smoothed over the surface, (T,) or (T, C) by parameter.
    """
    rounds, *how = FIRM if smoothed is None else CAREFUL
    problem = posterior.kernel.problem
    seen = np.flatnonzero(np.array(problem.factors.views))
    if posterior.kernel.learned or len(seen) == 0:
        return posterior
    chosen = seen[evenly_spaced(len(seen), SAMPLE)]
    sample, alone = problem.subset(chosen), prior_tables(problem)
    likely = 1.0 if smoothed is None else _likely(posterior, chosen, smoothed)
    learned = _sharpened(_mean(sample, likely), alone, *how)
    for _ in range(rounds - 1):
        learned = _sharpened(_mean(_with_prior(sample, learned), likely), alone, *how)
    problem = _with_prior(problem, learned)
    summary = kernel.summarize(problem)
    of_texels = replace(posterior.kernel, problem=problem, summary=summary, learned=True)
    return replace(posterior, kernel=of_texels)


def _mean(sample: CalibratedProblem, likely: np.ndarray | float = 1.0) -> np.ndarray:
    """Return the mean posterior (R, M, K, C) of t texels, weighted by ``likely`` (``_likely``)."""
    everyone = np.arange(sample.factors.count)
    weighted = kernel.bin_probabilities(sample, everyone) * likely
    weighted /= np.maximum(weighted.sum(axis=(1, 2, 3), keepdims=True), LEAST)
    return np.asarray(weighted.mean(axis=0, dtype=float))


def _likely(
    posterior: Posterior[CalibratedKernel], lanes: np.ndarray, smoothed: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Return masses of bins under normal distributions around smoothed means, (t, R, M, K, C)."""
    own, problem = posterior.kernel.alone(), posterior.kernel.problem
    texels, total = problem.factors.texel.numpy()[lanes], np.ones((len(lanes), 1, 1))
    for name, nodes in posterior.axes.items():
        mean = smoothed[name][texels].reshape(len(texels), -1, 1)
        sd = np.maximum(NEAR * own.moments(name, texels)[1], LEAST_SD)[:, :, None]
        below = scipy.special.ndtr((bin_edges(nodes)[1:-1] - mean) / sd)
        masses = np.moveaxis(np.diff(below, prepend=0, append=1), 2, 1)
        product = total[:, :, None] * masses[:, None]  # (t, bins so far, bins, C)
        total = product.reshape(len(texels), -1, product.shape[3])
    return np.maximum(total, LEAST).reshape(len(texels), *problem.shape, -1)


def _sharpened(mean: np.ndarray, alone: np.ndarray, otherwise: float, power: float) -> np.ndarray:
    """Sharpen the mean posterior, (R, M, K, C), and mix it with the prior ``alone``."""
    sharp = mean**power
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
