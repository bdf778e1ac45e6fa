"""The posterior from angular statistics (Eq. 3 to 6, without a frequency domain)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError, ShapeError
from svu_mi.interop import owned
from svu_mi.options import AngularPreset
from svu_mi.options import preset as find_preset
from svu_mi.posterior import angular_kernel as kernel
from svu_mi.posterior import streaming
from svu_mi.posterior.checks import require_scale, total_texels
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.record import Posterior
from svu_mi.statistics import Factors, Statistics

UNLIKELY = 1e30  # energy, in single precision, of a cell that the prior excludes
FITTED = 3  # roughness, Kd and Ks, which the marginal noise rule pays for


@dataclass(frozen=True, kw_only=True)
class AngularPosterior(Posterior):
    """p over the axes of a ``PrincipledGrid``, or over (roughness, specular).

    Attributes:
        problem: factors of S texels, noise and grid (see ``angular_kernel``).
    """

    problem: kernel.Problem

    @cached_property
    def _lane(self) -> np.ndarray:
        return self.problem.factors.lanes(self.count)

    @property
    def groups(self) -> int:
        """3 when each colour channel has its own base colour or Ks, else 1."""
        return self.problem.factors.channels * self.problem.copies

    @property
    def prior(self) -> np.ndarray:
        """Prior probability of every cell, (R, M ..., K) or (R, S) float64; of each channel."""
        return streaming.prior_of(self.problem.prior, self.grid.shape)

    def _entropy_of_all(self) -> Any:
        everywhere = dr.full(mi.Float, 1, self.count)
        dr.eval(everywhere)
        dr.scatter(everywhere, kernel.entropy(self.problem), self.problem.factors.texel)
        return everywhere

    def _tables(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        base, offsets = kernel.tables(self.problem, self._lane[chosen])
        return streaming.probabilities(base, offsets, self.grid.shape)


def angular_grid(grid: Any | None, switches: AngularPreset) -> ParameterGrid | PrincipledGrid:
    """Return the grid that a preset's parameters call for.

    Args:
        grid: of those parameters, or None for 8 nodes each. Without a spacing of its own, Ks
            is spaced for dielectrics.
        switches: the preset.

    Raises:
        OptionError: a grid of other parameters.
    """
    wanted = PrincipledGrid if switches.parameters == "principled" else ParameterGrid
    grid = wanted() if grid is None else grid
    if not isinstance(grid, wanted):
        raise OptionError(
            f"parameters={switches.parameters!r} need a {wanted.__name__}, got {grid!r}."
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
) -> AngularPosterior:
    """Compare photographs with what every cell of a grid predicts for them.

        p ~ exp(-d / (2 sigma^2)) prior,    d = 1/n sum_i w_i (b_i - r_i(psi))^2   (Eq. 3, 4)

    The *mean* squared error: the model's own error is the same from many views as from few,
    and must not be averaged away. With ``errors="sum"``, as printed, there is no 1/n.

    Args:
        statistics: of S texels, or their factors; the levels are the grid's roughness.
        grid: ``PrincipledGrid``, or ``ParameterGrid`` for (roughness, Ks); the preset's
            ``parameters`` say which, by default 8 nodes each.
        scale: radiance that sigma is a part of, unless the preset's noise is ``fixed``.
        preset: switches.
        prior: non-negative weights of the cells, of the grid's shape, or one per roughness.
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
    levels = np.ones(grid.shape[0], bool) if levels is None else np.asarray(levels)
    if levels.dtype != bool or levels.shape != grid.shape[:1]:
        raise ShapeError(
            f"angular_posterior(): levels must be ({grid.shape[0]},) booleans, got "
            f"{levels.dtype} of shape {levels.shape}."
        )
    factors = statistics.factor() if isinstance(statistics, Statistics) else statistics
    if not np.array_equal(grid.roughness_nodes[levels], factors.roughness):
        raise ShapeError(
            "angular_posterior(): the grid's roughness is "
            f"{_listed(grid.roughness_nodes[levels])}, that of the statistics "
            f"{_listed(factors.roughness)}; gather them at the nodes of the grid."
        )
    require_scale("angular_posterior()", scale)
    sigma = switches.sigma * (1.0 if switches.noise == "fixed" else scale)
    views = np.array(factors.views)
    texel = factors.texel.numpy()
    total = total_texels("angular_posterior()", factors, copies, texels)
    observed = np.zeros(total, bool)
    observed[texel] = views > 0
    power = np.maximum(views.astype(np.float64) - FITTED, 1) / 2
    *_, cells = grid.axes.values()
    tables = streaming.log_prior(prior, grid.shape, "angular_posterior()")
    problem = kernel.Problem(
        factors=factors,
        copies=copies,
        slots=owned(mi.UInt32, np.maximum(np.cumsum(levels) - 1, 0).astype(np.uint32)),
        rows=streaming.possible_rows(tables, int(np.prod(grid.shape[:-1]))),
        total=int(np.prod(grid.shape)),
        sigma=dr.opaque(mi.Float, sigma),
        averaged=switches.errors == "mean",
        power=owned(mi.Float, power) if switches.noise == "marginal" else None,
        mixed=grid.mixed_nodes if isinstance(grid, PrincipledGrid) else None,
        cells=cells,
        prior=None if tables is None else (
            owned(mi.Float64, tables[0]), owned(mi.Float, np.minimum(tables[1], UNLIKELY))
        ),
    )
    return AngularPosterior(grid=grid, observed=observed, problem=problem)


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in values)
