"""The posterior of Eq. 11 in one kernel: energies of grid cells, and their entropy.

For one roughness, the distance of Eq. 11 is a quadratic in K = Ks^2. Around the best K_0 in
[0, 1], with the model m_l = e_l S_L(l) and the residual r = S_B - K_0 m,

    d(K) = sum r^2 - 2 (K - K_0) sum m r + (K - K_0)^2 sum m^2,

so the degrees are summed once per roughness, not once per cell. The expansion around K = 0
would cancel: with S / sigma = 1e3, single precision then leaves nothing of d / (2 sigma^2).
Sums over degrees are in double precision, exponentials are not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.posterior import streaming

Scaled = list[tuple[list[Any], list[Any]]]  # per group: S_L and S_B over sqrt(2) sigma


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
        specular: (S,) nodes of Ks.
        prior: ((R,), (R * S,)) Float64 of -log prior: of a roughness, of Ks given it; or None.
    """

    incoming: Any
    outgoing: Any
    sigma: Any
    power: Any | None
    degree: int
    channels: int
    groups: tuple[tuple[int, ...], ...]
    decay: Any
    specular: np.ndarray
    prior: tuple[Any, Any] | None

    @property
    def rows(self) -> int:
        """Number of roughness nodes R."""
        return int(dr.width(self.decay)) // self.degree


def entropy(problem: Problem, count: int) -> Any:
    """Return the normalised entropy (T,) of Eq. 5, before unseen texels are set to 1."""
    texel = dr.arange(mi.UInt32, count)
    # Read once, outside of the loop: strided reads would dominate it.
    spectra, power = _spectra(problem, texel), _power(problem, texel)

    def energies(row: Any) -> list[tuple[Any, list[Any]]]:
        groups = _row_energies(problem, spectra, power, row)
        if problem.prior is not None:
            low, offsets = groups[0]
            groups[0] = (low + dr.gather(mi.Float64, problem.prior[0], row), offsets)
        return groups

    return streaming.entropy(energies, count, problem.rows, len(problem.specular))


def _row_energies(
    problem: Problem, spectra: Scaled, power: Any, row: Any
) -> list[tuple[Any, list[Any]]]:
    """Return, per group, the smallest energy of a roughness and the others' distance to it."""
    decay = [
        dr.gather(mi.Float64, problem.decay, row * problem.degree + l)
        for l in range(problem.degree)
    ]
    result = []
    for incoming, outgoing in spectra:
        energies = _energies(problem.specular, incoming, outgoing, decay)
        if power is not None:
            energies = [power * dr.log(2 * x + 1) for x in energies]
        if problem.prior is not None:
            energies = [
                x + dr.gather(mi.Float64, problem.prior[1], row * len(energies) + s)
                for s, x in enumerate(energies)
            ]
        result.append(streaming.above_smallest(energies))
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


def _energies(specular: np.ndarray, S_L: list, S_B: list, decay: list) -> list[Any]:
    """d of every Ks for one roughness (Eq. 11), in the unit of the scaled spectra."""
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
    offsets = [float(K) - best for K in specular**2]
    return [dr.fma(dr.fma(c, K, -2 * slope), K, least) for K in offsets]


def tables(problem: Problem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energies of t chosen texels, for everything that is not the hot path.

    Returns:
        (T, R) float64: the smallest energy of each roughness, relative to the texel's
        smallest; (T, R, G, S) float32: energies of each Ks relative to that, per group.
    """
    rows, groups, nodes = problem.rows, len(problem.groups), len(problem.specular)
    count = len(chosen)
    lane = dr.arange(mi.UInt32, count * rows)
    row = lane % rows
    texel = dr.gather(mi.UInt32, owned(mi.UInt32, chosen), lane // rows)
    base, columns = mi.Float64(0), []
    for low, offsets in _row_energies(
        problem, _spectra(problem, texel), _power(problem, texel), row
    ):
        base = base + low
        columns += offsets
    if problem.prior is not None:
        base += dr.gather(mi.Float64, problem.prior[0], row)
    dr.eval(base, columns)
    smallest = np.broadcast_to(base.numpy(), count * rows).reshape(count, rows)
    offsets_table = np.stack([np.broadcast_to(c.numpy(), count * rows) for c in columns], axis=-1)
    return (
        smallest - smallest.min(axis=1, keepdims=True),
        offsets_table.reshape(count, rows, groups, nodes),
    )
