"""Posterior from angular statistics (Eq. 3 to 6, without a frequency domain).

Bins are grouped into rows: bins of a row differ only in the last parameter (base colour or Ks). On
a (roughness, Ks) grid, each roughness is a row, and Kd is the best value in [0, 1] for each Ks.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import prod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior import row_entropy
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.kernel import GridKernel, Pair, Prior, observed_by, require_scale
from svu_mi.posterior.posterior import Posterior
from svu_mi.presets import AngularPreset
from svu_mi.presets import preset as find_preset
from svu_mi.reflection.principled import Mixture, mixture, paper_mixture
from svu_mi.statistics.cholesky_factors import FLOOR, Factors, apply_factor, squared_length
from svu_mi.statistics.statistics import Statistics

UNLIKELY = 1e30  # energy of a bin that the prior excludes; finite in single precision
HOPELESS = 1e30  # upper bound of energies: differences of infinite ones would be NaN


@dataclass(frozen=True)
class AngularProblem:
    """Inputs of the energy -log p.

    Attributes:
        copies: number of equal colour channels per channel of the factors.
        slots: (R,) UInt32, index of the level in the factors for each roughness node.
        rows: UInt32, rows of the grid that the prior does not exclude.
        total: number of bins.
        sigma: Float, opaque, standard deviation of a texel's error in radiance.
        averaged: True: energies use the mean of squared errors over views; False: the sum.
        mixed: (M,) nodes of each parameter in ``MIXED``; None on a (roughness, Ks) grid.
        bins: nodes of the last parameter, base colour or Ks.
        prior: -log prior of rows (Float64) and of bins given their row (Float); None: uniform.
    """

    factors: Factors
    copies: int
    slots: Any
    rows: Any
    total: int
    sigma: Any
    averaged: bool
    mixed: list[np.ndarray] | None
    bins: np.ndarray
    prior: tuple[Any, Any] | None

    @property
    def columns(self) -> int:
        """Number of rows per roughness: M, or 1."""
        return prod(len(nodes) for nodes in self.mixed or ())


@dataclass(frozen=True)
class AngularKernel(GridKernel):
    """Posterior from angular statistics on a ``PrincipledGrid`` or ``ParameterGrid``."""

    grid: ParameterGrid | PrincipledGrid
    count: int
    problem: AngularProblem

    @property
    def channels(self) -> int:
        """Number of base colours or Ks per texel: 3, or 1 for grey."""
        return self.problem.factors.channels * self.problem.copies

    @cached_property
    def prior(self) -> Prior:
        """Prior, equal for all channels."""
        return Prior(row_entropy.prior_table(self.problem.prior, self.grid.shape), self.grid.axes)

    def entropy(self, texels: np.ndarray) -> np.ndarray:
        """Return the normalised entropy (see ``Kernel``)."""
        return self._entropies[self._lane[texels]]

    def tables(self, texels: np.ndarray) -> Pair:
        """Return bin probabilities and the most probable nodes (see ``GridKernel``)."""
        rows = self.problem.total // len(self.problem.bins)
        energies = partial(_row_energies, self.problem)
        base, offsets = row_entropy.energy_tables(energies, self._lane[texels], rows)
        return row_entropy.probabilities(base, offsets, self.grid.shape)

    @cached_property
    def _lane(self) -> np.ndarray:
        return self.problem.factors.lane_of_texel(self.count)

    @cached_property
    def _entropies(self) -> np.ndarray:
        problem, count = self.problem, self.problem.factors.count
        energies = _row_energies(problem, dr.arange(mi.UInt32, count))
        return np.array(row_entropy.entropy(energies, count, problem.rows, problem.total))


def angular_grid(grid: Any | None, switches: AngularPreset) -> ParameterGrid | PrincipledGrid:
    """Return ``grid``, or a default grid with 8 nodes for each of the preset's parameters."""
    kind = PrincipledGrid if switches.parameters == "principled" else ParameterGrid
    grid = kind() if grid is None else grid
    if not isinstance(grid, kind):
        raise OptionError(
            f"parameters={switches.parameters!r} need a {kind.__name__}, got {grid!r}."
        )
    if isinstance(grid, ParameterGrid) and grid.spacing is None:
        return replace(grid, spacing="dielectric")
    return grid


def angular_posterior(
    statistics: Statistics | Factors,
    grid: PrincipledGrid | ParameterGrid | None = None,
    scale: float = 1.0,
    preset: str | AngularPreset = "fixed",
    *,
    prior: Any | None = None,
    copies: int = 1,
    levels: np.ndarray | None = None,
    texels: int | None = None,
) -> Posterior[AngularKernel]:
    """Compute the posterior on a grid from squared errors with a given standard deviation.

        p ~ exp(-d / (2 sigma^2)) prior,    d = 1/n sum_i w_i (b_i - r_i(psi))^2   (Eq. 3, 4)

    d is a mean, because errors of the reflection model do not average out over n views. With
    ``errors="sum"``, d is a sum without 1/n, as printed.

    Args:
        statistics: statistics of S texels at the grid's roughness nodes, or their factors.
        grid: ``PrincipledGrid`` or, if the preset's ``parameters`` are ``specular``,
            ``ParameterGrid``. Default: 8 nodes per axis.
        scale: radiance unit of sigma; ignored if the preset's ``noise`` is ``fixed``.
        preset: name or options.
        prior: non-negative weights in the grid's shape, or one per roughness node.
        copies: number of equal colour channels per channel of the statistics.
        levels: (R,) bool, roughness nodes that the statistics contain; default: all. The prior
            must exclude all other nodes.
        texels: number T of texels, seen or not; default: the largest texel number plus one.

    Raises:
        ShapeError: the grid's roughness nodes differ from the statistics' levels.
        OptionError: a grid with other parameters than the preset's, or an invalid scale or prior.

    Example:
        >>> observed, grid = estimate.observed, svu.PrincipledGrid(roughness=6)
        >>> fixed = svu.preset("fixed", method="angular")  # one channel: the mean of R, G and B
        >>> statistics = observed.statistics(grid.roughness_nodes, fixed, 1)
        >>> svu.angular_posterior(statistics, grid, observed.unit).mean("roughness").ndim
        1
    """
    switches = find_preset(preset, method="angular")
    if switches.noise == "estimated":
        raise OptionError(
            "angular_posterior(): noise='estimated' is not supported; use preset='fixed', or "
            "calibrated_posterior()."
        )
    grid = angular_grid(grid, switches)
    factors = statistics.factor() if isinstance(statistics, Statistics) else statistics
    levels = np.ones(grid.shape[0], bool) if levels is None else np.asarray(levels)
    _require_levels(levels, grid, factors.roughness)
    require_scale("angular_posterior()", scale)
    observed = observed_by("angular_posterior()", factors, copies, texels)
    tables = row_entropy.log_prior(prior, grid.shape, "angular_posterior()")
    problem = AngularProblem(
        factors=factors,
        copies=copies,
        slots=to_drjit(mi.UInt32, np.maximum(np.cumsum(levels) - 1, 0).astype(np.uint32)),
        rows=row_entropy.possible_rows(tables, int(np.prod(grid.shape[:-1]))),
        total=int(np.prod(grid.shape)),
        sigma=dr.opaque(mi.Float, switches.sigma * (1 if switches.noise == "fixed" else scale)),
        averaged=switches.errors == "mean",
        mixed=grid.mixed_nodes if isinstance(grid, PrincipledGrid) else None,
        bins=list(grid.axes.values())[-1],
        prior=_prior(tables),
    )
    return Posterior(kernel=AngularKernel(grid, len(observed), problem), observed=observed)


def _prior(tables: tuple[np.ndarray, np.ndarray] | None) -> tuple[Any, Any] | None:
    if tables is None:
        return None
    return to_drjit(mi.Float64, tables[0]), to_drjit(mi.Float, np.minimum(tables[1], UNLIKELY))


def _require_levels(
    levels: np.ndarray, grid: ParameterGrid | PrincipledGrid, roughness: np.ndarray
) -> None:
    """Raise an error if ``roughness`` differs from the grid's nodes selected by ``levels``."""
    if levels.dtype != bool or levels.shape != grid.shape[:1]:
        raise ShapeError(
            f"angular_posterior(): levels must be ({grid.shape[0]},) booleans, got "
            f"{levels.dtype} of shape {levels.shape}."
        )
    if not np.array_equal(grid.roughness_nodes[levels], roughness):
        raise ShapeError(
            "angular_posterior(): the grid's roughness is "
            f"{_listed(grid.roughness_nodes[levels])}, but the statistics have "
            f"{_listed(roughness)}; gather the statistics at the nodes of the grid."
        )


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _row_energies(problem: AngularProblem, lane: Any) -> row_entropy.RowEnergies:
    factors = problem.factors
    reader = factors.reader(lane)
    square = reader.weight / 2  # factors contain errors per unit of weight
    if problem.averaged:
        square /= mi.Float(dr.maximum(dr.gather(mi.UInt32, factors.views, lane), 1))
    scale = dr.sqrt(square) / problem.sigma

    def energies(row: Any) -> list[tuple[Any, list[Any]]]:
        level = row // problem.columns
        slot = dr.gather(mi.UInt32, problem.slots, level)
        groups = []
        for of_channel in reader.entries(slot):
            *entries, floor = (scale * entry for entry in of_channel)
            x = _bins(problem, row - level * problem.columns, [*entries, scale * floor])
            groups.append([dr.minimum(value, HOPELESS) for value in x])
        return row_entropy.with_prior(groups * problem.copies, problem.prior, row)

    return energies


def _bins(problem: AngularProblem, column: Any, U: list[Any]) -> list[Any]:
    """Return the squared error |U x|^2 (``Factors``) of each bin of a row."""
    nodes = [mi.Float(node) for node in row_entropy.bin_values(problem.bins)]
    if problem.mixed is None:
        return [_error_at_best_diffuse(U, paper_mixture(Ks)) for Ks in nodes]
    mix = mixture(*row_entropy.row_values(mi.Float, problem.mixed, column))
    u, v = (apply_factor(U, x)[:-1] for x in (mix.slope, mix.offset))
    mixed = [[dr.fma(a, c, b) for a, b in zip(u, v, strict=True)] for c in nodes]
    return [squared_length(components, U[FLOOR]) for components in mixed]


def _error_at_best_diffuse(U: list[Any], mix: Mixture) -> Any:
    """Return |U x|^2 at the best Kd in [0, 1]; only the first component depends on Kd."""
    first, *others = apply_factor(U, mix.offset)[:-1]
    slope = U[0]
    inverse = dr.select(slope > 0, dr.rcp(dr.select(slope > 0, slope, 1)), 0)
    first = dr.fma(slope, dr.clip(-first * inverse, 0, 1), first)
    return squared_length([first, *others], U[FLOOR])
