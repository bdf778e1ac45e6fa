"""Components of draws: smooth random fields, and correlations between parameters.

Smooth fields are sums of cosine waves with random wave vectors (random Fourier features [Rahimi and
Recht 2007]). Their correlation at a distance d in space is exp(-d^2 / (2 l^2)).
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.posterior import Posterior
from svu_mi.recovery.sh.likelihood import nats_per_squared_error, values_of
from svu_mi.recovery.sh.quadratic_error import information

WAVES = 96  # per field
SMALLEST_SD = 1e-3  # lower limit of standard deviations of texels
CHUNK = 2**16  # texels per chunk of matrix inversion


def smooth_fields(number: int, place: Any, random: np.random.Generator) -> list[Any]:
    """Draw ``number`` Floats (T,) of mean 0, variance 1; positions ``place`` are in units of l."""
    frequencies = random.standard_normal((3, number * WAVES)).astype(np.float32)
    phases = random.uniform(0, 2 * np.pi, number * WAVES).astype(np.float32)
    w, shift, fields = to_drjit(mi.Vector3f, frequencies), to_drjit(mi.Float, phases), []
    for k in range(number):
        first = dr.opaque(mi.UInt32, k * WAVES)

        def add(wave: Any, total: Any, first: Any = first) -> tuple[Any, Any]:
            along = dr.dot(dr.gather(mi.Vector3f, w, first + wave), mi.Vector3f(place))
            return wave + 1, total + dr.cos(along + dr.gather(mi.Float, shift, first + wave))

        (total,) = fold(0, WAVES, add, dr.zeros(mi.Float, dr.width(place)))
        fields.append(float(np.sqrt(2 / WAVES)) * total)
    dr.eval(fields)
    return fields


def correlation_roots(
    posterior: Posterior[CalibratedKernel], values: dict[str, np.ndarray]
) -> np.ndarray:
    """Return Cholesky factors (T, N, N) of each texel's posterior correlations.

    The posterior is approximated by a normal distribution around ``values`` (Laplace).
    """
    factors = posterior.kernel.problem.factors
    chosen = factors.texel.numpy()
    weight = 2 * np.array(nats_per_squared_error(posterior), np.float64)
    matrix = information(factors, values_of(values, chosen))
    dr.eval(matrix)
    rows = [[np.array(x) for x in row] for row in matrix]
    least = np.diag(1 / np.maximum(prior_sds(posterior), SMALLEST_SD) ** 2)
    roots = np.tile(np.eye(len(rows), dtype=np.float32), (posterior.count, 1, 1))
    for first in range(0, len(chosen), CHUNK):
        span = slice(first, first + CHUNK)
        some = np.array([[x[span] for x in row] for row in rows], np.float64) * weight[span]
        covariance = np.linalg.inv(np.moveaxis(some, 2, 0) + least)
        width = np.sqrt(np.einsum("tii->ti", covariance))
        correlation = covariance / (width[:, :, None] * width[:, None, :])
        roots[chosen[span]] = np.linalg.cholesky(correlation)
    return roots


def prior_sds(posterior: Posterior[CalibratedKernel]) -> np.ndarray:
    """Return the prior standard deviations of all values, (N,)."""
    return np.concatenate([
        np.broadcast_to(np.ravel(posterior.prior_moments(name)[1]), CHANNELS[name])
        for name in NAMES
    ])  # fmt: skip
