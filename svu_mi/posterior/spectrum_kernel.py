"""The posterior of Eq. 11 in one kernel: energies of grid cells, and their entropy.

For one roughness, the distance of Eq. 11 is a quadratic in K = Ks^2. Around the best K_0 in
[0, 1], with the model m_l = e_l S_L(l) and the residual r = S_B - K_0 m,

    d(K) = sum r^2 - 2 (K - K_0) sum m r + (K - K_0)^2 sum m^2,

so the degrees are summed once per row, not once per cell. The expansion around K = 0 would
cancel: with S / sigma = 1e3, single precision then leaves nothing of d / (2 sigma^2). Sums
over degrees are in double precision, exponentials are not.

A row is a roughness and its cells are values of Ks, as in the paper; or a row is a roughness
and metallic, its cells are base colours, and degree 0 takes part with the diffuse term that
these have: a constant Kd E / pi has the coefficient c_00 = 2 Kd E / sqrt(pi) (Eq. 7).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.brdf.principled import F0
from svu_mi.posterior import streaming

Scaled = list[tuple[list[Any], list[Any]]]  # per group: S_L and S_B over sqrt(2) sigma


@dataclass(frozen=True)
class Constant:
    """Degree 0: sqrt(S_B(0)) = 2 Kd E / sqrt(pi) + R0 a sqrt(S_L(0)).

    Attributes:
        metallic: (M,) nodes.
        irradiance: (T * C) Float, E.
        albedo: (R,) Float64, a: what a lobe of each roughness reflects of constant light.
        sigma: Float64, one number: standard deviation of sqrt(S_B(0)), in radiance.
    """

    metallic: np.ndarray
    irradiance: Any
    albedo: Any
    sigma: Any


@dataclass(frozen=True)
class Problem:
    """Everything an energy depends on, as flat Dr.Jit arrays.

    Attributes:
        incoming, outgoing: (T * (L + 1) * C) Float, power spectra.
        sigma: Float64, one number: standard deviation of a degree's power.
        power: (T,) Float64 nu / 2 of d^(-nu/2), or None for exp(-d / (2 sigma^2)); sigma^2 is
            then the floor that is added to d.
        degree: L = l*.
        channels: C.
        groups: channel indices that share one Ks.
        decay: (R * L) Float64, e_l of each roughness, l = 1 ... L.
        cells: nodes of Ks, or of base colour.
        prior: ((rows,), (rows * cells,)) Float64 of -log prior: of a row, of a cell given it;
            or None.
        constant: degree 0 and the metallic nodes, or None for a grid of Ks.
    """

    incoming: Any
    outgoing: Any
    sigma: Any
    power: Any | None
    degree: int
    channels: int
    groups: tuple[tuple[int, ...], ...]
    decay: Any
    cells: np.ndarray
    prior: tuple[Any, Any] | None
    constant: Constant | None = None

    @property
    def columns(self) -> int:
        """Rows per roughness."""
        return 1 if self.constant is None else len(self.constant.metallic)

    @property
    def rows(self) -> int:
        """Number of rows of the grid."""
        return int(dr.width(self.decay)) // self.degree * self.columns


def entropy(problem: Problem, count: int) -> Any:
    """Return the normalised entropy (T,) of Eq. 5, before unseen texels are set to 1."""
    energies = _row_energies(problem, dr.arange(mi.UInt32, count))
    return streaming.entropy(energies, count, problem.rows, len(problem.cells))


def _row_energies(problem: Problem, texel: Any) -> streaming.RowEnergies:
    # Read once, outside of the loop over rows: strided reads would dominate it.
    spectra, power = _spectra(problem, texel), _power(problem, texel)
    constants = _constants(problem, texel)

    def energies(row: Any) -> list[tuple[Any, list[Any]]]:
        level = row // problem.columns
        decay = [
            dr.gather(mi.Float64, problem.decay, level * problem.degree + l)
            for l in range(problem.degree)
        ]
        result = []
        for (incoming, outgoing), constant in zip(spectra, constants, strict=True):
            metallic = row - level * problem.columns
            R0, first = _cells(problem, level, metallic, constant)
            x = _energies([R * R for R in R0], incoming, outgoing, decay)
            if first is not None:
                x = [value + more for value, more in zip(x, first, strict=True)]
            if power is not None:
                x = [power * dr.log(2 * value + 1) for value in x]
            result.append(x)
        return streaming.with_prior(result, problem.prior, row)

    return energies


def _cells(
    problem: Problem, level: Any, column: Any, read: tuple[Any, Any, Any] | None
) -> tuple[list[Any], list[Any] | None]:
    """R0 of every cell of a row, and what degree 0 adds to its energy."""
    if problem.constant is None or read is None:
        return problem.cells.tolist(), None
    m = mi.Float64(column) / (len(problem.constant.metallic) - 1)
    seen, diffuse, specular = read
    specular = specular * dr.gather(mi.Float64, problem.constant.albedo, level)
    R0 = [dr.fma(c, m, F0 * (1 - m)) for c in problem.cells.tolist()]
    energies = []
    for c, R in zip(problem.cells.tolist(), R0, strict=True):
        residual = seen - (1 - m) * c * diffuse - R * specular
        energies.append(residual * residual)
    return R0, energies


def _constants(problem: Problem, texel: Any) -> list[tuple[Any, Any, Any] | None]:
    """Per group, over sqrt(2) sigma: what is seen, 2 E / sqrt(pi), sqrt(S_L(0))."""
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


def _spectra(problem: Problem, texel: Any) -> Scaled:
    """Read S_L(l), S_B(l) for l >= 1, the channels of a group one after the other."""
    result = []
    scale = math.sqrt(0.5) * dr.rcp(problem.sigma)
    for group in problem.groups:
        index = [
            (texel * (problem.degree + 1) + l) * problem.channels + c
            for c in group
            for l in range(1, problem.degree + 1)
        ]
        incoming, outgoing = (
            [scale * mi.Float64(dr.gather(mi.Float, spectrum, i)) for i in index]
            for spectrum in (problem.incoming, problem.outgoing)
        )
        result.append((incoming, outgoing))
    return result


def _power(problem: Problem, texel: Any) -> Any | None:
    return None if problem.power is None else dr.gather(mi.Float64, problem.power, texel)


def _energies(squares: list, S_L: list, S_B: list, decay: list) -> list[Any]:
    """d of every Ks^2 for one roughness (Eq. 11), in the unit of the scaled spectra."""
    model = [e * s for e, s in zip(decay * (len(S_L) // len(decay)), S_L, strict=True)]
    b, c = mi.Float64(0), mi.Float64(0)
    for m, s in zip(model, S_B, strict=True):
        b, c = dr.fma(m, s, b), dr.fma(m, m, c)
    # Kept inside [0, 1]: around a far-away optimum the grid's own differences would be lost.
    best = dr.select(b < c, b / dr.select(c > 0, c, 1), 1)
    least, slope = mi.Float64(0), mi.Float64(0)
    for m, s in zip(model, S_B, strict=True):
        r = dr.fma(-best, m, s)
        least, slope = dr.fma(r, r, least), dr.fma(m, r, slope)
    offsets = [K - best for K in squares]
    return [dr.fma(dr.fma(c, K, -2 * slope), K, least) for K in offsets]


def tables(problem: Problem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energies of chosen texels, as ``streaming.tables`` does."""
    return streaming.tables(partial(_row_energies, problem), chosen, problem.rows)
