"""Posterior of a base colour channel: a normal distribution on [0, 1].

Given roughness and metallic, the energy of a channel is quadratic in its base colour c,

    E(c) = 1/2 |c u + v|^2 = 1/2 (A c^2 + 2 B c + |v|^2).

The posterior is a normal distribution of mean mu = -B / A and variance 1 / A, truncated to [0, 1].
To avoid cancellation, densities are relative to the best colour in [0, 1], and c is mirrored
(y = 1 - c) if mu > 1/2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import pi, sqrt
from typing import Any

import drjit as dr
import mitsuba as mi

FLATTEST = 1e-3  # minimum of A, for unlit channels; changes energies by less than this
HALVINGS = 24  # steps of the bisection in quantile()
TINIEST = 1e-290  # minimum mass of a bin in double precision
IMPOSSIBLE = 1e9  # energy of a bin that the prior excludes [nats]
FULL_SUPPORT = 1e-4  # minimum density of a colour prior for integrate_full_support()
DIM = 0.1  # s below which integrate_full_support() assumes uniform density within bins
CLEAR, FAR_BELOW = 1.0, 1.5  # single precision is sufficient if s >= CLEAR and mu s >= -FAR_BELOW
FARTHEST = 64.0  # maximum |mu|: photographs that are brighter than a white surface by this factor

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
    """Return exp(x^2) erfc(x) for x >= 0: Float or Float64."""
    coefficients = ERFCX if type(x) is mi.Float else ERFCX_DOUBLE
    wide, scale = x + 2.5, dr.fma(2, x, 1)
    inverse = dr.rcp(wide * scale)  # one division for both quotients
    t = (x - 2.5) * scale * inverse
    value = type(x)(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = dr.fma(value, t, coefficient)
    return value * wide * inverse


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
    def of(u: list[Any], v: list[Any], floor: Any) -> ChannelLikelihood:
        """Return the likelihood for the energy 1/2 |c u + v|^2; ``floor`` is added to |v|^2."""
        A, B = _dot(u, u), _dot(u, v)
        c = dr.clip(-B / dr.maximum(A, 1e-30), 0, 1)
        rest = [dr.fma(c, a, b) for a, b in zip(u, v, strict=False)] + v[len(u) :]
        mirrored = -B > 0.5 * A
        slope = dr.select(mirrored, A + B, -B)  # slope of -E at y = 0
        A = dr.maximum(dr.maximum(A, FLATTEST), slope / -FARTHEST)
        energy = 0.5 * (_dot(rest, rest) + floor)
        return ChannelLikelihood(energy, mirrored, slope / A, dr.sqrt(0.5 * A))

    def integrate(self, edges: list[float]) -> ColorIntegrals:
        """Integrate over bins of (K + 1,) symmetric ``edges`` in [0, 1], under a uniform prior."""
        # With x = (y - mu) s, exp(-(E - min_energy)) = exp(x_0^2 - x^2); x_0 is the best colour.
        inner = [self._tail(mi.Float(y)).beyond for y in edges[1:-1]]
        first, last, whole, mean, variance = self._as_precise(ChannelLikelihood._whole)
        inverse, beyond = dr.rcp(whole), [first, *inner, last]
        parts = [inverse * (a - b) for a, b in zip(beyond[:-1], beyond[1:], strict=True)]
        mass = 0.5 * sqrt(pi) * whole / self.s
        return self._integrals(mass, parts, mean, variance)

    def _as_precise(self, moments: Callable[..., tuple[Any, ...]], *args: Any) -> tuple[Any, ...]:
        """Return ``moments(self, type, *args)``, in double precision only in lanes that need it."""

        def of(kind: Any) -> Callable[..., tuple[Any, ...]]:
            return lambda mu, s, *rest: moments(replace(self, mu=mu, s=s), kind, *rest)

        hard = (self.s < CLEAR) | (self.mu * self.s < -FAR_BELOW)
        return dr.if_stmt((self.mu, self.s, *args), hard, of(mi.Float64), of(mi.Float))  # type: ignore[no-any-return]

    def _whole(self, kind: Any) -> tuple[Any, ...]:
        """Return the tails above y = 0 and y = 1, their difference, and mean and variance of y."""
        first, last = self._tail(kind(0)), self._tail(kind(1))
        whole = first.beyond - last.beyond
        mean, variance = _moments(kind(self.mu), kind(self.s), whole, first, last)
        return tuple(mi.Float(x) for x in (first.beyond, last.beyond, whole, mean, variance))

    def integrate_masses(self, edges: list[float]) -> tuple[Any, list[Any]]:
        """Return the mass and each bin's fraction, in single precision (relative error 1e-5)."""
        beyond = [self._tail(mi.Float(y)).beyond for y in edges]
        whole = beyond[0] - beyond[-1]
        inverse = dr.rcp(whole)
        parts = [inverse * (a - b) for a, b in zip(beyond[:-1], beyond[1:], strict=True)]
        return 0.5 * sqrt(pi) * whole / self.s, list(self._turned(parts))

    def weighted_masses(self, edges: list[float], prior: list[Any]) -> tuple[Any, ColorIntegrals]:
        """Integrate as ``integrate_full_support``, in single precision and without moments."""
        beyond = [self._tail(mi.Float(y)).beyond for y in edges]
        # Rounding can make the difference of two tails negative.
        parts = [dr.maximum(a - b, 0) for a, b in zip(beyond[:-1], beyond[1:], strict=True)]
        masses = [g * part for g, part in zip(prior, self._turned(parts), strict=True)]
        total, zero = dr.maximum(sum(masses), 1e-30), mi.Float(0)
        inverse = dr.rcp(total)
        bins = [inverse * x for x in masses]
        log_mass = dr.log(0.5 * sqrt(pi) * total / self.s)
        return log_mass, ColorIntegrals(mi.Float(1), bins, zero, zero)

    def integrate_full_support(
        self, edges: list[float], prior: list[Any]
    ) -> tuple[Any, ColorIntegrals]:
        """Integrate as ``integrate_with_prior``, 5 x faster, for priors above FULL_SUPPORT.

        Dr.Jit omits the moments, which are in double precision, where they are unused.
        """
        log_mass, masses = self.weighted_masses(edges, prior)
        inner = [self._tail(mi.Float(y)) for y in edges[1:-1]]
        around = [(tail.beyond, tail.density) for tail in inner]
        turned = list(self._turned(prior))
        mean, variance = self._as_precise(ChannelLikelihood._weighted, around, turned, edges)
        moments = self._integrals(masses.mass, [], mean, variance)
        return log_mass, replace(moments, bins=masses.bins)

    def _weighted(
        self, kind: Any, inner: list[tuple[Any, Any]], prior: list[Any], edges: list[float]
    ) -> tuple[Any, ...]:
        """Return mean and variance of y for a prior of the bins of y.

        ``inner`` are tails and densities at the inner edges.
        """
        first, last = self._tail(kind(0)), self._tail(kind(1))
        beyond = [first.beyond, *(kind(tail) for tail, _ in inner), last.beyond]
        density = [first.density, *(kind(x) for _, x in inner), last.density]
        s, mu = kind(self.s), kind(self.mu)
        masses, offset, around = [], kind(0), kind(0)
        for k, g in enumerate(prior):
            weight = kind(g)
            masses.append(weight * dr.maximum(beyond[k] - beyond[k + 1], 0))
            offset = dr.fma(weight, density[k] - density[k + 1], offset)
            low, high = (edges[k + end] - mu for end in (0, 1))
            around = dr.fma(weight, low * density[k] - high * density[k + 1], around)
        total = dr.maximum(sum(masses), TINIEST if kind is mi.Float64 else 1e-30)
        scale = dr.rcp(sqrt(pi) * s * total)
        mean = dr.clip(mu + scale * offset, 0, 1)
        variance = dr.maximum(0.5 / dr.square(s) + scale * around - dr.square(scale * offset), 0)
        if kind is mi.Float64:
            # Variance of a uniform density within bins, for small s.
            ends = list(zip(edges[:-1], edges[1:], strict=True))
            even = sum(
                mass / total * (dr.square(0.5 * (a + b) - mean) + (b - a) ** 2 / 12)
                for mass, (a, b) in zip(masses, ends, strict=True)
            )
            variance = dr.select(self.s < DIM, even, variance)
        return mi.Float(mean), mi.Float(variance)

    def integrate_with_prior(
        self, edges: list[float], prior: list[Any]
    ) -> tuple[Any, ColorIntegrals]:
        """Return the log integral of exp(min_energy - E) times the prior, and bin fractions.

        ``prior`` are K Floats, the density of c in each bin; it can contradict the likelihood.
        """
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
        log_mass = top + dr.log(0.5 * sqrt(pi) * total / mi.Float64(self.s))
        parts = [mi.Float(part) for part in parts]
        return mi.Float(log_mass), self._integrals(mi.Float(1), parts, mean, variance)

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
        _, a, b = dr.while_loop(
            (mi.UInt32(0), low + zero, high + zero), lambda step, *_: step < HALVINGS, halve
        )
        y = mi.Float(0.5 * (a + b))
        return dr.select(self.mirrored, 1 - y, y)

    def _bin(self, low: float, high: float) -> tuple[Any, Any, Any]:
        """Return log(2 / sqrt(pi) integral over x), mean and variance of y in a bin."""
        s, mu = mi.Float64(self.s), mi.Float64(self.mu)
        best, best_of_all = dr.clip(mu, low, high), dr.maximum(mu, 0)
        mass, a, b = self._between(mi.Float64(low), mi.Float64(high), best)
        mass = dr.maximum(mass, TINIEST)
        mean, variance = _moments(mu, s, mass, a, b)
        worse = (best - best_of_all) * dr.square(s) * (best + best_of_all - 2 * mu)
        return dr.log(mass) - worse, dr.clip(mean, low, high), variance

    def _between(self, low: Any, high: Any, best: Any) -> tuple[Any, _Tail, _Tail]:
        """Return the integral over [low, high] relative to density at ``best``, and both tails."""
        a, b = self._tail(low, best), self._tail(high, best)
        left, right = (y < mi.Float64(self.mu) for y in (low, high))
        mass = dr.select(
            right, b.outward - a.outward,
            dr.select(left, 2 - a.outward - b.outward, a.outward - b.outward),
        )  # fmt: skip
        return mass, a, b

    def _turned(self, values: list[Any]) -> Iterator[Any]:
        """Yield the values of bins, in reverse order where ``mirrored``."""
        for a, b in zip(values, values[::-1], strict=True):
            yield dr.select(self.mirrored, b, a)

    def _integrals(self, mass: Any, parts: list[Any], mean: Any, variance: Any) -> ColorIntegrals:
        mean = mi.Float(dr.clip(mean, 0, 1))
        return ColorIntegrals(
            mass=mass,
            bins=list(self._turned(parts)),
            mean=dr.select(self.mirrored, 1 - mean, mean),
            variance=mi.Float(variance),
        )

    def _tail(self, y: Any, best: Any | None = None) -> _Tail:
        """Return density and tails at y, relative to the density at ``best``."""
        kind = type(y)
        mu, s = kind(self.mu), kind(self.s)
        best = dr.maximum(mu, 0) if best is None else best
        x, x_0 = (y - mu) * s, (best - mu) * s
        density = dr.exp(-(y - best) * s * (x + x_0))
        outward = density * erfcx(dr.abs(x))
        return _Tail(y, density, outward, dr.select(x < 0, 2 - outward, outward))


def _moments(mu: Any, s: Any, mass: Any, a: _Tail, b: _Tail) -> tuple[Any, Any]:
    """Return mean and variance of y between two ends a and b."""
    scale = dr.rcp(sqrt(pi) * s * mass)
    offset = scale * (a.density - b.density)
    around = 0.5 / dr.square(s) + scale * ((a.y - mu) * a.density - (b.y - mu) * b.density)
    return mu + offset, dr.maximum(around - dr.square(offset), 0)


@dataclass(frozen=True)
class ColorIntegrals:
    """Integrals of one channel's likelihood.

    Attributes:
        mass: Float, integral of exp(-(E - min_energy)) over [0, 1].
        bins: K Floats, fraction of the mass in each bin.
        mean, variance: Floats, mean and variance of c.
    """

    mass: Any
    bins: list[Any]
    mean: Any
    variance: Any


@dataclass(frozen=True)
class _Tail:
    """Density at y, and 2 / sqrt(pi) times its integrals over x: from y in the direction away
    from the mean (``outward``), and from y to infinity (``beyond``)."""

    y: Any
    density: Any
    outward: Any
    beyond: Any


def _dot(a: list[Any], b: list[Any]) -> Any:
    """Return the scalar product."""
    total = mi.Float(0)
    for x, y in zip(a, b, strict=False):
        total = dr.fma(x, y, total)
    return total
