"""Posterior of Eq. 11 in one kernel: energies of grid bins, and their entropy.

For one roughness, the distance of Eq. 11 is a quadratic in K = Ks^2,

    d(K) = sum S_B^2 - 2 K sum e_l S_L S_B + K^2 sum e_l^2 S_L^2.

Products of spectra are computed once per texel, in double precision because the terms cancel. On a
principled grid, rows of bins differ in base colour, and degree 0 adds a term: a constant Kd E / pi
has the coefficient c_00 = 2 Kd E / sqrt(pi) (Eq. 7).
"""

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
    """Inputs of degree 0: sqrt(S_B(0)) = 2 Kd E / sqrt(pi) + R0 a sqrt(S_L(0)).

    Attributes:
        irradiance: (T * C,) Float, E.
        albedo: (R,) Float64, a, reflected fraction of constant light.
        sigma: Float64, standard deviation of sqrt(S_B(0)), in radiance.
    """

    mixed: list[np.ndarray]
    irradiance: Any
    albedo: Any
    sigma: Any


@dataclass(frozen=True)
class SpectrumProducts:
    """Products of a texel's spectra divided by 2 sigma^2, summed over a group's channels."""

    light: list[Any]  # S_L(l)^2
    both: list[Any]  # S_L(l) S_B(l)
    observed: Any  # sum_l S_B(l)^2


@dataclass(frozen=True)
class SpectrumProblem:
    """Inputs of the energy, as flat Dr.Jit arrays.

    Attributes:
        incoming, outgoing: (T * (L + 1) * C,) Float, power spectra.
        sigma: Float64, standard deviation of the power of a degree.
        groups: indices of the channels that share one Ks, for each Ks.
        rows: UInt32, indices of the rows that the prior does not exclude.
        decay, albedo: (R,) Float64, q and a^2 of e_l = a^2 q^(l^2), per roughness.
        prior: -log prior of rows, (rows,), and of bins given their row, (rows * bins,), Float64.
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
        """Number of rows per roughness."""
        return 1 if self.constant is None else math.prod(map(len, self.constant.mixed))


def entropy(problem: SpectrumProblem, count: int) -> Any:
    """Return the normalised entropy of all texels, (T,), seen or not (Eq. 5)."""
    energies = _row_energies(problem, dr.arange(mi.UInt32, count))
    return row_entropy.entropy(energies, count, problem.rows, problem.total)


def _row_energies(problem: SpectrumProblem, texel: Any) -> row_entropy.RowEnergies:
    # Outside of the loop over rows, which strided reads would dominate.
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
    """Return R0 of each bin of a row, and the energies of degree 0 (None if not used)."""
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
    """Return sqrt(S_B(0)), 2 E / sqrt(pi) and sqrt(S_L(0)) per group, over sqrt(2) sigma."""
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
    """Read the spectra of l >= 1 and return their products."""
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
    """Return e_l = first q^(l^2), l = 1 ... degree; multiplication is faster than a table."""
    power, step, two, result = first, q, q * q, []  # power = e_0
    for _ in range(degree):
        power = power * step  # (l + 1)^2 = l^2 + 2 l + 1
        step = step * two
        result.append(power)
    return result


def row_distances(squares: list, products: SpectrumProducts, decay: list) -> list[Any]:
    """Return d / (2 sigma^2) of each Ks^2 in ``squares`` for one roughness (Eq. 11)."""
    slope, curve = mi.Float64(0), mi.Float64(0)
    for e, light, both in zip(decay, products.light, products.both, strict=True):
        slope = dr.fma(e, both, slope)
        curve = dr.fma(e * e, light, curve)
    slope = -2 * slope
    # Rounding can make the distance of a perfect match negative.
    return [dr.maximum(dr.fma(dr.fma(curve, K, slope), K, products.observed), 0) for K in squares]


def energy_tables(problem: SpectrumProblem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energies of some texels (see ``row_entropy.energy_tables``)."""
    rows = problem.total // len(problem.bins)
    return row_entropy.energy_tables(partial(_row_energies, problem), chosen, rows)
