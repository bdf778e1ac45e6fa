"""Posterior of Eq. 11 in one kernel: energies of grid bins, and their entropy.

For one roughness, the distance of Eq. 11 is a quadratic in K = Ks^2,

    d(K) = sum S_B^2 - 2 K sum e_l S_L S_B + K^2 sum e_l^2 S_L^2,

whose products of spectra are computed once per texel. It cancels, so it is in double precision.
On a principled grid, base colours are the bins of a row, and degree 0 takes part: a constant
Kd E / pi has the coefficient c_00 = 2 Kd E / sqrt(pi) (Eq. 7).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.posterior import row_entropy
from svu_mi.reflection.principled import diffuse_from_principled, specular_from_principled


@dataclass(frozen=True)
class ConstantTerm:
    """Degree 0: sqrt(S_B(0)) = 2 Kd E / sqrt(pi) + R0 a sqrt(S_L(0)).

    Attributes:
        irradiance: (T * C) Float, E.
        albedo: (R,) Float64, a: reflected part of constant light.
        sigma: Float64, standard deviation of sqrt(S_B(0)), in radiance.
    """

    mixed: list[np.ndarray]
    irradiance: Any
    albedo: Any
    sigma: Any


@dataclass(frozen=True)
class SpectrumProducts:
    """Products of spectra of a texel and group over 2 sigma^2, summed over channels."""

    light: list[Any]  # S_L(l)^2
    both: list[Any]  # S_L(l) S_B(l)
    observed: Any  # sum_l S_B(l)^2


@dataclass(frozen=True)
class SpectrumProblem:
    """Inputs of an energy, as flat Dr.Jit arrays.

    Attributes:
        incoming, outgoing: (T * (L + 1) * C) Float, power spectra.
        sigma: Float64, standard deviation of a degree's power.
        groups: channel indices that share one Ks.
        rows: UInt32, rows that the prior does not exclude.
        decay, albedo: (R,) Float64, q and a^2 of e_l = a^2 q^(l^2), by roughness.
        prior: ((rows,), (rows * bins,)) Float64, -log prior of a row, and of a bin given it.
    """

    incoming: Any
    outgoing: Any
    sigma: Any
    degree: int
    channels: int
    groups: tuple[tuple[int, ...], ...]
    rows: Any
    total: int
    decay: Any
    albedo: Any
    bins: np.ndarray
    prior: tuple[Any, Any] | None
    constant: ConstantTerm | None = None

    @property
    def columns(self) -> int:
        """Rows per roughness."""
        return 1 if self.constant is None else math.prod(map(len, self.constant.mixed))


def entropy(problem: SpectrumProblem, count: int) -> Any:
    """Return the normalised entropy (T,) of Eq. 5, as if all texels were seen."""
    energies = _row_energies(problem, dr.arange(mi.UInt32, count))
    return row_entropy.entropy(energies, count, problem.rows, problem.total)


def _row_energies(problem: SpectrumProblem, texel: Any) -> row_entropy.RowEnergies:
    # Read once, outside of the loop over rows: strided reads would dominate it.
    products = [_products(problem, texel, group) for group in problem.groups]
    constants = _constants(problem, texel)

    def energies(row: Any) -> list[tuple[Any, list[Any]]]:
        level = row // problem.columns
        decay = _decay(problem, level)
        result = []
        for product, constant in zip(products, constants, strict=True):
            R0, first = _bins(problem, level, row - level * problem.columns, constant)
            x = row_distances([R * R for R in R0], product, decay)
            if first is not None:
                x = [value + more for value, more in zip(x, first, strict=True)]
            result.append(x)
        return row_entropy.with_prior(result, problem.prior, row)

    return energies


def _bins(
    problem: SpectrumProblem, level: Any, column: Any, read: tuple[Any, Any, Any] | None
) -> tuple[list[Any], list[Any] | None]:
    """Return R0 of every bin of a row, and the energies of degree 0."""
    bins = row_entropy.bin_values(problem.bins)
    if problem.constant is None or read is None:
        return bins, None
    mixed = row_entropy.row_values(mi.Float64, problem.constant.mixed, column)
    seen, diffuse, specular = read
    specular = specular * dr.gather(mi.Float64, problem.constant.albedo, level)
    R0 = [specular_from_principled(c, *mixed) for c in bins]
    energies = []
    for c, R in zip(bins, R0, strict=True):
        residual = seen - diffuse_from_principled(c, *mixed) * diffuse - R * specular
        energies.append(residual * residual)
    return R0, energies


def _constants(problem: SpectrumProblem, texel: Any) -> list[tuple[Any, Any, Any] | None]:
    """Per group, over sqrt(2) sigma: sqrt(S_B(0)), 2 E / sqrt(pi), sqrt(S_L(0))."""
    if problem.constant is None:
        return [None] * len(problem.groups)
    scale = math.sqrt(0.5) * dr.rcp(problem.constant.sigma)
    result: list[tuple[Any, Any, Any] | None] = []
    for (channel,) in problem.groups:
        place = texel * (problem.degree + 1) * problem.channels + channel
        B, L = (
            dr.sqrt(mi.Float64(dr.gather(mi.Float, spectrum, place)))
            for spectrum in (problem.outgoing, problem.incoming)
        )
        E = mi.Float64(
            dr.gather(mi.Float, problem.constant.irradiance, texel * problem.channels + channel)
        )
        result.append((scale * B, scale * E * (2 / math.sqrt(math.pi)), scale * L))
    return result


def _products(problem: SpectrumProblem, texel: Any, group: tuple[int, ...]) -> SpectrumProducts:
    """Read the spectra of l >= 1 and multiply them."""
    scale = 0.5 * dr.square(dr.rcp(problem.sigma))
    light = [mi.Float64(0)] * problem.degree
    both, observed = list(light), mi.Float64(0)
    for c in group:
        for l in range(problem.degree):
            place = (texel * (problem.degree + 1) + (l + 1)) * problem.channels + c
            L, B = (
                mi.Float64(dr.gather(mi.Float, spectrum, place))
                for spectrum in (problem.incoming, problem.outgoing)
            )
            light[l] = dr.fma(L, L, light[l])
            both[l] = dr.fma(L, B, both[l])
            observed = dr.fma(B, B, observed)
    return SpectrumProducts([scale * x for x in light], [scale * x for x in both], scale * observed)


def _decay(problem: SpectrumProblem, level: Any) -> list[Any]:
    q = dr.gather(mi.Float64, problem.decay, level)
    return falloff(q, dr.gather(mi.Float64, problem.albedo, level), problem.degree)


def falloff(q: Any, first: Any, degree: int) -> list[Any]:
    """e_l = first q^(l^2), l = 1 ... degree: multiplying is faster than reading."""
    power, step, two, result = first, q, q * q, []  # power: of l = 0
    for _ in range(degree):
        power = power * step  # (l + 1)^2 = l^2 + 2 l + 1
        step = step * two
        result.append(power)
    return result


def row_distances(squares: list, products: SpectrumProducts, decay: list) -> list[Any]:
    """d / (2 sigma^2) of every Ks^2 for one roughness (Eq. 11)."""
    slope, curve = mi.Float64(0), mi.Float64(0)
    for e, light, both in zip(decay, products.light, products.both, strict=True):
        slope = dr.fma(e, both, slope)
        curve = dr.fma(e * e, light, curve)
    slope = -2 * slope
    # Rounding may leave a perfect match a hair below zero.
    return [dr.maximum(dr.fma(dr.fma(curve, K, slope), K, products.observed), 0) for K in squares]


def energy_tables(problem: SpectrumProblem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energies of chosen texels, as ``row_entropy.energy_tables`` does."""
    rows = problem.total // len(problem.bins)
    return row_entropy.energy_tables(partial(_row_energies, problem), chosen, rows)
