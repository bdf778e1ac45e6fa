"""Energies of grid cells from angular statistics.

A row is one cell of all but base colour; its cells are base colours, along which errors are
linear. On the smaller grid a row is one roughness, its cells are values of Ks = R0, and Kd
takes the best value in [0, 1] for each ("profiled out"): the first component of the error is 0
then, unless that value lies outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.posterior import streaming
from svu_mi.reflection.principled import Mixture, lobe_mixture, mixture
from svu_mi.statistics import Factors
from svu_mi.statistics.factors import FLOOR, combined

HOPELESS = 1e30  # an energy beyond single precision would be infinite, its differences NaN


@dataclass(frozen=True)
class Problem:
    """Everything an energy depends on.

    Attributes:
        factors: of S texels, their levels, and C channels; every channel is a group.
        copies: how many equal channels each stands for.
        slots: (R,) UInt32, which level of the factors a roughness of the grid is.
        rows: UInt32, rows of the grid that the prior does not exclude.
        total: number of cells of the grid.
        sigma: Float, opaque: standard deviation of a texel's error, in radiance.
        averaged: whether d is the mean over views of their squared errors, or the sum.
        power: (S,) Float nu / 2 of d^(-nu/2), or None for exp(-d / (2 sigma^2)); sigma^2 is
            then the floor that is added to d.
        mixed: (M,) nodes of every parameter that mixes the columns, or None for a grid of Ks.
        cells: nodes of base colour, or of Ks.
        prior: (-log prior of a row, of a cell given its row) as Float64 and Float, or None.
    """

    factors: Factors
    copies: int
    slots: Any
    rows: Any
    total: int
    sigma: Any
    averaged: bool
    power: Any | None
    mixed: list[np.ndarray] | None
    cells: np.ndarray
    prior: tuple[Any, Any] | None

    @property
    def columns(self) -> int:
        """Rows per roughness: M, or 1."""
        return prod(len(nodes) for nodes in self.mixed or ())


def entropy(problem: Problem) -> Any:
    """Return the normalised entropy (S,) of Eq. 5 of every texel that has factors."""
    count = problem.factors.count
    energies = _row_energies(problem, dr.arange(mi.UInt32, count))
    return streaming.entropy(energies, count, problem.rows, problem.total)


def tables(problem: Problem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energies of chosen texels among S, as ``streaming.tables`` does."""
    rows = problem.total // len(problem.cells)
    return streaming.tables(partial(_row_energies, problem), chosen, rows)


def _row_energies(problem: Problem, lane: Any) -> streaming.RowEnergies:
    factors = problem.factors
    reader = factors.at(lane)
    square = reader.weight / 2  # errors are per unit of weight
    if problem.averaged:  # over views, whose weights are at most 1
        square /= mi.Float(dr.maximum(dr.gather(mi.UInt32, factors.views, lane), 1))
    scale = dr.sqrt(square) / problem.sigma
    power = None if problem.power is None else dr.gather(mi.Float, problem.power, lane)
    # Squares may leave single precision where their roots do not: 0 times infinity is NaN.
    least = [dr.minimum(scale * (scale * of_channel), HOPELESS) for of_channel in reader.least]

    def energies(row: Any) -> list[tuple[Any, list[Any]]]:
        level = row // problem.columns
        slot = dr.gather(mi.UInt32, problem.slots, level)
        groups = []
        for of_channel, rest in zip(reader.entries(slot), least, strict=True):
            *entries, floor = (scale * entry for entry in of_channel)
            x = _cells(problem, row - level * problem.columns, [*entries, scale * floor])
            x = [dr.minimum(value, HOPELESS) for value in x]
            if power is not None:
                x = [power * dr.log(2 * (value + rest) + 1) for value in x]
            groups.append(x)
        return streaming.with_prior(groups * problem.copies, problem.prior, row)

    return energies


def _cells(problem: Problem, column: Any, U: list[Any]) -> list[Any]:
    """Mean squared error of every cell of a row, over 2 sigma^2: |U x|^2 (``Factors``)."""
    nodes = [mi.Float(node) for node in streaming.cells(problem.cells)]
    if problem.mixed is None:
        return [_over_diffuse(U, lobe_mixture(Ks)) for Ks in nodes]
    how = mixture(*streaming.nodes(mi.Float, problem.mixed, column))
    u, v = (combined(U, x)[:-1] for x in (how.scaled, how.constant))
    return [_square([dr.fma(a, c, b) for a, b in zip(u, v, strict=True)], U[FLOOR]) for c in nodes]


def _over_diffuse(U: list[Any], how: Mixture) -> Any:
    """The same at the best Kd in [0, 1], which only the first component depends on."""
    first, *others = combined(U, how.constant)[:-1]
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
