"""Random parts of draws from a field: smooth variation over the object, correlated parameters.

Smooth fields are sums of waves of random direction and length, which are Gaussian in the limit of
many [Rahimi and Recht 2007]. Their correlation is exp(-d^2 / (2 l^2)) at a distance d in space.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.posterior import CalibratedKernel, Posterior
from svu_mi.recovery.sh.energy import information
from svu_mi.recovery.sh.objective import nats, values_of

WAVES = 96
SUREST = 1e-3  # standard deviation that no texel is surer than
CHUNK = 2**16  # texels whose matrices are inverted at a time


@dataclass(frozen=True)
class Waves:
    """N fields of mean 0 and variance 1.

    Attributes:
        number: N.
        frequencies: (N WAVES,) Vector3f, of unit length scale.
        phases: (N WAVES,) Float.
    """

    number: int
    frequencies: Any
    phases: Any

    @staticmethod
    def draw(number: int, random: np.random.Generator) -> Waves:
        """Draw N fields."""
        frequencies = random.standard_normal((3, number * WAVES)).astype(np.float32)
        phases = random.uniform(0, 2 * np.pi, number * WAVES).astype(np.float32)
        return Waves(number, owned(mi.Vector3f, frequencies), owned(mi.Float, phases))

    def at(self, place: Any) -> list[Any]:
        """Return the fields, Floats (T,)."""
        found = []
        for field in range(self.number):
            first = dr.opaque(mi.UInt32, field * WAVES)

            def add(wave: Any, total: Any, first: Any = first) -> tuple[Any, Any]:
                w = dr.gather(mi.Vector3f, self.frequencies, first + wave)
                phase = dr.gather(mi.Float, self.phases, first + wave)
                return wave + 1, total + dr.cos(dr.dot(w, mi.Vector3f(place)) + phase)

            start = (mi.UInt32(0), dr.zeros(mi.Float, dr.width(place)))
            total = dr.while_loop(start, lambda wave, _: wave < WAVES, add)[1]
            found.append(float(np.sqrt(2 / WAVES)) * total)
        dr.eval(found)
        return found


@dataclass(frozen=True)
class Correlations:
    """Those that photographs leave between the N values of each of T texels, to second order.

    Only draws ask for them, so they wait until they are asked for.

    Attributes:
        posterior: of the texels.
        values: (C, T) by parameter, where they are looked for.
    """

    posterior: Posterior[CalibratedKernel]
    values: dict[str, np.ndarray]

    @cached_property
    def roots(self) -> np.ndarray:
        """(T, N, N) float32, L of every texel, triangular: L L^T are its correlations."""
        factors = self.posterior.kernel.problem.factors
        chosen = factors.texel.numpy()
        weight = 2 * np.array(nats(self.posterior), np.float64)
        matrix = information(factors, values_of(self.values, chosen))
        dr.eval(matrix)
        rows = [[np.array(x) for x in row] for row in matrix]
        least = np.diag(1 / np.maximum(prior_sds(self.posterior), SUREST) ** 2)
        roots = np.tile(np.eye(len(rows), dtype=np.float32), (self.posterior.count, 1, 1))
        for first in range(0, len(chosen), CHUNK):
            span = slice(first, first + CHUNK)
            some = np.array([[x[span] for x in row] for row in rows], np.float64) * weight[span]
            covariance = np.linalg.inv(np.moveaxis(some, 2, 0) + least)
            width = np.sqrt(np.einsum("tii->ti", covariance))
            correlation = covariance / (width[:, :, None] * width[:, None, :])
            roots[chosen[span]] = np.linalg.cholesky(correlation)
        return roots

    def given_to(self, values: np.ndarray) -> np.ndarray:
        """Return values (N, T) that were independent, with these correlations."""
        return np.einsum("tij,jt->it", self.roots, values)


def prior_sds(posterior: Posterior[CalibratedKernel]) -> np.ndarray:
    """Return the standard deviations of the prior of all values, (N,)."""
    return np.concatenate([
        np.broadcast_to(np.ravel(posterior.prior_moments(name)[1]), CHANNELS[name])
        for name in NAMES
    ])  # fmt: skip
