"""Losses of SH recovery: likelihood, and quadratic priors around posterior means.

Both use the statistics and noise of the calibrated posterior (``posterior/calibrated_fit.py``).
Their cost is independent of the number of photographs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.neighbors import Neighbors, over_neighbors
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.posterior import Posterior
from svu_mi.recovery.recovery_options import DescentOptions
from svu_mi.recovery.regularizers.known_gradient import with_known_gradient
from svu_mi.recovery.regularizers.total_variation import absolute
from svu_mi.recovery.sh.quadratic_error import energy, sum_over_texels
from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.statistics.cholesky_factors import Factors
from svu_mi.statistics.gather_statistics import Values, flatten_values

SD_FLOOR = 1e-2  # added to standard deviations in quadrature: limits the weight of a texel


class TexelLoss:
    """Mean of a loss over S texels. ``place``, (S,) UInt32: flat index of each in a texture."""

    place: Any
    _of: Callable[[Values], tuple[Any, Values]]  # returns (S,) losses, and derivatives

    def __call__(self, textures: Mapping[str, Any], _: int = 0) -> Any:
        """Return the loss, a Float of width 1."""
        total = sum_over_texels(self._of, textures, self.place)
        return total * dr.opaque(mi.Float, 1 / dr.width(self.place))


@dataclass(frozen=True)
class Likelihood(TexelLoss):
    """Negative log-likelihood -log p(B | psi) in nats, mean over observed texels.

    Attributes:
        factors: Statistics of the S observed texels, as triangular factors.
        weight: (S,) Float, nats per mean squared error (squared radiance).
    """

    factors: Factors
    place: Any
    weight: Any

    @staticmethod
    def of(posterior: Posterior[CalibratedKernel], texels: Texels) -> "Likelihood":
        """Create the likelihood from the statistics and noise of an RGB posterior."""
        factors = posterior.kernel.problem.factors
        place = dr.gather(mi.UInt32, texels.index, factors.texel)
        dr.eval(place)
        return Likelihood(factors, place, nats_per_squared_error(posterior))

    def _of(self, values: Values) -> tuple[Any, Values]:
        error, slopes = energy(self.factors, values)
        return self.weight * error, _map_values(lambda slope: self.weight * slope, slopes)


@dataclass(frozen=True)
class QuadraticPrior(TexelLoss):
    """Weighted squared distance to posterior means, averaged over texels.

    Attributes:
        target: Posterior means.
        weight: Weights of the squared distances.
    """

    place: Any
    target: Values
    weight: Values

    @staticmethod
    def of(posterior: Posterior[CalibratedKernel], texels: Texels) -> "QuadraticPrior":
        """Return -log N(psi; mean, variance) with the moments of each texel's posterior.

        If the likelihood has several minima, the mean lies between them, and total variation
        selects the one that fits the neighbours.
        """
        means, sds = texel_moments(posterior)
        return QuadraticPrior._to(posterior, texels, means, nats_of_squares(sds))

    @staticmethod
    def weighted_by_information(
        posterior: Posterior[CalibratedKernel], texels: Texels
    ) -> "QuadraticPrior":
        """Return a prior with weights 1 - posterior variance / prior variance, in [0, 1]."""
        means, sds = texel_moments(posterior)
        trust = {}
        for name, sd in sds.items():
            usual = np.reshape(posterior.prior_moments(name)[1], (-1, 1))  # (C, 1) or (1, 1)
            trust[name] = np.clip(1 - (sd / np.maximum(usual, SD_FLOOR)) ** 2, 0, 1)
        return QuadraticPrior._to(posterior, texels, means, trust)

    @staticmethod
    def _to(
        posterior: Posterior[CalibratedKernel], texels: Texels, means: "Table", weights: "Table"
    ) -> "QuadraticPrior":
        seen = posterior.kernel.problem.factors.texel
        place, chosen = dr.gather(mi.UInt32, texels.index, seen), seen.numpy()
        return QuadraticPrior(place, values_of(means, chosen), values_of(weights, chosen))

    def _of(self, values: Values) -> tuple[Any, Values]:
        offsets = _map_values(lambda x, target: x - target, values, self.target)
        loss = sum(flatten_values(_map_values(lambda w, x: w * dr.square(x), self.weight, offsets)))
        return loss, _map_values(lambda w, x: 2 * w * x, self.weight, offsets)


def nats_per_squared_error(posterior: Posterior[CalibratedKernel]) -> Any:
    """Return nats per mean squared error of S texels, a Float (S,)."""
    problem = posterior.kernel.problem
    weight = 0.5 * problem.factors.channels * problem.copies * dr.square(problem.scale)
    dr.eval(weight)
    return weight


Table = dict[str, np.ndarray]
"""Values of texels, (C, T) by parameter."""


def nats_of_squares(sds: Table) -> Table:
    """Return 1 / (2 (sd^2 + SD_FLOOR^2)): nats per squared distance to the mean."""
    return {name: 0.5 / (sd**2 + SD_FLOOR**2) for name, sd in sds.items()}


def texel_moments(posterior: Posterior[CalibratedKernel]) -> tuple[Table, Table]:
    """Return posterior means and sds, without the common factor of base colour."""
    posterior = replace(posterior, kernel=posterior.kernel.alone())
    means, sds = (
        {name: np.array(of(name), np.float64).reshape(posterior.count, -1).T for name in NAMES}
        for of in (posterior.mean, posterior.sd)
    )
    return means, sds


def values_of(table: Table, chosen: np.ndarray | None = None) -> Values:
    """Return the values of chosen texels (default: all) as Floats, by parameter."""
    texels = slice(None) if chosen is None else chosen
    return {
        name: [to_drjit(mi.Float, row.astype(np.float32)) for row in rows[:, texels]]
        for name, rows in table.items()
    }


def _map_values(do: Callable[..., Any], *values: Values) -> Values:
    """Return the results of ``do`` on corresponding Floats of all arguments."""
    return {
        name: [do(*x) for x in zip(*(v[name] for v in values), strict=True)] for name in values[0]
    }


@dataclass(frozen=True)
class SmoothedStart:
    """Loss whose minimiser is the smoothed posterior mean of T texels.

        sum over texels, channels of w / S (x - m)^2  +  lambda TV(x)

    Attributes:
        texels: The T texels.
        keys: Parameter name and channel index of each channel.
        target: Posterior means m, a Float (T,) per channel.
        weight: Weights w / S, a Float (T,) per channel; 0 for unobserved texels.
        around: Columns of ``Neighbors``, UInt32 (T,) each.
        strength: Opaque Float, lambda / number of pairs.
        epsilon: Difference below which total variation is quadratic.
    """

    texels: Texels
    keys: tuple[tuple[str, int], ...]
    target: list[Any]
    weight: list[Any]
    around: Sequence[Any]
    strength: Any
    epsilon: float

    @staticmethod
    def of(
        posterior: Posterior[CalibratedKernel], texels: Texels, names: Sequence[str],
        around: Neighbors, variation: tuple[float, float],
    ) -> "SmoothedStart":  # fmt: skip
        """Create the loss from the means and variances of an RGB posterior."""
        keys = tuple((name, k) for name in names for k in range(CHANNELS[name]))
        means, sds = texel_moments(posterior)
        seen = posterior.kernel.problem.factors.texel.numpy()
        shown = np.zeros(texels.count)
        shown[seen] = 1 / max(len(seen), 1)
        weights = {name: shown * nats for name, nats in nats_of_squares(sds).items()}
        target, weight = (
            [to_drjit(mi.Float, of[name][k].astype(np.float32)) for name, k in keys]
            for of in (means, weights)
        )
        strength = dr.opaque(mi.Float, variation[0] / max(dr.width(around.pairs[0]), 1))
        return SmoothedStart(texels, keys, target, weight, around.around, strength, variation[1])

    def start(self, textures: Textures) -> dict[str, Any]:
        """Return the initial values of a descent: a TensorXf (T,) per channel, by key."""
        tensors = {}
        for name, k in self.keys:
            values = textures.at(self.texels, name).reshape(self.texels.count, -1)[:, k]
            tensors[_key(name, k)] = mi.TensorXf(to_drjit(mi.Float, values.astype(np.float32)))
        return tensors

    def options(self, options: DescentOptions) -> DescentOptions:
        """Return descent options with ``scales`` by channel instead of parameter."""
        scales = {_key(name, k): options.scales.get(name, 1.0) for name, k in self.keys}
        return replace(options, scales=scales)

    def __call__(self, channels: Mapping[str, Any], _: int = 0) -> Any:
        """Return the loss, a Float of width 1."""
        values = [channels[_key(name, k)].array for name, k in self.keys]
        with dr.suspend_grad():
            loss, slopes = self._of([dr.detach(x) for x in values])
            dr.eval(loss, slopes)
        return with_known_gradient(dr.sum(loss), slopes, values)

    def laid_out(self, start: Textures, channels: Mapping[str, Any]) -> Textures:
        """Return a copy of ``start``, with values of ``channels`` written at the texels."""
        images = {name: np.array(tensor, np.float32) for name, tensor in start.items()}
        index, (width, _) = self.texels.index.numpy(), self.texels.resolution
        for name, k in self.keys:
            images[name][index // width, index % width, k] = np.array(channels[_key(name, k)])
        return Textures.of(images)

    def _of(self, values: list[Any]) -> tuple[Any, list[Any]]:
        """Return the loss per texel, and its derivatives in all channels."""
        epsilon = dr.opaque(mi.Float, self.epsilon) if self.epsilon else None

        def add(other: Any, state: tuple[Any, list[Any]]) -> tuple[Any, list[Any]]:
            total, slopes = state[0], []
            for x, old in zip(values, state[1], strict=True):
                size, slope = absolute(x - dr.gather(mi.Float, x, other), epsilon)
                total += size
                slopes.append(old + slope)
            return total, slopes

        begin = mi.Float(0), [mi.Float(0) for _ in values]
        size, turned = over_neighbors(self.around, add, begin)
        loss, slopes = 0.5 * self.strength * size, []  # each pair is visited from both texels
        for x, m, w, slope in zip(values, self.target, self.weight, turned, strict=True):
            loss += w * dr.square(x - m)
            slopes.append(dr.fma(2 * w, x - m, self.strength * slope))
        return loss, slopes


def _key(name: str, channel: int) -> str:
    return f"{name} {channel}"
