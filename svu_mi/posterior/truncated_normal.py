"""Posterior of a base colour channel: a normal distribution on [0, 1].

Given roughness and metallic, the energy of a channel is quadratic in its base colour c,

    E(c) = 1/2 |c u + v|^2 = 1/2 (A c^2 + 2 B c + |v|^2).

The posterior is a normal distribution of mean mu = -B / A and variance 1 / A, truncated to [0, 1].
To avoid cancellation, densities are relative to the best colour in [0, 1], and c is mirrored
(y = 1 - c) if mu > 1/2.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil, log, pi, sqrt
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold

FLATTEST = 1e-3  # minimum of A, for unlit channels; changes energies by less than this
HALVINGS = 24  # steps of the bisection in quantile()
TINIEST = 1e-290  # minimum mass of a bin in double precision
IMPOSSIBLE = 1e9  # energy of a bin that the prior excludes [nats]
FULL_SUPPORT = 1e-4  # minimum density of a colour prior for integrate()
SMOOTH = 0.7  # s^2 (1 - mu) below which integrands are smooth
PIECES = 7  # of [0, 1], in which two quadrature nodes suffice for a smooth integrand
FAR_BELOW = 0.6  # minimum of mu s for differences of error functions
REACH = 11.0  # 2^-x^2 is negligible at larger x
FARTHEST = 64.0  # maximum |mu|: photographs that are brighter than a white surface by this factor

# Polynomials, by weighted least squares: 2^x for |x| <= 1/2; erfcx(sqrt(log 2) x), with an error
# below 2e-7 2^(x^2); and (x + 1/4) r(x) in (x - 2) / (x + 2), r of ``_outside``.
POWER = 1.00000007, 0.69314697, 0.2402212, 0.05550713, 0.00967554, 0.00132765
TAIL = (
    1.0, -0.939428033, 0.692955935, -0.4327471239, 0.2354003931, -0.1104685932, 0.04264138649,
    -0.01254934501, 0.002555709377, -0.0003134506325, 1.718556386e-05,
)  # fmt: skip
FRACTION = (
    0.8807060897, 0.4148052202, -0.350906424, -0.04465307649, 0.1098794152, 0.03233579384,
    -0.03956578059, -0.01564258519, 0.01304287005,
)  # fmt: skip
# (1 + 2 x) erfcx(x) in (x - 2.5) / (x + 2.5), the variable of Shepherd and Laframboise (Math. Comp.
# 36, 1981); a Chebyshev fit, relative error 1e-12.
ERFCX = (
    1.26483818436801, -0.122356763086159, -0.0990245397634645, 0.157629919247801, -0.1029670508511,
    0.0327608893344342, 0.00093183786543135, -0.00438204709633272, 0.00049216048535453,
    0.00063199059258531, -8.938170695419e-05, -0.00011318929455650, 7.93627204573e-06,
    2.220925527181e-05, 7.0780501031e-07, -3.81455090581e-06, -2.7092756609e-07, 3.8914581637e-07,
)  # fmt: skip


def erfcx(x: Any) -> Any:
    """Return exp(x^2) erfc(x) for x >= 0: Float64."""
    wide, scale = x + 2.5, dr.fma(2, x, 1)
    inverse = dr.rcp(wide * scale)  # one division for both quotients
    return _polynomial(ERFCX, (x - 2.5) * scale * inverse) * wide * inverse


def exp2(x: Any) -> Any:
    """Return 2^x for |x| < 126, Float of relative error 2e-7, in half the time of ``dr.exp2``."""
    shifted = x + 1.5 * 2**23  # the last bits are x, rounded
    value = _polynomial(POWER, x - (shifted - 1.5 * 2**23))
    exponent = dr.reinterpret_array(mi.UInt32, shifted) << 23
    return dr.reinterpret_array(mi.Float, dr.reinterpret_array(mi.UInt32, value) + exponent)


def _clipped(low: float, x: Any, high: float) -> Any:
    """Clip x: two instructions (``dr.clip``, which hands NaN on, takes a dozen)."""
    x = dr.select(x > low, x, low)
    return dr.select(x < high, x, high)


def _polynomial(coefficients: Sequence[float], x: Any) -> Any:
    value = type(x)(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = dr.fma(value, x, coefficient)
    return value


@dataclass(frozen=True)
class ChannelLikelihood:
    """Likelihood of one channel's base colour c, a normal distribution of y on [0, 1].

    Attributes:
        min_energy: Float, energy of the best colour.
        mirrored: Bool, True: y = 1 - c; False: y = c.
        mu: Float, mean of y before truncation, at most 1/2.
        s: Float, sqrt(A / 2).
    """

    min_energy: Any
    mirrored: Any
    mu: Any
    s: Any

    @staticmethod
    def of(u: list[Any], v: list[Any], floor: Any) -> "ChannelLikelihood":
        """Return the likelihood for the energy 1/2 |c u + v|^2; ``floor`` is added to |v|^2."""
        A, B = _dot(u, u), _dot(u, v)
        c = dr.clip(-B / dr.maximum(A, 1e-30), 0, 1)
        rest = [dr.fma(c, a, b) for a, b in zip(u, v, strict=False)] + v[len(u) :]
        mirrored = -B > 0.5 * A
        slope = dr.select(mirrored, A + B, -B)  # slope of -E at y = 0
        A = dr.maximum(dr.maximum(A, FLATTEST), slope / -FARTHEST)
        energy = 0.5 * (_dot(rest, rest) + floor)
        return ChannelLikelihood(energy, mirrored, slope / A, dr.sqrt(0.5 * A))

    def integrate(
        self, edges: list[float], prior: list[Any] | None = None, certain: bool = True
    ) -> "ColorIntegrals":
        """Integrate over bins of (K + 1,) symmetric ``edges`` in [0, 1].

        ``prior`` are K Floats, the density of c in each bin (default: 1); with ``certain``, they
        are above FULL_SUPPORT.
        """
        if prior and not certain:
            return self.integrate_with_prior(edges, prior)
        density = prior or [mi.Float(1)] * (len(edges) - 1)

        def of(integrate: Callable[..., Any]) -> Callable[..., Any]:
            return lambda mu, s, *g: integrate(replace(self, mu=mu, s=s), edges, g)

        def curved(mu: Any, s: Any, *g: Any) -> Any:
            inside, outside = of(ChannelLikelihood._inside), of(ChannelLikelihood._outside)
            return dr.if_stmt((mu, s, *g), mu * s > -FAR_BELOW, inside, outside)

        smooth = dr.square(self.s) * (1 - self.mu) < SMOOTH
        args = self.mu, self.s, *density
        mass, mean, variance, *bins = dr.if_stmt(args, smooth, of(ChannelLikelihood._flat), curved)
        return ColorIntegrals(mass, bins, mean, variance)

    def _flat(self, edges: list[float], density: Sequence[Any]) -> tuple[Any, ...]:
        """Integrate by Gauss-Legendre quadrature, with two nodes in each piece of a bin."""
        first, scale, least = self._reach()
        masses, mean, square = [], mi.Float(0), mi.Float(0)
        for a, b, g in zip(edges[:-1], edges[1:], density, strict=True):
            pieces = ceil(PIECES * (b - a) - 1e-6)
            middle = a + (b - a) * (np.arange(pieces) + 0.5) / pieces
            half, mass = (b - a) / (2 * pieces), mi.Float(0)
            for c in np.concatenate([middle - half / sqrt(3), middle + half / sqrt(3)]).tolist():
                t = dr.fma(scale, c, first)
                part = half * g * exp2(dr.fma(-t, t, least))
                mass += part
                mean, square = dr.fma(part, c, mean), dr.fma(part, c * c, square)
            masses.append(mass)
        total = sum(masses)
        return _normalized(total, masses, total, mean, square)

    def _inside(self, edges: list[float], density: Sequence[Any]) -> tuple[Any, ...]:
        """Integrate by differences of error functions; mean and variance by parts."""
        first, scale, least = self._reach()
        last = dr.select(self.mirrored, scale * self.mu, scale * (1 - self.mu))
        reach = [first, *(dr.fma(scale, c, first) for c in edges[1:-1]), last]
        reach = [_clipped(-REACH, t, REACH) for t in reach]
        bells = [exp2(-t * t) for t in reach]
        below = [dr.mulsign(dr.fma(-bell, _polynomial(TAIL, dr.abs(t)), 1), t)
                 for bell, t in zip(bells, reach, strict=True)]  # fmt: skip
        masses = [g * dr.select(b > a, b - a, 0)
                  for g, a, b in zip(density, below[:-1], below[1:], strict=True)]  # fmt: skip
        slope, around, before = mi.Float(0), mi.Float(0), mi.Float(0)
        for g, bell, t in zip([*density, mi.Float(0)], bells, reach, strict=True):
            step = bell * (g - before)
            slope, around, before = slope + step, dr.fma(step, t, around), g
        total, width = sum(masses), dr.rcp(self.s)
        inverse = dr.rcp(total)
        unit = inverse * width / sqrt(pi)
        offset = unit * slope
        mean = dr.select(self.mirrored, 1 - self.mu, self.mu) + offset
        variance = width * (0.5 * width + sqrt(log(2)) * unit * around) - dr.square(offset)
        mass = 0.5 * sqrt(pi) * total * width * exp2(least)
        bins = [inverse * part for part in masses]
        return mass, mean, dr.select(variance > 0, variance, 0), *bins

    def _outside(self, edges: list[float], density: Sequence[Any]) -> tuple[Any, ...]:
        """Integrate a normal distribution whose mean is far below y = 0, by tails.

        Beyond x, the mean of t - x is e = 1 / (2 (x + r)), that of its square is e r, and
        erfcx(x) = 1 / (sqrt(pi) (x + e)); r = 1 / (x + 3/2 / (x + ...)) is a continued fraction.
        """
        scale = sqrt(1 / log(2)) * self.s
        nearest, width, own = scale * self.mu, dr.rcp(self.s), list(self._turned(density))
        tails, mean, square, before = [], mi.Float(0), mi.Float(0), mi.Float(0)
        for y, g in zip(edges, [*own, mi.Float(0)], strict=True):
            x, u = self.s * (y - self.mu), scale * y
            inverse = dr.rcp((x + 0.25) * (x + 2))
            r = _polynomial(FRACTION, (x - 2) * (x + 0.25) * inverse) * (x + 2) * inverse
            e = 0.5 * dr.rcp(x + r)
            tail = exp2(_clipped(-125, u * (2 * nearest - u), 0)) * dr.rcp(x + e)
            step, before, e = (g - before) * tail, g, e * width
            mean = dr.fma(step, y + e, mean)
            square = dr.fma(step, y * y + e * (2 * y + r * width), square)
            tails.append(tail)
        masses = [g * dr.select(a > b, a - b, 0)
                  for g, a, b in zip(own, tails[:-1], tails[1:], strict=True)]  # fmt: skip
        total = sum(masses)
        mass, mean, variance, *bins = _normalized(0.5 * width * total, masses, total, mean, square)
        return mass, dr.select(self.mirrored, 1 - mean, mean), variance, *self._turned(bins)

    def _reach(self) -> tuple[Any, Any, Any]:
        """Return t at c = 0, its slope in c, and t^2 of the best colour: the density is 2^-t^2."""
        scale = sqrt(1 / log(2)) * self.s
        first = -scale * dr.select(self.mirrored, 1 - self.mu, self.mu)
        return first, scale, dr.square(scale * dr.minimum(self.mu, 0))

    def integrate_with_prior(self, edges: list[float], prior: list[Any]) -> "ColorIntegrals":
        """Integrate as ``integrate``, slowly, for priors that can contradict the likelihood."""
        density = [mi.Float64(weight) for weight in self._turned(prior)]
        of_bins = [self._bin(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
        logs = [
            dr.select(g > 0, dr.log(dr.select(g > 0, g, 1)) + log_mass, -IMPOSSIBLE)
            for g, (log_mass, *_) in zip(density, of_bins, strict=True)
        ]
        top = logs[0]
        for value in logs[1:]:
            top = dr.maximum(top, value)
        masses = [dr.exp(value - top) for value in logs]
        total = sum(masses)
        parts = [mass / total for mass in masses]
        mean = sum(p * m for p, (_, m, _) in zip(parts, of_bins, strict=True))
        variance = sum(
            p * (v + dr.square(m - mean)) for p, (_, m, v) in zip(parts, of_bins, strict=True)
        )
        mean = mi.Float(dr.clip(mean, 0, 1))
        return ColorIntegrals(
            mass=mi.Float(1),
            bins=list(self._turned([mi.Float(part) for part in parts])),
            mean=dr.select(self.mirrored, 1 - mean, mean),
            variance=mi.Float(variance),
            log_scale=mi.Float(top + dr.log(0.5 * sqrt(pi) * total / mi.Float64(self.s))),
        )

    def quantile(self, part: Any, low: Any, high: Any) -> Any:
        """Return the quantile ``part`` of c, restricted to [low, high], by bisection."""
        part, low, high = (mi.Float64(x) for x in (part, low, high))
        part = dr.select(self.mirrored, 1 - part, part)
        low, high = (
            dr.select(self.mirrored, 1 - high, low),
            dr.select(self.mirrored, 1 - low, high),
        )
        best = dr.clip(mi.Float64(self.mu), low, high)
        target = part * self._between(low, high, best)[0]

        def halve(step: Any, a: Any, b: Any) -> tuple[Any, ...]:
            middle = 0.5 * (a + b)
            below = self._between(low, middle, best)[0] < target
            return step + 1, dr.select(below, middle, a), dr.select(below, b, middle)

        zero = dr.zeros(mi.Float64, dr.width(part))
        a, b = fold(0, HALVINGS, halve, low + zero, high + zero)
        y = mi.Float(0.5 * (a + b))
        return dr.select(self.mirrored, 1 - y, y)

    def _bin(self, low: float, high: float) -> tuple[Any, Any, Any]:
        """Return log(2 / sqrt(pi) integral over x), mean and variance of y in a bin."""
        s, mu = mi.Float64(self.s), mi.Float64(self.mu)
        best, best_of_all = dr.clip(mu, low, high), dr.maximum(mu, 0)
        mass, a, b = self._between(mi.Float64(low), mi.Float64(high), best)
        mass = dr.maximum(mass, TINIEST)
        scale = dr.rcp(sqrt(pi) * s * mass)
        offset = scale * (a - b)
        variance = 0.5 / dr.square(s) + scale * ((low - mu) * a - (high - mu) * b)
        variance = dr.maximum(variance - dr.square(offset), 0)
        worse = (best - best_of_all) * dr.square(s) * (best + best_of_all - 2 * mu)
        return dr.log(mass) - worse, dr.clip(mu + offset, low, high), variance

    def _between(self, low: Any, high: Any, best: Any) -> tuple[Any, Any, Any]:
        """Return the integral over [low, high], and the densities at its ends, all relative to the
        density at ``best``."""
        (a, below), (b, above) = self._tail(low, best), self._tail(high, best)
        left, right = (y < mi.Float64(self.mu) for y in (low, high))
        mass = dr.select(right, above - below, dr.select(left, 2 - below - above, below - above))
        return mass, a, b

    def _turned(self, values: Sequence[Any]) -> Iterator[Any]:
        """Yield the values of bins, in reverse order where ``mirrored``."""
        for a, b in zip(values, values[::-1], strict=True):
            yield dr.select(self.mirrored, b, a)

    def _tail(self, y: Any, best: Any) -> tuple[Any, Any]:
        """Return the density at y, relative to that at ``best``, and 2 / sqrt(pi) times its
        integral over x away from the mean."""
        mu, s = mi.Float64(self.mu), mi.Float64(self.s)
        x, x_0 = (y - mu) * s, (best - mu) * s
        density = dr.exp(-(y - best) * s * (x + x_0))
        return density, density * erfcx(dr.abs(x))


def _normalized(
    mass: Any, masses: list[Any], total: Any, mean: Any, square: Any
) -> tuple[Any, ...]:
    """Return mass, mean, variance and fractions of bins from sums over [0, 1]."""
    inverse = dr.rcp(total)
    mean *= inverse
    variance = dr.maximum(dr.fma(inverse, square, -dr.square(mean)), 0)
    return mass, mean, variance, *(inverse * part for part in masses)


@dataclass(frozen=True)
class ColorIntegrals:
    """Integrals of one channel's likelihood.

    Attributes:
        mass: Float, integral of exp(-(E - min_energy) - log_scale) over [0, 1].
        bins: K Floats, fraction of the mass in each bin.
        mean, variance: Floats, mean and variance of c.
    """

    mass: Any
    bins: list[Any]
    mean: Any
    variance: Any
    log_scale: Any = 0.0


def _dot(a: list[Any], b: list[Any]) -> Any:
    """Return the scalar product."""
    total = mi.Float(0)
    for x, y in zip(a, b, strict=False):
        total = dr.fma(x, y, total)
    return total
