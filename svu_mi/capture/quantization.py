"""Limits of pixel values: saturated channels and quantisation steps."""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.capture.tone_curve import SampledCurve, Transfer, decoded, linearize

# Saturation threshold by bit depth, as a fraction of the encoded range; JPEG blurs highlights.
SATURATED = {8: 0.98, 16: 0.995}
SMALLEST = 1e-9  # quantisation step of a flat curve
TYPICAL = 0.9  # quantile of all steps that is used as the typical one
CURVE = 1.4 / 2.4  # sRGB steps are proportional to radiance^CURVE above its linear part


@dataclass(frozen=True)
class Saturation:
    """The clipped channels of one photograph.

    Attributes:
        channels: (H, W) uint8; bit c is set where channel c is clipped.
        least: (3,) float32, lower bounds of the radiance of clipped channels.
    """

    channels: np.ndarray
    least: np.ndarray

    @staticmethod
    def of(over: np.ndarray, least: float) -> "Saturation":
        """Make a record from flags (H, W, 3), and one lower bound for all channels."""
        bits = np.array([1, 2, 4], np.uint8)
        return Saturation((over * bits).sum(axis=-1, dtype=np.uint8), np.full(3, least, np.float32))

    @property
    def flags(self) -> np.ndarray:
        """Flags of clipped channels, (H, W, 3) bool."""
        return (self.channels[..., None] & np.array([1, 2, 4], np.uint8)) > 0

    def divided(self, gain: np.ndarray | np.floating) -> "Saturation":
        """Return the saturation after division by a gain, a scalar or (3,)."""
        return replace(self, least=(self.least / gain).astype(np.float32))


@dataclass(frozen=True)
class Rounding:
    """Quantisation steps max(first, slope b^(1.4 / 2.4)) at radiance b.

    Attributes:
        first: (3,) float32, step between black and the next value, per channel.
        slope: (3,) float32, step at radiance 1, per channel.
    """

    first: np.ndarray
    slope: np.ndarray

    @staticmethod
    def of(bits: int, transfer: Transfer = "srgb") -> "Rounding":
        """Return the steps of 8- or 16-bit integers; the largest integer is radiance 1."""
        last = 2**bits - 1
        ends = np.array([1 / last, 1 - 1 / last, 1], np.float64)
        first, below, white = map(float, decoded(ends, transfer))
        return Rounding.between(first, white - below)

    @staticmethod
    def between(first: float, last: float) -> "Rounding":
        """Make equal steps for all channels: ``first`` at black, ``last`` at radiance 1."""
        return Rounding(np.full(3, first, np.float32), np.full(3, last, np.float32))

    def divided(self, gain: np.ndarray | np.floating | float) -> "Rounding":
        """Return the steps after division by a gain, a scalar or (3,)."""
        gain = np.asarray(gain, np.float64)
        return Rounding(
            (self.first / gain).astype(np.float32),
            (self.slope * gain ** (CURVE - 1)).astype(np.float32),
        )


def variance(radiance: Any, first: Any, slope: Any) -> Any:
    """Return the variance of the rounding error, step^2 / 12, at a radiance."""
    step = dr.maximum(first, slope * dr.power(dr.maximum(radiance, 1e-20), CURVE))
    return step * step / 12


def saturation_radiance(transfer: Transfer | SampledCurve, bits: int) -> float:
    """Return the smallest linear value of a saturated channel of 8 or 16 bits."""
    most = np.array(SATURATED[bits], np.float32)
    return min(float(linearize(most, transfer, channel)) for channel in range(3))


def quantization_steps(transfer: Transfer | SampledCurve, bits: int) -> tuple[float, float]:
    """Return first step and slope of the quantisation of 8 or 16 bits (see ``Rounding``).

    Both are the largest ones of all channels. Codes with equal values form one step; saturated
    codes are ignored.
    """
    last = 2**bits - 1
    if not isinstance(transfer, SampledCurve):
        rounding = Rounding.of(bits, transfer)
        return float(rounding.first[0]), float(rounding.slope[0])
    codes = np.arange(int(SATURATED[bits] * last) + 1) / last
    first, slope = SMALLEST, SMALLEST
    for channel in range(3):
        values = np.unique(linearize(codes, transfer, channel).astype(np.float64))
        if len(values) > 1:
            differences, middle = np.diff(values), (values[1:] + values[:-1]) / 2
            first = max(first, float(differences[0]))
            slope = max(slope, float(np.quantile(differences / middle**CURVE, TYPICAL)))
    return first, slope
