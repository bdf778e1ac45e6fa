"""What one channel of a base colour may be, in closed form: a normal distribution on [0, 1].

For a given roughness and metallic the energy of a channel is quadratic in its base colour c,

    E(c) = 1/2 |c u + v|^2 = 1/2 (A c^2 + 2 B c + |v|^2),

so its probability is a normal distribution of mean mu = -B / A and variance 1 / A, cut off at 0
and 1. Everything is relative to the best colour in that range, and mirrored so that mu is not
above 1/2: then nothing but tails are subtracted, however far outside mu is.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt
from typing import Any

import drjit as dr
import mitsuba as mi

FLATTEST = 1e-3  # A: a channel that hardly anything lights; energies change by less than this
HALVINGS = 24  # of [0, 1], in a search
TINIEST = 1e-290  # a cell of no probability has no mean of its own
FARTHEST = 64.0  # |mu|: photographs so many times brighter than any base colour makes them

# (1 + 2 x) erfcx(x) as a polynomial in (x - 2.5) / (x + 2.5), the variable of Shepherd and
# Laframboise (Math. Comp. 36, 1981); Chebyshev fits, relative errors 1.6e-7 and 1e-12.
ERFCX = (
    1.2648380554, -0.122357465774, -0.099017999679, 0.157644294808, -0.103020474189,
    0.0326775700704, 0.00108657996229, -0.00418024663031, 0.00030354285549, 0.00040548891917,
)  # fmt: skip
ERFCX_DOUBLE = (
    1.26483818436801, -0.122356763086159, -0.0990245397634645, 0.157629919247801,
    -0.102967050851091, 0.0327608893344342, 0.000931837865431351, -0.00438204709633272,
    0.000492160485354527, 0.000631990592585308, -8.93817069541888e-05, -0.000113189294556504,
    7.93627204572544e-06, 2.22092552718139e-05, 7.07805010310119e-07, -3.81455090580475e-06,
    -2.70927566092853e-07, 3.89145816370728e-07,
)  # fmt: skip


def erfcx(x: Any) -> Any:
    """Return exp(x^2) erfc(x) of x >= 0: Float or Float64."""
    coefficients = ERFCX if type(x) is mi.Float else ERFCX_DOUBLE
    t = (x - 2.5) / (x + 2.5)
    value = type(x)(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = dr.fma(value, t, coefficient)
    return value / (1 + 2 * x)


@dataclass(frozen=True)
class Channel:
    """The likelihood of one channel's base colour.

    Attributes:
        least: Float, energy of the best colour.
        mirrored: Bool, whether what follows is of y = 1 - c instead of y = c.
        mu: Float, mean of y before it is cut off, at most 1/2.
        s: Float, sqrt(A / 2).
    """

    least: Any
    mirrored: Any
    mu: Any
    s: Any

    @staticmethod
    def of(u: list[Any], v: list[Any], floor: Any) -> Channel:
        """Complete the square.

        Args:
            u: Floats, the components of u that may not be 0.
            v: those of v, more of them.
            floor: Float, what |v|^2 has beyond.
        """
        A, B = _dot(u, u), _dot(u, v)
        c = dr.clip(-B / dr.maximum(A, 1e-30), 0, 1)
        rest = [dr.fma(c, a, b) for a, b in zip(u, v, strict=False)] + v[len(u) :]
        mirrored = -B > 0.5 * A
        slope = dr.select(mirrored, A + B, -B)  # of -E at y = 0
        A = dr.maximum(dr.maximum(A, FLATTEST), slope / -FARTHEST)
        return Channel(0.5 * (_dot(rest, rest) + floor), mirrored, slope / A, dr.sqrt(0.5 * A))

    def integrate(self, edges: list[float], prior: list[Any] | None = None) -> Integrals:
        """Integrate over cells.

        Args:
            edges: (K + 1,) of the cells, from 0 to 1, the same from both ends.
            prior: K Floats, density of c in every cell; 1 by default.
        """
        # With x = (y - mu) s, exp(-(E - least)) is exp(x_0^2 - x^2), x_0 where it is 1. Means
        # and variances are small differences of tails: in double precision.
        inner = mi.Float if prior is None else mi.Float64
        tails = [self._tail(kind(y)) for y, kind in zip(
            edges, [mi.Float64, *[inner] * (len(edges) - 2), mi.Float64], strict=True
        )]  # fmt: skip
        if prior is not None:
            return self._under(tails, prior)
        whole, mean, variance = self._moments(tails[0], tails[-1])
        inverse = mi.Float(dr.rcp(whole))
        beyond = [mi.Float(tail.beyond) for tail in tails]
        parts = [inverse * (a - b) for a, b in zip(beyond[:-1], beyond[1:], strict=True)]
        return self._integrals(whole, parts, mean, variance)

    def _under(self, tails: list[_Tail], prior: list[Any]) -> Integrals:
        """Weigh cells by their prior."""
        density = [
            dr.select(self.mirrored, b, a) for a, b in zip(prior, prior[::-1], strict=True)
        ]
        of_cells = [self._moments(a, b) for a, b in zip(tails[:-1], tails[1:], strict=True)]
        masses = [g * part for g, (part, *_) in zip(density, of_cells, strict=True)]
        whole = sum(masses)
        parts = [mass / dr.select(whole > 0, whole, 1) for mass in masses]
        mean = sum(p * m for p, (_, m, _) in zip(parts, of_cells, strict=True))
        variance = sum(
            p * (v + dr.square(m - mean)) for p, (_, m, v) in zip(parts, of_cells, strict=True)
        )
        return self._integrals(whole, [mi.Float(part) for part in parts], mean, variance)

    def _moments(self, a: _Tail, b: _Tail) -> tuple[Any, Any, Any]:
        """Integral over x between two ends, 2 / sqrt(pi) of it, mean and variance of y there."""
        s, mu = mi.Float64(self.s), mi.Float64(self.mu)
        whole = a.beyond - b.beyond
        scale = dr.select(whole > TINIEST, dr.rcp(sqrt(pi) * s * dr.maximum(whole, TINIEST)), 0)
        offset = scale * (a.density - b.density)
        around = 0.5 / dr.square(s) + scale * (
            (a.y - mu) * a.density - (b.y - mu) * b.density
        )
        mean = dr.clip(mu + offset, a.y, b.y)
        return whole, mean, dr.maximum(around - dr.square(offset), 0)

    def _integrals(self, whole: Any, parts: list[Any], mean: Any, variance: Any) -> Integrals:
        mean = mi.Float(mean)
        return Integrals(
            mass=mi.Float(0.5 * sqrt(pi) * whole / self.s),
            cells=[
                dr.select(self.mirrored, b, a) for a, b in zip(parts, parts[::-1], strict=True)
            ],
            mean=dr.select(self.mirrored, 1 - mean, mean),
            variance=mi.Float(variance),
        )

    def quantile(self, part: Any) -> Any:
        """Return the colour below which a part of the probability lies: Floats in [0, 1]."""
        below = dr.select(self.mirrored, 1 - part, part)
        first, last = (self._tail(mi.Float64(y)).beyond for y in (0, 1))
        wanted = dr.lerp(first, last, mi.Float64(below))

        def halve(step: Any, low: Any, high: Any) -> tuple[Any, ...]:
            middle = 0.5 * (low + high)
            beyond = self._tail(middle).beyond > wanted
            return step + 1, dr.select(beyond, middle, low), dr.select(beyond, high, middle)

        ends = (mi.UInt32(0), dr.zeros(mi.Float64, dr.width(part)),
                dr.full(mi.Float64, 1, dr.width(part)))  # fmt: skip
        _, low, high = dr.while_loop(ends, lambda step, *_: step < HALVINGS, halve)
        y = mi.Float(0.5 * (low + high))
        return dr.select(self.mirrored, 1 - y, y)

    def _tail(self, y: Any) -> _Tail:
        """What lies beyond y, Float or Float64."""
        kind = type(y)
        mu, s = kind(self.mu), kind(self.s)
        best = dr.maximum(mu, 0)
        x, x_0 = (y - mu) * s, (best - mu) * s
        density = dr.exp(-(y - best) * s * (x + x_0))
        tail = density * erfcx(dr.abs(x))
        return _Tail(y, density, dr.select(x < 0, 2 - tail, tail))


@dataclass(frozen=True)
class Integrals:
    """Of one channel's likelihood.

    Attributes:
        mass: Float, the integral of exp(-(E - least)) over [0, 1].
        cells: K Floats, part of it in every cell.
        mean, variance: Floats, of c.
    """

    mass: Any
    cells: list[Any]
    mean: Any
    variance: Any


@dataclass(frozen=True)
class _Tail:
    """Density at y, and 2 / sqrt(pi) times the integral over x beyond it."""

    y: Any
    density: Any
    beyond: Any


def _dot(a: list[Any], b: list[Any]) -> Any:
    """Sum of products of the components that both have."""
    total = mi.Float(0)
    for x, y in zip(a, b, strict=False):
        total = dr.fma(x, y, total)
    return total
