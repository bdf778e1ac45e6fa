"""Objectives of a forecast: entropy of a texel, or variance of its parameters.

Both are means over truths psi_0 of a sum over rows (roughness and metallic), relative to the row of
psi_0. Base colours are integrated in closed form by channel: given a row and a truth of colour c_0,

    E(c) = A x^2 - 2 B x + C,    x = c - c_0,

with sums A of w slope^2, B of w slope rest, C of w rest^2 over the views, in units of 2 s^2 tau;
``rest`` is the difference of radiance at c_0. Entropies are those of a grid's cell masses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.posterior.row_entropy import nats
from svu_mi.posterior.truncated_normal import ChannelLikelihood, ColorIntegrals

UNLIKELY = 1e4  # -log of what a prior excludes: a number that float32 still adds to
FAR = 60.0  # exp(-FAR) adds nothing to the sum over cells, of which one is about exp(0)


class ColorMarginal(NamedTuple):
    """Sums over the base colours of a row, for C channels.

    Attributes:
        weight: Float, sum of exp(-energy).
        entropy: Float, nats, of a channel's cells given the row; mean over channels.
    """

    weight: Any
    entropy: Any
    mean: list[Any]
    variance: list[Any]


def color_marginal(energies: list[Any]) -> ColorMarginal:
    """Sum over cells of a row, which have energies above 0, the smallest near it."""
    p = [dr.exp(-x) for x in energies]
    z = sum(p)
    zx = sum(a * x for a, x in zip(p, energies, strict=True))
    return ColorMarginal(z, nats(z, zx), [], [])


class Measure(Protocol):
    """Uncertainty of a texel, from sums over the rows of its grid."""

    @property
    def unseen(self) -> float:
        """Value of a texel that no view sees."""

    def start(self) -> list[Any]:
        """Sums of no row."""

    def add(self, sums: list[Any], row: ColorMarginal, shared: tuple[Any, ...]) -> list[Any]:
        """Add a row; ``shared`` are its roughness and the parameters that mix, Floats."""

    def value(self, sums: list[Any]) -> Any:
        """The number."""


@dataclass(frozen=True)
class EntropyMeasure:
    """Normalised entropy of Eq. 5, by the chain rule: of rows, and of colours given these.

    Attributes:
        max_entropy: nats of entropy 1: log n of n cells, or the prior's.
        unseen: entropy of the prior, in these units.
    """

    max_entropy: float
    unseen: float = 1.0

    def start(self) -> list[Any]:
        """Z, and the sum of w (H - log w) over rows of weight w."""
        return [mi.Float(0), mi.Float(0)]

    def add(self, sums: list[Any], row: ColorMarginal, shared: tuple[Any, ...]) -> list[Any]:
        """Add a row, whatever its parameters."""
        del shared
        z, zx = sums
        w = row.weight
        return [z + w, dr.fma(w, row.entropy - dr.log(dr.maximum(w, 1e-37)), zx)]

    def value(self, sums: list[Any]) -> Any:
        """H."""
        z, zx = sums
        return (dr.log(z) + zx / z) * dr.opaque(mi.Float, 1 / self.max_entropy)


@dataclass(frozen=True)
class VarianceMeasure:
    """Sum of the parameters' variances, each relative to its present one: expected squared error.

    Attributes:
        present: present variance of each axis, mean over texels, base colour last.
        prior: their variance under the prior.
    """

    present: tuple[float, ...]
    prior: tuple[float, ...]
    channels: int

    @property
    def unseen(self) -> float:
        """The variance of the prior."""
        return sum(p / v for p, v in zip(self.prior, self.present, strict=True))

    def start(self) -> list[Any]:
        """Z, and the sums of w x and w x^2 for all shared parameters and the colour of channels."""
        return [mi.Float(0) for _ in range(1 + 2 * (len(self.present) - 1 + self.channels))]

    def add(self, sums: list[Any], row: ColorMarginal, shared: tuple[Any, ...]) -> list[Any]:
        """Add a row."""
        zero = mi.Float(0)
        values = [*((x, zero) for x in shared), *zip(row.mean, row.variance, strict=True)]
        added = [x for mean, spread in values for x in (mean, dr.fma(mean, mean, spread))]
        z, *moments = sums
        moments = [dr.fma(row.weight, x, old) for x, old in zip(added, moments, strict=True)]
        return [z + row.weight, *moments]

    def value(self, sums: list[Any]) -> Any:
        """Sum of the variances over ``present``."""
        _, *moments = (x / sums[0] for x in sums)
        *units, color = self.present
        total = mi.Float(0)
        units += [self.channels * color] * self.channels
        for mean, square, unit in zip(moments[::2], moments[1::2], units, strict=True):
            total = dr.fma(square - dr.square(mean), dr.opaque(mi.Float, 1 / unit), total)
        return total


ChannelFields = tuple[Any, Any, Any, Any]
"""A ``ChannelLikelihood``, as what Dr.Jit can carry through a branch."""


def _channel(A: Any, B: Any, C: Any, truth: Any) -> ChannelLikelihood:
    """Complete the square: E = A (c - mu)^2 + C - B^2 / A."""
    A = dr.maximum(A, 1e-20)
    shift = B / A
    a = dr.sqrt(2 * A)
    return ChannelLikelihood.of([a], [-a * (truth + shift)], 2 * dr.maximum(C - B * shift, 0))


@dataclass(frozen=True)
class Colors:
    """Grid of the base colours of a row.

    Attributes:
        edges: (K + 1,) of the cells; two equal ones if the colour is known.
        given: (rows * K,) Float, density of a colour in a cell given its row, or None.
        nodes: (K,), if colours are discrete.
    """

    edges: np.ndarray
    copies: int
    given: Any | None
    nodes: np.ndarray | None = None

    def channels(self, sums: list[Any], truth: list[Any]) -> tuple[Any, list[ChannelFields]]:
        """Return the energy of the best colours, Float, and each channel's likelihood."""
        if self.edges[0] == self.edges[-1]:  # known: the truth has that colour, too
            return self.copies * sum(sums[2::3]), []
        thirds = zip(sums[::3], sums[1::3], sums[2::3], truth, strict=True)
        likelihoods = [_channel(*one) for one in thirds]
        parts = [(one.min_energy, one.mirrored, one.mu, one.s) for one in likelihoods]
        return self.copies * sum(one.min_energy for one in likelihoods), parts

    def row(self, energy: Any, channels: list[ChannelFields], place: Any) -> ColorMarginal:
        """Integrate over all colours of row ``place``, whose best ones have an energy."""
        weight = dr.exp(-energy)
        if not channels:
            c = dr.opaque(mi.Float, float(self.edges[0]))
            return ColorMarginal(weight, mi.Float(0), [c], [mi.Float(0)])
        integrals = [self._integrate(ChannelLikelihood(*one), place) for one in channels]
        for mass, *_ in integrals:
            for _ in range(self.copies):
                weight *= mass
        _, entropies, means, variances = zip(*integrals, strict=True)
        return ColorMarginal(weight, sum(entropies) / len(integrals), list(means), list(variances))

    def _integrate(self, channel: ChannelLikelihood, place: Any) -> tuple[Any, Any, Any, Any]:
        """Mass, entropy of cells, mean and variance of a channel's colour."""
        edges, K = self.edges.tolist(), len(self.edges) - 1
        density = None
        if self.given is not None:
            density = [dr.gather(mi.Float, self.given, place * K + k) for k in range(K)]
        if self.nodes is not None:
            integrals = _sum_over_nodes(channel, self.nodes.tolist(), density or [1.0] * K)
            mass = integrals.mass
        elif density is None:
            # Mean and variance in double precision, which is left out where nobody asks for them.
            integrals = channel.integrate(edges)
            mass, bins = channel.integrate_masses(edges)
            integrals = replace(integrals, mass=mass, bins=bins)
        else:
            log_mass, integrals = channel.integrate_with_prior(edges, density)
            mass = dr.exp(log_mass)
        nats = -sum(p * dr.log(dr.maximum(p, 1e-30)) for p in integrals.bins)
        return mass, nats, integrals.mean, integrals.variance


def _sum_over_nodes(
    channel: ChannelLikelihood, nodes: list[float], density: list[Any]
) -> ColorIntegrals:
    """Sum over some colours alone, where ``ChannelLikelihood.integrate`` takes all."""
    best = dr.maximum(channel.mu, 0)
    p = []
    for node, prior in zip(nodes, density, strict=True):
        y = dr.select(channel.mirrored, 1 - node, node)
        worse = dr.square(channel.s) * (y - best) * (y + best - 2 * channel.mu)
        p.append(prior * dr.exp(-worse))
    mass = dr.maximum(sum(p), 1e-37)
    bins = [x / mass for x in p]
    mean = sum(x * node for x, node in zip(bins, nodes, strict=True))
    variance = sum(x * dr.square(node - mean) for x, node in zip(bins, nodes, strict=True))
    return ColorIntegrals(mass, bins, mean, variance)


def prior_tables(prior: np.ndarray, usual: np.ndarray) -> tuple[Any, Any | None]:
    """Return -log prior of rows, (R * M,) Float, and colour densities relative to ``usual``.

    ``prior`` is (R, M, K), of sum 1; densities are (R * M * K,) Float, None if all are 1.
    """
    table = prior.reshape(-1, prior.shape[-1]).astype(np.float64)
    rows = table.sum(axis=1, keepdims=True)
    given = np.where(rows > 0, table / np.where(rows > 0, rows, 1), usual) / usual
    with np.errstate(divide="ignore"):
        energies = np.minimum(-np.log(rows.ravel()), UNLIKELY)
    given = None if np.allclose(given, 1) else to_drjit(mi.Float, given.ravel())
    return to_drjit(mi.Float, energies), given
