"""Closed-form start of recovery: the mean of every texel's posterior.

At one roughness and metallic the best base colour follows from a linear least squares problem.
What is left, two parameters, is looked at on a grid: weighing the nodes by their likelihood
gives the mean, which is where the expected squared error is least, and does not jump between
explanations that are equally good.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.posterior.streaming import nats
from svu_mi.recovery.sh.energy import halves
from svu_mi.statistics import Factors
from svu_mi.statistics.gather import Values

METALLIC = 17  # nodes, uniform on [0, 1]
SMALL = 1e-12  # squared radiance, in that of the photographs: a column that nothing lights
TINIEST = 1e-37  # neither is there a photograph that is not black


@dataclass(frozen=True)
class Start:
    """Parameters of S texels before any regularisation.

    Attributes:
        base_color: C Floats (S,).
        roughness, metallic: Floats (S,).
        variance: Float (S,), squared radiance: what the error of the best node, and the noise,
            let one expect of any error.
        least: Float (S,), squared radiance: the error of the best node.
        entropy: Float (S,) in [0, 1], of the nodes' weights (Eq. 5).
    """

    base_color: list[Any]
    roughness: Any
    metallic: Any
    variance: Any
    least: Any
    entropy: Any

    def values(self) -> Values:
        """Return the parameters."""
        red, green, blue = self.base_color
        return Values(red, green, blue, self.roughness, self.metallic)

    def table(self) -> np.ndarray:
        """Return red, green, blue, roughness and metallic as (5, S) float32."""
        return np.stack([np.array(x) for x in self.values()])


def closed_form(factors: Factors, sigma: Any, samples: float = 1.0) -> Start:
    """Return the posterior mean of every texel.

    Args:
        factors: of S texels.
        sigma: Float, opaque: noise of a texel's root mean squared error, in radiance. It adds
            to the error that the best node leaves, since neither model nor photographs are
            better than that.
        samples: number of independent errors that the mean is over.
    """
    least = _over_levels(factors, _least, (mi.Float(dr.inf),))[0]
    variance = (dr.square(sigma) + least) / dr.opaque(mi.Float, samples)
    scale = dr.rcp(2 * variance)

    def weigh(error: Any, color: list[Any], r: Any, m: Any, *sums: Any) -> tuple[Any, ...]:
        x = (error - least) * scale
        w = dr.exp(-x)
        values = (mi.Float(1), x, r, mi.Float(m), *color)
        return tuple(dr.fma(w, value, old) for value, old in zip(values, sums, strict=True))

    zeros = tuple(mi.Float(0) for _ in range(4 + factors.channels))
    total, *sums = _over_levels(factors, weigh, zeros)
    nodes = dr.opaque(mi.Float, factors.levels * METALLIC)
    entropy = dr.clip(nats(total, sums[0]) / dr.log(nodes), 0, 1)
    _, roughness, metallic, *color = (value / total for value in sums)
    dr.eval(roughness, metallic, color, variance, least, entropy)
    return Start(color, roughness, metallic, variance, least, entropy)


def _least(error: Any, color: list[Any], r: Any, m: Any, least: Any) -> tuple[Any, ...]:
    del color, r, m
    return (dr.minimum(least, error),)


def _over_levels(factors: Factors, consume: Any, state: tuple[Any, ...]) -> tuple[Any, ...]:
    """Fold ``consume(error, base colour, roughness, metallic, *state)`` over all nodes."""
    reader = factors.at()
    last = dr.opaque(mi.UInt32, factors.levels - 1)
    zero = dr.zeros(mi.Float, factors.count)

    def body(level: Any, *state: Any) -> tuple[Any, ...]:
        of_channels = [reader.factor(level, channel) for channel in range(factors.channels)]
        roughness = mi.Float(level) / mi.Float(last)
        for node in range(METALLIC):
            metallic = node / (METALLIC - 1)
            error, color = _profile(of_channels, metallic)
            state = consume(error, color, roughness, metallic, *state)
        return (level + 1, *state)

    return dr.while_loop(
        state=(mi.UInt32(0), *(zero + value for value in state)),
        cond=lambda level, *_: level <= last,
        body=body,
    )[1:]


def _profile(factors: list[list[Any]], metallic: float) -> tuple[Any, list[Any]]:
    """Return the least error, the mean over channels, and the base colour that has it."""
    error, color = mi.Float(0), []
    for factor in factors:
        u, v = halves(factor, metallic)
        uu, uv = (sum(a * b for a, b in zip(u, w, strict=True)) for w in (u, v))
        vv = sum(dr.square(b) for b in v)
        c = dr.clip(-uv / dr.maximum(uu, dr.maximum(SMALL * vv, TINIEST)), 0, 1)
        error += sum(dr.square(dr.fma(c, a, b)) for a, b in zip(u, v, strict=True))
        color.append(c)
    return error / len(factors), color
