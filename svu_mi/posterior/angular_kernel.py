"""Energies of grid cells from angular statistics.

A row is one roughness and metallic; its cells are base colours, along which Kd and R0 are
linear. On the smaller grid a row is one roughness, its cells are values of Ks = R0, and Kd
takes the best value in [0, 1] for each ("profiled out"): what is left of the quadratic then is
its second component alone, unless that value lies outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.angular import Statistics
from svu_mi.angular.statistics import FIELDS
from svu_mi.brdf.principled import F0
from svu_mi.posterior import streaming

HOPELESS = 1e30  # an energy beyond single precision would be infinite, its differences NaN


@dataclass(frozen=True)
class Problem:
    """Everything an energy depends on.

    Attributes:
        statistics: of T texels, their levels, and C channels; every channel is a group.
        copies: how many equal channels each stands for.
        slots: (R,) UInt32, which level of the statistics a roughness of the grid is.
        rows: UInt32, rows of the grid that the prior does not exclude.
        total: number of cells of the grid.
        sigma: Float, opaque: standard deviation of a texel's error, in radiance.
        power: (T,) Float nu / 2 of d^(-nu/2), or None for exp(-d / (2 sigma^2)); sigma^2 is
            then the floor that is added to d.
        metallic: (M,) nodes, or None for a grid of Ks.
        cells: nodes of base colour, or of Ks.
        prior: (-log prior of a row, of a cell given its row) as Float64 and Float, or None.
    """

    statistics: Statistics
    copies: int
    slots: Any
    rows: Any
    total: int
    sigma: Any
    power: Any | None
    metallic: np.ndarray | None
    cells: np.ndarray
    prior: tuple[Any, Any] | None

    @property
    def columns(self) -> int:
        """Rows per roughness: M, or 1."""
        return 1 if self.metallic is None else len(self.metallic)


def entropy(problem: Problem) -> Any:
    """Return the normalised entropy (T,) of Eq. 5, before unseen texels are set to 1."""
    count = problem.statistics.count
    energies = _row_energies(problem, dr.arange(mi.UInt32, count))
    return streaming.entropy(energies, count, problem.rows, problem.total)


def tables(problem: Problem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energies of chosen texels, as ``streaming.tables`` does."""
    rows = problem.total // len(problem.cells)
    return streaming.tables(partial(_row_energies, problem), chosen, rows)


def _row_energies(problem: Problem, texel: Any) -> streaming.RowEnergies:
    stats = problem.statistics
    stride = dr.opaque(mi.UInt32, stats.count)
    scale = dr.rsqrt(mi.Float(2)) / problem.sigma
    power = None if problem.power is None else dr.gather(mi.Float, problem.power, texel)
    start = stats.levels * stats.channels * FIELDS

    def read(column: Any) -> Any:
        return dr.gather(mi.Float, stats.values, column * stride + texel)

    # Squares may leave single precision where their roots do not: 0 times infinity is NaN.
    squares = [scale * (scale * read(start + c)) for c in range(stats.channels)]
    least = [dr.minimum(square, HOPELESS) for square in squares]

    def energies(row: Any) -> list[tuple[Any, list[Any]]]:
        level = row // problem.columns
        slot = dr.gather(mi.UInt32, problem.slots, level)
        groups = []
        for channel in range(stats.channels):
            column = (slot * stats.channels + channel) * FIELDS
            fields = [scale * read(column + field) for field in range(FIELDS)]
            x = _cells(problem, row - level * problem.columns, fields, scale)
            x = [dr.minimum(value, HOPELESS) for value in x]
            if power is not None:
                x = [power * dr.log(2 * (value + least[channel]) + 1) for value in x]
            groups.append(x)
        return streaming.with_prior(groups * problem.copies, problem.prior, row)

    return energies


def _cells(problem: Problem, column: Any, fields: list[Any], scale: Any) -> list[Any]:
    """Mean squared error of every cell of a row, over 2 sigma^2."""
    u_ee, u_ep, u_pp, z_e, z_p, floor = fields
    floor = scale * floor  # it is a square
    energies, nodes = [], [mi.Float(node) for node in streaming.cells(problem.cells)]
    if problem.metallic is None:
        inverse = dr.select(u_ee > 0, dr.rcp(dr.select(u_ee > 0, u_ee, 1)), 0)
        for Ks in nodes:
            rest = dr.fma(-u_ep, Ks, z_e)
            Kd = dr.clip(rest * inverse, 0, 1)
            first, second = dr.fma(u_ee, Kd, -rest), dr.fma(u_pp, Ks, -z_p)
            energies.append(dr.fma(first, first, dr.fma(second, second, floor)))
        return energies
    m = streaming.node(mi.Float, problem.metallic, column)
    # Kd = (1 - m) c and R0 = F0 (1 - m) + m c: both components are linear in c.
    first_0, first_1 = dr.fma(u_ep * F0, 1 - m, -z_e), dr.fma(u_ee, 1 - m, u_ep * m)
    second_0, second_1 = dr.fma(u_pp * F0, 1 - m, -z_p), u_pp * m
    for c in nodes:
        first, second = dr.fma(first_1, c, first_0), dr.fma(second_1, c, second_0)
        energies.append(dr.fma(first, first, dr.fma(second, second, floor)))
    return energies
