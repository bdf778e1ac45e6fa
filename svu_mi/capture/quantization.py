"""Limits of what pixels can hold: saturated channels, and steps of integers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.capture.image_io import Transfer, decoded

CURVE = 1.4 / 2.4  # exponent of how the steps of sRGB grow with radiance, above its linear part


@dataclass(frozen=True)
class Saturation:
    """The clipped channels of one photograph.

    Attributes:
        channels: (H, W) uint8; bit c is set where channel c is clipped.
        least: (3,) float32, the radiance that such a channel has at least.
    """

    channels: np.ndarray
    least: np.ndarray

    @staticmethod
    def of(over: np.ndarray, least: float) -> Saturation:
        """Take flags (H, W, 3), and what all channels are at least."""
        bits = np.array([1, 2, 4], np.uint8)
        return Saturation((over * bits).sum(axis=-1, dtype=np.uint8), np.full(3, least, np.float32))

    @property
    def flags(self) -> np.ndarray:
        """(H, W, 3) bool."""
        return (self.channels[..., None] & np.array([1, 2, 4], np.uint8)) > 0

    def divided(self, gain: np.ndarray | np.floating) -> Saturation:
        """Return what it is of a photograph without its gain, of all channels or of each."""
        return replace(self, least=(self.least / gain).astype(np.float32))


@dataclass(frozen=True)
class Rounding:
    """How far apart the radiances are that one photograph can hold.

    Attributes:
        first: (3,) float32, the step above black, of every channel.
        slope: (3,) float32; at a radiance b a step is slope b^(1.4 / 2.4), but no less than the
            first.
    """

    first: np.ndarray
    slope: np.ndarray

    @staticmethod
    def of(bits: int, transfer: Transfer = "srgb") -> Rounding:
        """Return the steps of integers of 8 or 16 bits, of a white of radiance 1."""
        last = 2**bits - 1
        ends = np.array([1 / last, 1 - 1 / last, 1], np.float64)
        first, below, white = map(float, decoded(ends, transfer))
        return Rounding.between(first, white - below)

    @staticmethod
    def between(first: float, last: float) -> Rounding:
        """Take the steps above black and below a white of radiance 1, of all channels."""
        return Rounding(np.full(3, first, np.float32), np.full(3, last, np.float32))

    def divided(self, gain: np.ndarray | np.floating | float) -> Rounding:
        """Return what they are of a photograph without its gain, of all channels or of each."""
        gain = np.asarray(gain, np.float64)
        return Rounding(
            (self.first / gain).astype(np.float32),
            (self.slope * gain ** (CURVE - 1)).astype(np.float32),
        )


def variance(radiance: Any, first: Any, slope: Any) -> Any:
    """Return the variance of what rounding does to a radiance: that of a uniform distribution as
    wide as a step. Floats, of one channel."""
    step = dr.maximum(first, slope * dr.power(dr.maximum(radiance, 1e-20), CURVE))
    return step * step / 12
