"""Posterior from angular statistics (Eq. 3 to 6, without a frequency domain).

A row is a bin of all parameters but base colour. On the (roughness, Ks) grid it is a roughness;
Kd then takes its best value in [0, 1] for each Ks.
"""

from __future__ import annotations

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
from svu_mi.statistics.cholesky_factors import FLOOR, Factors, apply_factor
from svu_mi.statistics.statistics import Statistics

UNLIKELY = 1e30  # energy, in single precision, of a bin that the prior excludes
HOPELESS = 1e30  # an energy beyond single precision would be infinite, its differences NaN


@dataclass(frozen=True)
class AngularProblem:
    """Inputs of the energy.

    Attributes:
        slots: (R,) UInt32, level of the factors for each roughness of the grid.
        rows: UInt32, rows of the grid that the prior does not exclude.
        sigma: Float, opaque: standard deviation of a texel's error, in radiance.
        averaged: whether d is the mean of squared errors over views, or the sum.
        mixed: (M,) nodes of every parameter that mixes the columns, or None for a grid of Ks.
        prior: (-log prior of a row, of a bin given its row) as Float64 and Float, or None.
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
        """Rows per roughness: M, or 1."""
        return prod(len(nodes) for nodes in self.mixed or ())


@dataclass(frozen=True)
class AngularKernel(GridKernel):
    """p over the axes of a ``PrincipledGrid``, or over (roughness, specular)."""

    grid: ParameterGrid | PrincipledGrid
    count: int
    problem: AngularProblem

    @property
    def channels(self) -> int:
        """3 when each colour channel has its own base colour or Ks, else 1."""
        return self.problem.factors.channels * self.problem.copies

    @cached_property
    def prior(self) -> Prior:
        """The prior, the same of each channel."""
        return Prior(row_entropy.prior_table(self.problem.prior, self.grid.shape), self.grid.axes)

    def entropy(self, texels: np.ndarray) -> np.ndarray:
        """Return the normalised entropy (see ``Kernel``)."""
        return self._entropies[self._lane[texels]]

    def tables(self, texels: np.ndarray) -> Pair:
        """Return p of every bin and the best nodes (see ``GridKernel``)."""
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
    """Return the grid of a preset's parameters; default: 8 nodes each, dielectric Ks."""
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
    """Compare photographs with what every bin of a grid predicts for them.

        p ~ exp(-d / (2 sigma^2)) prior,    d = 1/n sum_i w_i (b_i - r_i(psi))^2   (Eq. 3, 4)

    The *mean* squared error: the model's own error is the same from many views as from few,
    and must not be averaged away. With ``errors="sum"``, as printed, there is no 1/n.

    Args:
        statistics: of S texels, or their factors; the levels are the grid's roughness.
        grid: ``PrincipledGrid``, or ``ParameterGrid`` for (roughness, Ks); the preset's
            ``parameters`` say which, by default 8 nodes each.
        scale: radiance that sigma is a part of, unless the preset's noise is ``fixed``.
        preset: switches.
        prior: non-negative weights of the bins, of the grid's shape, or one per roughness.
        copies: how many equal colour channels each channel of the statistics stands for.
        levels: (R,) bool, the roughness nodes that the statistics have; all by default. The
            prior must exclude the others.
        texels: T, how many there are in all, seen or not; by default up to the last of S.

    Raises:
        ShapeError: the grid's roughness is not the statistics'.
        OptionError: a grid of other parameters than the preset's, an invalid scale or prior.
    """
    switches = find_preset(preset, method="angular")
    if switches.noise == "estimated":
        raise OptionError(
            "angular_posterior(): estimated noise is for calibrated_posterior(); use "
            "preset='fixed', or another noise."
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
    """Refuse statistics whose roughness is not that of the grid's ``levels``."""
    if levels.dtype != bool or levels.shape != grid.shape[:1]:
        raise ShapeError(
            f"angular_posterior(): levels must be ({grid.shape[0]},) booleans, got "
            f"{levels.dtype} of shape {levels.shape}."
        )
    if not np.array_equal(grid.roughness_nodes[levels], roughness):
        raise ShapeError(
            "angular_posterior(): the grid's roughness is "
            f"{_listed(grid.roughness_nodes[levels])}, that of the statistics "
            f"{_listed(roughness)}; gather them at the nodes of the grid."
        )


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _row_energies(problem: AngularProblem, lane: Any) -> row_entropy.RowEnergies:
    factors = problem.factors
    reader = factors.reader(lane)
    square = reader.weight / 2  # errors are per unit of weight
    if problem.averaged:  # over views, whose weights are at most 1
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
    """Mean squared error of every bin of a row, over 2 sigma^2: |U x|^2 (``Factors``)."""
    nodes = [mi.Float(node) for node in row_entropy.bin_values(problem.bins)]
    if problem.mixed is None:
        return [_error_at_best_diffuse(U, paper_mixture(Ks)) for Ks in nodes]
    mix = mixture(*row_entropy.row_values(mi.Float, problem.mixed, column))
    u, v = (apply_factor(U, x)[:-1] for x in (mix.slope, mix.offset))
    return [_square([dr.fma(a, c, b) for a, b in zip(u, v, strict=True)], U[FLOOR]) for c in nodes]


def _error_at_best_diffuse(U: list[Any], mix: Mixture) -> Any:
    """Return the error at the best Kd in [0, 1]; only the first component depends on it."""
    first, *others = apply_factor(U, mix.offset)[:-1]
    slope = U[0]
    inverse = dr.select(slope > 0, dr.rcp(dr.select(slope > 0, slope, 1)), 0)
    first = dr.fma(slope, dr.clip(-first * inverse, 0, 1), first)
    return _square([first, *others], U[FLOOR])


def _square(components: list[Any], floor: Any) -> Any:
    """|U x|^2, of whose last component ``floor`` is the square."""
    total = floor
    for x in reversed(components):
        total = dr.fma(x, x, total)
    return total
