"""Objectives of a forecast: entropy of a texel, or variance of its parameters.

Each is a mean over truths psi_0 of a sum over rows (roughness and metallic), with energies relative
to the row of psi_0. Base colours c are integrated in closed form per channel, for a truth c_0:

    E(c) = A x^2 - 2 B x + C,    x = c - c_0,

where A, B and C are sums over the views, divided by 2 s^2 tau: A of w a^2, B of w a b and C of
w b^2. The radiance of the row is linear in c with slope a; b is its residual at c = c_0. Entropies
are computed from the grid's cell masses.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.posterior.row_entropy import nats
from svu_mi.posterior.truncated_normal import FULL_SUPPORT, ChannelLikelihood, ColorIntegrals

UNLIKELY = 1e4  # -log prior of excluded cells; finite, so that float32 sums stay finite
FAR = 60.0  # exp(-FAR) is negligible in a sum over cells whose largest term is about 1


class ColorMarginal(NamedTuple):
    """Integrals over the base colours of a row, for C channels; lists have C Floats.

    Attributes:
        weight: Float, sum of exp(-energy).
        entropy: Float, entropy of the colour cells given the row in nats, mean over channels.
    """

    weight: Any
    entropy: Any
    mean: list[Any]
    variance: list[Any]


def color_marginal(energies: list[Any]) -> ColorMarginal:
    """Sum over the cells of a row, given their energies >= 0 (the smallest is about 0)."""
    p = [dr.exp(-x) for x in energies]
    z = sum(p)
    zx = sum(a * x for a, x in zip(p, energies, strict=True))
    return ColorMarginal(z, nats(z, zx), [], [])


class Measure(Protocol):
    """Uncertainty of a texel, accumulated over the rows of its grid."""

    @property
    def unseen(self) -> float:
        """Measure of a texel that no view sees."""

    def start(self) -> list[Any]:
        """Return the sums before the first row is added."""

    def add(self, sums: list[Any], row: ColorMarginal, shared: tuple[Any, ...]) -> list[Any]:
        """Add a row; ``shared`` contains roughness and the mixing parameters, as Floats."""

    def value(self, sums: list[Any]) -> Any:
        """Return the measure after all rows are added."""


@dataclass(frozen=True)
class EntropyMeasure:
    """Normalised entropy (Eq. 5) by the chain rule: entropy of rows + of colours given the row.

    Attributes:
        max_entropy: Entropy in nats that is scaled to 1: log n for n cells, or the prior's.
        unseen: Entropy of the prior, in this unit.
    """

    max_entropy: float
    unseen: float = 1.0

    def start(self) -> list[Any]:
        """Return zeros for the sums of w and of w (H - log w) over rows of weight w."""
        return [mi.Float(0), mi.Float(0)]

    def add(self, sums: list[Any], row: ColorMarginal, shared: tuple[Any, ...]) -> list[Any]:
        """Add a row; its parameters are ignored."""
        del shared
        z, zx = sums
        w = row.weight
        return [z + w, dr.fma(w, row.entropy - dr.log(dr.maximum(w, 1e-37)), zx)]

    def value(self, sums: list[Any]) -> Any:
        """Return H."""
        z, zx = sums
        return (dr.log(z) + zx / z) * dr.opaque(mi.Float, 1 / self.max_entropy)


@dataclass(frozen=True)
class VarianceMeasure:
    """Sum of the parameters' variances, each relative to its present mean variance.

    Attributes:
        present: Present variance of each axis, mean over texels, base colour last.
        prior: Variance of each axis under the prior.
    """

    present: tuple[float, ...]
    prior: tuple[float, ...]
    channels: int

    @property
    def unseen(self) -> float:
        """Relative variance of the prior, summed over parameters."""
        return sum(p / v for p, v in zip(self.prior, self.present, strict=True))

    def start(self) -> list[Any]:
        """Return zeros for the sums of w, and of w x and w x^2 per parameter or channel x."""
        return [mi.Float(0) for _ in range(1 + 2 * (len(self.present) - 1 + self.channels))]

    def add(self, sums: list[Any], row: ColorMarginal, shared: tuple[Any, ...]) -> list[Any]:
        """Add weighted first and second moments of a row."""
        zero = mi.Float(0)
        values = [*((x, zero) for x in shared), *zip(row.mean, row.variance, strict=True)]
        added = [x for mean, spread in values for x in (mean, dr.fma(mean, mean, spread))]
        z, *moments = sums
        moments = [dr.fma(row.weight, x, old) for x, old in zip(added, moments, strict=True)]
        return [z + row.weight, *moments]

    def value(self, sums: list[Any]) -> Any:
        """Return the sum of variances relative to ``present``."""
        _, *moments = (x / sums[0] for x in sums)
        *units, color = self.present
        total = mi.Float(0)
        units += [self.channels * color] * self.channels
        for mean, square, unit in zip(moments[::2], moments[1::2], units, strict=True):
            total = dr.fma(square - dr.square(mean), dr.opaque(mi.Float, 1 / unit), total)
        return total


ChannelFields = tuple[Any, Any, Any, Any]
"""Fields of a ``ChannelLikelihood`` as a tuple, which Dr.Jit accepts in branches."""


def _channel(A: Any, B: Any, C: Any, truth: Any) -> ChannelLikelihood:
    """Complete the square: E = A (c - mu)^2 + C - B^2 / A."""
    A = dr.maximum(A, 1e-20)
    shift = B / A
    a = dr.sqrt(2 * A)
    return ChannelLikelihood.of([a], [-a * (truth + shift)], 2 * dr.maximum(C - B * shift, 0))


@dataclass(frozen=True)
class Colors:
    """Grid of the base colour within a row.

    Attributes:
        edges: (K + 1,) cell edges; two equal edges if the colour is known.
        copies: Number of equal colour channels that each computed channel represents.
        given: (rows * K,), relative density of a colour cell given its row; None: uniform.
        nodes: (K,) colours if they are discrete, else None.
    """

    edges: np.ndarray
    copies: int
    given: np.ndarray | None
    nodes: np.ndarray | None = None

    def channels(self, sums: list[Any], truth: list[Any]) -> tuple[Any, list[ChannelFields]]:
        """Return the energy of the best colours, Float, and ``ChannelFields`` by channel."""
        if self.edges[0] == self.edges[-1]:  # known colour, equal to the truth's
            return self.copies * sum(sums[2::3]), []
        thirds = zip(sums[::3], sums[1::3], sums[2::3], truth, strict=True)
        likelihoods = [_channel(*one) for one in thirds]
        parts = [(one.min_energy, one.mirrored, one.mu, one.s) for one in likelihoods]
        return self.copies * sum(one.min_energy for one in likelihoods), parts

    def row(self, energy: Any, channels: list[ChannelFields], place: Any) -> ColorMarginal:
        """Integrate over the colours of row ``place``; ``energy`` is the least one in the row."""
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
        """Return mass, entropy of cells, mean and variance of a channel's colour."""
        edges, K = self.edges.tolist(), len(self.edges) - 1
        density, certain = None, True
        if self.given is not None:
            given, certain = to_drjit(mi.Float, self.given), bool(self.given.min() > FULL_SUPPORT)
            density = [dr.gather(mi.Float, given, place * K + k) for k in range(K)]
        if self.nodes is not None:
            integrals = _sum_over_nodes(channel, self.nodes.tolist(), density or [1.0] * K)
        else:
            integrals = channel.integrate(edges, density, certain)
        mass = integrals.mass * dr.exp(integrals.log_scale)
        nats = -sum(p * dr.log(dr.maximum(p, 1e-30)) for p in integrals.bins)
        return mass, nats, integrals.mean, integrals.variance


def _sum_over_nodes(
    channel: ChannelLikelihood, nodes: list[float], density: list[Any]
) -> ColorIntegrals:
    """Sum over discrete colours, in place of ``ChannelLikelihood.integrate``."""
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


def prior_tables(prior: np.ndarray, usual: np.ndarray) -> tuple[Any, np.ndarray | None]:
    """Return -log prior of rows, (R * M,) Float, and colour densities divided by ``usual``.

    ``prior`` is (R, M, K) and sums to 1. Densities are (R * M * K,), or None if all are 1.
    """
    table = prior.reshape(-1, prior.shape[-1]).astype(np.float64)
    rows = table.sum(axis=1, keepdims=True)
    given = np.where(rows > 0, table / np.where(rows > 0, rows, 1), usual) / usual
    with np.errstate(divide="ignore"):
        energies = np.minimum(-np.log(rows.ravel()), UNLIKELY)
    return to_drjit(mi.Float, energies), None if np.allclose(given, 1) else given.ravel()
