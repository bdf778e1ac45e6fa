"""What the base colours of a row sum to: integrated in closed form, channel by channel.

Given a roughness and a metallic, radiance is linear in base colour, so what photographs of a
truth of colour c_0 differ by from those of another colour is quadratic:

    E(c) = A x^2 - 2 B x + C,    x = c - c_0,

with sums A of w slope^2, B of w slope rest, C of w rest^2 over the views, in units of 2 s^2 tau;
``rest`` is the difference of radiance at c_0. Entropies are those of the masses of a grid's cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.guidance.measures import Row
from svu_mi.interop import owned
from svu_mi.posterior.truncated import Channel, Integrals

UNLIKELY = 1e4  # -log of what a prior excludes: a number that float32 still adds to


Parts = tuple[Any, Any, Any, Any]
"""A ``Channel``, as what Dr.Jit can carry through a branch."""


def _channel(A: Any, B: Any, C: Any, truth: Any) -> Channel:
    """Complete the square: E = A (c - mu)^2 + C - B^2 / A."""
    A = dr.maximum(A, 1e-20)
    shift = B / A
    a = dr.sqrt(2 * A)
    return Channel.of([a], [-a * (truth + shift)], 2 * dr.maximum(C - B * shift, 0))


@dataclass(frozen=True)
class Colors:
    """How colours of a row are summed.

    Attributes:
        edges: (K + 1,) of the cells; two equal ones if the colour is known.
        copies: how many equal channels each stands for.
        given: (rows * K,) Float, density of a colour in a cell given its row, or None.
        nodes: (K,), if these are the only colours there are.
    """

    edges: np.ndarray
    copies: int
    given: Any | None
    nodes: np.ndarray | None = None

    def channels(self, sums: list[Any], truth: list[Any]) -> tuple[Any, list[Parts]]:
        """Return the energy of the best colours, Float, and each channel's likelihood.

        Args:
            sums: A, B, C of every channel.
            truth: c_0 of every channel.
        """
        if self.edges[0] == self.edges[-1]:  # known: the truth has that colour, too
            return self.copies * sum(sums[2::3]), []
        thirds = zip(sums[::3], sums[1::3], sums[2::3], truth, strict=True)
        found = [_channel(*one) for one in thirds]
        parts = [(one.least, one.mirrored, one.mu, one.s) for one in found]
        return self.copies * sum(one.least for one in found), parts

    def row(self, energy: Any, channels: list[Parts], place: Any) -> Row:
        """Integrate over all colours of row ``place``, whose best ones have an energy."""
        weight = dr.exp(-energy)
        if not channels:
            c = dr.opaque(mi.Float, float(self.edges[0]))
            return Row(weight, mi.Float(0), [c], [mi.Float(0)])
        found = [self._integrate(Channel(*one), place) for one in channels]
        for mass, *_ in found:
            for _ in range(self.copies):
                weight *= mass
        _, entropies, means, variances = zip(*found, strict=True)
        return Row(weight, sum(entropies) / len(found), list(means), list(variances))

    def _integrate(self, channel: Channel, place: Any) -> tuple[Any, Any, Any, Any]:
        """Mass, entropy of cells, mean and variance of a channel's colour."""
        edges, K = self.edges.tolist(), len(self.edges) - 1
        density = None
        if self.given is not None:
            density = [dr.gather(mi.Float, self.given, place * K + k) for k in range(K)]
        if self.nodes is not None:
            found = _sum(channel, self.nodes.tolist(), density or [1.0] * K)
            mass = found.mass
        elif density is None:
            # Mean and variance in double precision, which is left out where nobody asks for them.
            found = channel.integrate(edges)
            mass, cells = channel.masses(edges)
            found = replace(found, mass=mass, cells=cells)
        else:
            log_mass, found = channel.under(edges, density)
            mass = dr.exp(log_mass)
        nats = -sum(p * dr.log(dr.maximum(p, 1e-30)) for p in found.cells)
        return mass, nats, found.mean, found.variance


def _sum(channel: Channel, nodes: list[float], density: list[Any]) -> Integrals:
    """Sum over some colours alone, where ``Channel.integrate`` takes all."""
    best = dr.maximum(channel.mu, 0)
    p = []
    for node, prior in zip(nodes, density, strict=True):
        y = dr.select(channel.mirrored, 1 - node, node)
        worse = dr.square(channel.s) * (y - best) * (y + best - 2 * channel.mu)
        p.append(prior * dr.exp(-worse))
    mass = dr.maximum(sum(p), 1e-37)
    cells = [x / mass for x in p]
    mean = sum(x * node for x, node in zip(cells, nodes, strict=True))
    variance = sum(x * dr.square(node - mean) for x, node in zip(cells, nodes, strict=True))
    return Integrals(mass, cells, mean, variance)


def prior_tables(prior: np.ndarray, usual: np.ndarray) -> tuple[Any, Any | None]:
    """Split the prior of cells.

    Args:
        prior: (R, M, K), of sum 1.
        usual: (K,) the prior of a colour given its row, where nothing is said about it.

    Returns:
        -log of the prior of rows, (R * M,) Float; and how many times as likely as usual a colour
        is given its row, (R * M * K,) Float, None if it is not.
    """
    table = prior.reshape(-1, prior.shape[-1]).astype(np.float64)
    rows = table.sum(axis=1, keepdims=True)
    given = np.where(rows > 0, table / np.where(rows > 0, rows, 1), usual) / usual
    with np.errstate(divide="ignore"):
        energies = np.minimum(-np.log(rows.ravel()), UNLIKELY)
    given = None if np.allclose(given, 1) else owned(mi.Float, given.ravel())
    return owned(mi.Float, energies), given
