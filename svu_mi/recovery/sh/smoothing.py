"""Smoothing the start of a recovery: neighbours decide where a texel alone cannot.

    sum over texels of (x - m)^2 w / S  +  lambda TV(x),

m and w of every texel's own posterior, in nats, and total variation (``regularization/tv.py``) on
the surface. Values stand by texel and channel, not in textures: neighbours are then all that has
to be looked up, and a step takes half as long.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.parameters import CHANNELS
from svu_mi.posterior import CalibratedPosterior
from svu_mi.recovery.options import DescentOptions
from svu_mi.recovery.sh.gradient import carried
from svu_mi.recovery.sh.objective import moments, nats_of_squares
from svu_mi.recovery.textures import Textures
from svu_mi.regularization.tv import absolute
from svu_mi.surface import Texels
from svu_mi.surface.neighbors import Neighbors, over_neighbors


@dataclass(frozen=True)
class Smoothing:
    """What is descended on, a function of every channel of T texels (``start``).

    Attributes:
        texels: the T texels.
        keys: name and number of every channel, in order.
        target, weight: Floats (T,) of all channels: m, and w / S, which is 0 where nothing is seen.
        around: columns (T,) UInt32, of ``Neighbors``.
        strength: opaque Float, lambda over the number of pairs.
        epsilon: of total variation.
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
        posterior: CalibratedPosterior, texels: Texels, names: Sequence[str],
        around: Neighbors, variation: tuple[float, float],
    ) -> Smoothing:  # fmt: skip
        """Take means and variances of a posterior in colour.

        Args:
            posterior: of the texels.
            texels: T texels.
            names: parameters to smooth.
            around: the neighbours of the texels.
            variation: lambda, and epsilon of total variation.
        """
        keys = tuple((name, k) for name in names for k in range(CHANNELS[name]))
        (means, sds), seen = moments(posterior), posterior.problem.factors.texel.numpy()
        shown = np.zeros(texels.count)
        shown[seen] = 1 / max(len(seen), 1)
        weights = {name: shown * nats for name, nats in nats_of_squares(sds).items()}
        target, weight = (
            [owned(mi.Float, of[name][k].astype(np.float32)) for name, k in keys]
            for of in (means, weights)
        )
        strength = dr.opaque(mi.Float, variation[0] / max(dr.width(around.pairs[0]), 1))
        return Smoothing(texels, keys, target, weight, around.around, strength, variation[1])

    def start(self, textures: Textures) -> dict[str, Any]:
        """Return what a descent starts from: a TensorXf (T,) of every channel, by its own key."""
        found = {}
        for name, k in self.keys:
            values = textures.at(self.texels, name).reshape(self.texels.count, -1)[:, k]
            found[_key(name, k)] = mi.TensorXf(owned(mi.Float, values.astype(np.float32)))
        return found

    def options(self, options: DescentOptions) -> DescentOptions:
        """Return how to descend, with the rates of parameters as those of their channels."""
        scales = {_key(name, k): options.scales.get(name, 1.0) for name, k in self.keys}
        return replace(options, scales=scales)

    def __call__(self, channels: Mapping[str, Any], step: int = 0) -> Any:
        """Return the loss, a Float of one value.

        Args:
            channels: tensors of the channels.
            step: not used: the loss is the same in every step.
        """
        del step
        values = [channels[_key(name, k)].array for name, k in self.keys]
        with dr.suspend_grad():
            loss, slopes = self._of([dr.detach(x) for x in values])
            dr.eval(loss, slopes)
        return carried(loss, slopes, values)

    def laid_out(self, start: Textures, channels: Mapping[str, Any]) -> Textures:
        """Return the textures of a start with other values of the texels."""
        images = {name: np.array(tensor, np.float32) for name, tensor in start.items()}
        index, (width, _) = self.texels.index.numpy(), self.texels.resolution
        for name, k in self.keys:
            images[name][index // width, index % width, k] = np.array(channels[_key(name, k)])
        return Textures.of(images)

    def _of(self, values: list[Any]) -> tuple[Any, list[Any]]:
        """Return the loss of every texel, and its derivatives by the values of all channels."""
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
        loss, slopes = 0.5 * self.strength * size, []  # every pair is seen from both ends
        for x, m, w, slope in zip(values, self.target, self.weight, turned, strict=True):
            loss += w * dr.square(x - m)
            slopes.append(dr.fma(2 * w, x - m, self.strength * slope))
        return loss, slopes


def _key(name: str, channel: int) -> str:
    return f"{name} {channel}"
