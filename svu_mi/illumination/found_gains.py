"""Gains of photographs: exposures and white balances that nobody has written down.

A gain multiplies a channel of one photograph, b = g r. Photographs without their gains, b / g, are
what light and materials explain, so the logarithms of gains are unknowns beside those of the light
(``refine``). What all gains have in common is part of the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.illumination.samples import Samples

EXPOSURE, BALANCE = 0.5, 0.2  # prior sd of the logarithm: of all channels, and of each beside that
FAR = np.log(2)  # logarithm of a gain that the search starts from instead of from 0
FEWEST = 4  # photographs of which one can be odd
ODD_GAIN = np.log(2.5)  # logarithm of a gain beside the others', which is a mistake
ODD_NOISE = 1.7  # times the median photograph's noise, from which one shows something else
SPREADS = 3.0  # standard deviations of all photographs, that an odd one lies beyond as well


@dataclass(frozen=True)
class FoundGains:
    """What V photographs were multiplied with.

    Attributes:
        logarithm: (V, 3), with a mean of 0 over the photographs that fit.
        noise: (V,) what light and materials leave unexplained, in units of the texels' noise; 0
            where nothing is seen.
        odd: (V,) bool, the photographs that do not fit, which are left out.
    """

    logarithm: np.ndarray
    noise: np.ndarray
    odd: np.ndarray

    @property
    def factor(self) -> np.ndarray:
        """(V, 3) the gains."""
        return np.asarray(np.exp(self.logarithm))

    def record(self) -> dict[str, Any]:
        """Return plain values for a file."""
        return {
            "factor": self.factor.tolist(), "noise": self.noise.tolist(),
            "left_out": np.flatnonzero(self.odd).tolist(),
        }  # fmt: skip

    @staticmethod
    def start(samples: Samples) -> FoundGains:
        """Return equal gains, but for photographs that are far brighter or darker than others."""
        views = len(samples.cameras)
        grey = np.log(np.maximum(samples.radiance.mean(axis=1), 1e-6 * samples.unit))
        beside = grey - _medians(grey, samples.owner, samples.texels)[samples.owner]
        logarithm = _medians(beside, samples.view, views)
        logarithm = np.where(np.abs(logarithm) > FAR, logarithm, 0)
        every = np.repeat(logarithm[:, None], 3, axis=1)
        return FoundGains(every, np.zeros(views), np.zeros(views, bool))

    def stepped(
        self, change: np.ndarray, left_out: np.ndarray
    ) -> tuple[FoundGains, np.ndarray]:
        """Change the logarithms by (V, 3), but of those that do not fit, or took no part.

        Args:
            change: of the logarithms.
            left_out: (V,) bool, the photographs that the change does not know of.

        Returns:
            New gains, and what they have in common (3,), which is the light's.
        """
        logarithm = self.logarithm + np.where((self.odd | left_out)[:, None], 0, change)
        common = np.asarray(logarithm[~self.odd].mean(axis=0))
        return FoundGains(logarithm - common, self.noise, self.odd), common

    def judged(self, samples: Samples, found: np.ndarray, noise: np.ndarray) -> FoundGains:
        """Find the photographs that do not fit.

        Args:
            samples: S of them, as photographed.
            found: (S, 3) what they should be without their gains.
            noise: (n,) of the texels.
        """
        logarithm = self.logarithm
        if self.odd.any():  # these took no part in the last step
            least = 1e-6 * samples.unit
            ratio = np.log(np.maximum(samples.radiance, least) / np.maximum(found, least))
            own = [_medians(of_channel, samples.view, len(self.odd)) for of_channel in ratio.T]
            logarithm = np.where(self.odd[:, None], np.stack(own, axis=1), logarithm)
        samples = samples.divided(np.exp(logarithm))
        off = np.square(samples.radiance - found).mean(axis=1)
        squares = samples.weight * off / noise[samples.owner] ** 2
        left = np.sqrt(_medians(squares, samples.view, len(self.odd)))
        seen = left > 0
        if seen.sum() < FEWEST:
            return FoundGains(logarithm, left, self.odd)
        odd = _beyond(np.abs(_beside(logarithm.mean(axis=1), seen)), seen, ODD_GAIN)
        odd |= _beyond(_beside(np.log(np.maximum(left, 1e-30)), seen), seen, np.log(ODD_NOISE))
        return FoundGains(logarithm, left, odd)


def _beside(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return what values differ by from the median of those that are seen."""
    return values - float(np.median(values[seen]))


def _beyond(values: np.ndarray, seen: np.ndarray, limit: float) -> np.ndarray:
    """Which are above a limit, and above what is usual among them, too."""
    spread = 1.48 * float(np.median(np.abs(values[seen])))
    return seen & (values > max(limit, SPREADS * spread))


def _medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Return the median of each group, 0 of one that is empty."""
    order = np.lexsort((values, group))
    size = np.bincount(group, minlength=count)
    middle = np.cumsum(size) - size + size // 2
    sorted_values = np.append(values[order], 0.0)
    return np.where(size > 0, sorted_values[np.minimum(middle, len(values))], 0)


def of_gains(samples: Samples, found: np.ndarray, views: int) -> np.ndarray:
    """Return the derivatives (3, S, V) of samples for gains, given what they should be (S, 3)."""
    J = np.zeros((3, samples.count, views), np.float32)
    J[:, np.arange(samples.count), samples.view] = found.T
    return J


def with_gains(
    matrix: np.ndarray, gradient: np.ndarray, gains: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Append gains to unknowns, N per channel, with what is known of gains before.

    Args:
        matrix: (3 N, 3 N) precision.
        gradient: (3, N).
        gains: (V, 3) their logarithms.
    """
    number, views = gradient.shape[1], len(gains)
    own = np.linalg.inv(EXPOSURE**2 + BALANCE**2 * np.eye(3))
    whole = np.zeros((3, number + views, 3, number + views))
    whole[:, :number, :, :number] = matrix.reshape(3, number, 3, number)
    place = number + np.arange(views)
    for c in range(3):
        for d in range(3):
            whole[c, place, d, place] = own[c, d]
    size = 3 * (number + views)
    return whole.reshape(size, size), np.concatenate([gradient, own @ gains.T], axis=1)
