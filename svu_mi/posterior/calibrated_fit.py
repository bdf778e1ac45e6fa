"""Inputs of the calibrated posterior, and the noise of texels, estimated from their residuals."""

from dataclasses import replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import ShapeError
from svu_mi.parameters import MIXED, PARAMETERS
from svu_mi.posterior import calibrated_kernel as kernel
from svu_mi.posterior import row_entropy
from svu_mi.posterior.calibrated_problem import CalibratedProblem
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.kernel import require_scale
from svu_mi.posterior.metal_colors import color_densities
from svu_mi.posterior.noise import noise_variance
from svu_mi.posterior.quadrature import (
    MIXED_PARTS,
    ProductAxis,
    bin_edges,
    bin_widths,
    mixed_axis,
    uniform_axis,
)
from svu_mi.presets import AngularPreset
from svu_mi.reflection.roughness_levels import roughness_levels
from svu_mi.statistics.cholesky_factors import Factors
from svu_mi.statistics.statistics import Statistics

FEWEST = 4  # minimum number of roughness levels; the spline needs four
SMALL = 0.05  # density of base colour below which energies need a new reference


class CalibratedFit(NamedTuple):
    """Problem with energies in units of noise, noise (S,) float64, and integrals of S texels."""

    problem: CalibratedProblem
    noise: np.ndarray
    summary: kernel.PosteriorSummary


def _require_levels(levels: np.ndarray, nodes: np.ndarray) -> None:
    """Raise an error if the statistics' roughness levels do not permit interpolation."""
    if len(nodes) == 1:
        good = np.array_equal(levels, nodes)
        wanted = f"the known roughness, {nodes[0]:g}"
    else:
        good = len(levels) >= FEWEST and np.allclose(levels, roughness_levels(len(levels)))
        wanted = f"at least {FEWEST} levels of roughness_levels()"
    if not good:
        raise ShapeError(
            f"calibrated_posterior(): statistics must be gathered at {wanted}, got roughness "
            f"{', '.join(f'{level:.4g}' for level in levels)}."
        )


def problem_of(
    factors: Factors, grid: PrincipledGrid, scale: float, switches: AngularPreset,
    prior: Any | None, copies: int,
) -> CalibratedProblem:  # fmt: skip
    """Return the inputs of the posterior, without noise (see ``calibrated_posterior``)."""
    _require_levels(factors.roughness, grid.roughness_nodes)
    require_scale("calibrated_posterior()", scale)
    r = uniform_axis(grid.roughness_nodes, switches.parts)
    mixed = ProductAxis(tuple(
        mixed_axis(
            grid.axes[name], MIXED_PARTS, switches.metals * PARAMETERS[name].has_atoms,
            0.5 if switches.metal_share is None else switches.metal_share,
        )
        for name in MIXED
    ))  # fmt: skip
    edges = bin_edges(grid.base_color_nodes)
    tables = row_entropy.log_prior(prior, grid.shape, "calibrated_posterior()")
    given = None
    if tables is None:
        rows = -np.log(np.outer(r.of_bins(), mixed.of_bins()).ravel())
        colors = color_densities(grid, edges, switches.bare_metals)
        if colors is not None:
            given = to_drjit(mi.Float, np.tile(colors, (r.bins, 1)).ravel())
    else:
        rows = tables[0]
        width = bin_widths(edges)
        given = to_drjit(mi.Float, (np.exp(-tables[1]).reshape(-1, len(width)) / width).ravel())
        possible = rows.reshape(r.bins, -1) < row_entropy.IMPOSSIBLE
        r = r.subset(np.any(possible, axis=1))
    empty = dr.zeros(mi.Float, factors.count)
    return CalibratedProblem(factors, copies, r, mixed, edges, rows, given, empty, empty)


def fit(
    problem: CalibratedProblem, switches: AngularPreset, scale: float, rounding: np.ndarray | None
) -> CalibratedFit:
    """Estimate the noise s of S texels from their residuals, and integrate their posteriors."""
    factors = problem.factors
    rest, residual, weight = _residuals(problem, scale)
    variance = noise_variance(
        residual, np.array(factors.views, np.float64), factors.channels * problem.copies,
        switches.degrees, switches.assumed,
        None if rounding is None else rounding / scale**2,
    )  # fmt: skip
    energy_scale = weight / (variance * switches.overdispersion)
    problem = replace(
        problem, scale=to_drjit(mi.Float, np.sqrt(energy_scale) / scale),
        min_energy=to_drjit(mi.Float, energy_scale * rest),
    )  # fmt: skip
    if problem.least_color_prior < SMALL:  # at the best node, perhaps
        above = kernel.min_energy(problem, excess=True)
        problem = replace(problem, min_energy=problem.min_energy + above)
        dr.eval(problem.min_energy)
    return CalibratedFit(problem, scale * np.sqrt(variance), kernel.summarize(problem))


def _residuals(
    problem: CalibratedProblem, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return least energy and Q_min over ``scale``^2, and weight of S texels, (S,) float64."""
    # Opaque: with a literal, Dr.Jit would compile another kernel for each capture.
    unit = dr.opaque(mi.Float, 1 / scale, problem.factors.count)
    rest = np.array(kernel.min_energy(replace(problem, scale=unit)), np.float64)
    unexplained, weight = problem.factors.residuals()
    return rest, weight * (2 * rest + problem.copies * unexplained / scale**2), weight


def noise_of_parts(
    statistics: Statistics, grid: PrincipledGrid, scale: float, switches: AngularPreset, parts: int
) -> np.ndarray:
    """Return the noise (P, S / P) of parts of the texels, which do not affect each other."""
    factors = statistics.factor()
    problem = problem_of(factors, grid, scale, switches, None, 1)
    of_parts = (np.split(x, parts) for x in (_residuals(problem, scale)[1], factors.views.numpy()))
    variance = [
        noise_variance(
            residual, views.astype(np.float64), factors.channels, switches.degrees, switches.assumed
        )
        for residual, views in zip(*of_parts, strict=True)
    ]
    return np.asarray(scale * np.sqrt(variance))
