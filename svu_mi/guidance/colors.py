"""What the base colours of a row sum to: integrated in closed form, or over nodes of a grid.

Given a roughness and a metallic, radiance is linear in base colour, so what photographs of a
truth of colour c_0 differ by from those of another colour is quadratic, channel by channel:

    E(c) = A x^2 - 2 B x + C,    x = c - c_0,

with sums A of w slope^2, B of w slope rest, C of w rest^2 over the views, in units of 2 s^2 tau;
``rest`` is the difference of radiance at c_0.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt
from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.guidance.measures import FAR, Row, row_of
from svu_mi.interop import owned
from svu_mi.posterior.angular import AngularPosterior
from svu_mi.posterior.calibrated import CalibratedPosterior
from svu_mi.posterior.streaming import entropy_of
from svu_mi.posterior.truncated import Channel, erfcx

UNLIKELY = 1e4  # -log of what a prior excludes: a number that float32 still adds to


class Form(NamedTuple):
    """Energies of one channel's base colour: Floats A, B, C and c_0."""

    A: Any
    B: Any
    C: Any
    truth: Any

    def at(self, color: Any) -> Any:
        """E of a colour."""
        x = color - self.truth
        return dr.fma(x, dr.fma(x, self.A, -2 * self.B), self.C)


class Colors(Protocol):
    """A rule by which the colours of a row are summed."""

    def truths(self, p: np.ndarray) -> np.ndarray:
        """Return the colour that stands for all of a row, if that is the truth: (t, rows, C).

        Args:
            p: (t, rows, K, C) probabilities of cells.
        """

    def bound(self, forms: list[Form], place: Any) -> tuple[Any, list[Any]]:
        """Return what no colour of row ``place`` is below, Float, and what ``row`` needs."""

    def row(self, energy: Any, parts: list[Any]) -> Row:
        """Sum up; ``energy`` is that bound, with the prior of the row added."""


@dataclass(frozen=True)
class Nodes:
    """Colours at the nodes of a grid, in grey.

    Attributes:
        nodes: (K,) float64.
        given: (rows * K,) Float, -log of the prior of a colour given its row; None if all alike.
    """

    nodes: np.ndarray
    given: Any | None

    def truths(self, p: np.ndarray) -> np.ndarray:
        """The most probable node: between nodes, none might explain what it shows."""
        return self.nodes[p.argmax(axis=2)]

    def bound(self, forms: list[Form], place: Any) -> tuple[Any, list[Any]]:
        """The smallest energy of a node, and all of them relative to it."""
        (form,), count = forms, len(self.nodes)
        energies = [form.at(dr.opaque(mi.Float, node)) for node in self.nodes.tolist()]
        if self.given is not None:
            energies = [
                x + dr.gather(mi.Float, self.given, place * count + j)
                for j, x in enumerate(energies)
            ]
        low = energies[0]
        for x in energies[1:]:
            low = dr.minimum(low, x)
        return low, [dr.minimum(x - low, FAR) for x in energies]

    def row(self, energy: Any, parts: list[Any]) -> Row:
        """Sum over the nodes."""
        p = [dr.exp(-x) for x in parts]
        found = row_of(parts)
        nodes = [dr.opaque(mi.Float, node) for node in self.nodes.tolist()]
        scale = dr.rcp(found.weight)
        mean = scale * sum(a * c for a, c in zip(p, nodes, strict=True))
        square = scale * sum(a * c * c for a, c in zip(p, nodes, strict=True))
        return Row(dr.exp(-energy) * found.weight, found.entropy, [mean],
                   [dr.maximum(square - dr.square(mean), 0)])  # fmt: skip


@dataclass(frozen=True)
class Integrated:
    """All colours, in closed form, channel by channel; entropies are of the masses of cells.

    Attributes:
        edges: (K + 1,) of the cells; two equal ones if the colour is known.
        copies: how many equal channels each stands for.
        given: (rows * K,) Float, density of a colour in a cell given its row, or None.
    """

    edges: np.ndarray
    copies: int
    given: Any | None

    def truths(self, p: np.ndarray) -> np.ndarray:
        """The mean."""
        middle = (self.edges[1:] + self.edges[:-1]) / 2
        return np.einsum("trkc,k->trc", p, middle) / np.maximum(p.sum(axis=2), 1e-30)

    @property
    def _known(self) -> bool:
        return bool(self.edges[0] == self.edges[-1])

    def bound(self, forms: list[Form], place: Any) -> tuple[Any, list[Any]]:
        """The energy of the best colours, and each channel's likelihood."""
        if self._known:  # the truth has that colour, too
            return self.copies * sum(form.C for form in forms), []
        channels = [_channel(form) for form in forms]
        parts = [(one.least, one.mirrored, one.mu, one.s) for one in channels]
        return self.copies * sum(one.least for one in channels), [place, parts]

    def row(self, energy: Any, parts: list[Any]) -> Row:
        """Integrate every channel."""
        weight = dr.exp(-energy)
        if not parts:
            c = dr.opaque(mi.Float, float(self.edges[0]))
            return Row(weight, mi.Float(0), [c], [mi.Float(0)])
        place, channels = parts
        found = [self._integrate(Channel(*one), place) for one in channels]
        for mass, *_ in found:
            for _ in range(self.copies):
                weight *= mass
        _, entropies, means, variances = zip(*found, strict=True)
        return Row(weight, sum(entropies) / len(found), list(means), list(variances))

    def _integrate(self, channel: Channel, place: Any) -> tuple[Any, Any, Any, Any]:
        """Mass, entropy, mean and variance of a channel's colour."""
        K = len(self.edges) - 1
        if self.given is None:
            mass, nats, mean, variance = _moments(channel)
            return mass, entropy_of_cells(nats, K), mean, variance
        density = [dr.gather(mi.Float, self.given, place * K + k) for k in range(K)]
        log_mass, found = channel.under(self.edges.tolist(), density)
        entropy = -sum(p * dr.log(dr.maximum(p, 1e-30)) for p in found.cells)
        return dr.exp(log_mass), entropy, found.mean, found.variance


def entropy_of_cells(nats: Any, cells: int) -> Any:
    """Return what the entropy of the masses of cells of a colour is, on average.

    Cells are as wide as nodes are apart, 1 / (K - 1). Of a density that spreads over
    t = (K - 1) exp(nats) of them it is about log t, and where t is small about t / 4, the chance
    to lie across a border; in between a fit, whose error is 0.02 for K from 4 to 16.

    Args:
        nats: differential entropy of the colour on [0, 1].
        cells: K.
    """
    t = (cells - 1) * dr.exp(nats)
    return 0.5 * dr.log(1 + t * (0.5 + 1.07 * t))


def _channel(form: Form) -> Channel:
    """Complete the square: E = A (c - mu)^2 + C - B^2 / A."""
    A = dr.maximum(form.A, 1e-20)
    shift = form.B / A
    a = dr.sqrt(2 * A)
    floor = dr.maximum(form.C - form.B * shift, 0)
    return Channel.of([a], [-a * (form.truth + shift)], 2 * floor)


def _moments(channel: Channel) -> tuple[Any, Any, Any, Any]:
    """Mass, differential entropy, mean and variance of a channel's colour, in single precision.

    With x = (y - mu) s, exp(-(E - least)) is exp(x_0^2 - x^2), x_0 where it is 1.
    """
    s, mu = channel.s, channel.mu
    x_0 = dr.maximum(-mu, 0) * s
    (below, at_0), (beyond, at_1) = (_tail((y - mu) * s, x_0) for y in (0, 1))
    whole = below - beyond
    scale = dr.rcp(sqrt(pi) * s * whole)
    offset = scale * (at_0 - at_1)
    around = 0.5 / dr.square(s) - scale * dr.fma(mu, at_0, (1 - mu) * at_1)
    mass = 0.5 * sqrt(pi) * whole / s
    excess = dr.clip(dr.square(s) * around - dr.square(x_0), 0, 1)  # mean of E - least
    mean = dr.clip(mu + offset, 0, 1)
    variance = dr.clip(around - dr.square(offset), 0, 0.25)
    return mass, dr.log(mass) + excess, dr.select(channel.mirrored, 1 - mean, mean), variance


def _tail(x: Any, x_0: Any) -> tuple[Any, Any]:
    """2 / sqrt(pi) times the integral of exp(x_0^2 - x^2) from x on, and the density at x."""
    density = dr.exp((x_0 - x) * (x_0 + x))
    outward = density * erfcx(dr.abs(x))
    return dr.select(x < 0, 2 - outward, outward), density


def colors_of(
    posterior: AngularPosterior | CalibratedPosterior,
) -> tuple[Nodes | Integrated, Any, float]:
    """Return the rule of a posterior, -log of the prior of its rows, (R * M,) Float, and the
    entropy that its own is relative to, in nats."""
    prior, nodes = posterior.prior, posterior.axes["base_color"]
    if isinstance(posterior, AngularPosterior):
        rows, given = prior_tables(prior, np.full(len(nodes), 1 / len(nodes)))
        if given is not None:
            with np.errstate(divide="ignore"):
                given = np.minimum(-np.log(given), UNLIKELY)
        return Nodes(nodes, _floats(given)), rows, float(np.log(prior.size))
    edges, copies = posterior.problem.edges, posterior.problem.copies
    rows, given = prior_tables(prior, np.diff(edges) if len(edges) > 2 else np.ones(1))
    return Integrated(edges, copies, _floats(given)), rows, max(entropy_of(prior), 1e-6)


def _floats(values: np.ndarray | None) -> Any | None:
    return None if values is None else owned(mi.Float, values)


def prior_tables(prior: np.ndarray, usual: np.ndarray) -> tuple[Any, np.ndarray | None]:
    """Split the prior of cells.

    Args:
        prior: (R, M, K), of sum 1.
        usual: (K,) the prior of a colour given its row, where nothing is said about it.

    Returns:
        -log of the prior of rows, (R * M,) Float; and how many times as likely as usual a colour
        is given its row, (R * M * K,) float64, None if it is not.
    """
    table = prior.reshape(-1, prior.shape[-1]).astype(np.float64)
    rows = table.sum(axis=1, keepdims=True)
    given = np.where(rows > 0, table / np.where(rows > 0, rows, 1), usual) / usual
    with np.errstate(divide="ignore"):
        energies = np.minimum(-np.log(rows.ravel()), UNLIKELY)
    return owned(mi.Float, energies), None if np.allclose(given, 1) else given.ravel()
