"""Tone curves: conversion between encoded and linear values of images."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

Transfer = Literal["srgb", "gamma 2.2", "linear"]


@dataclass(frozen=True, kw_only=True)
class SampledCurve:
    """Sampled curve, linear between samples.

    Attributes:
        name: origin, for messages.
        codes: (N,) float32, encoded values relative to the largest, ascending from 0 to 1.
        values: (N, 3) float64, linear values of R, G and B, ascending to 1.
    """

    name: str
    codes: np.ndarray
    values: np.ndarray

    def __str__(self) -> str:
        return f"in {self.name}"


def linearize(encoded: np.ndarray, transfer: Transfer | SampledCurve, channel: int) -> np.ndarray:
    """Return the linear values (float32) of encoded values in [0, 1] of one channel."""
    if isinstance(transfer, SampledCurve):
        values = transfer.values[:, channel]
        return np.interp(encoded, transfer.codes, values).astype(np.float32)
    return decoded(encoded, transfer)


def decoded(encoded: np.ndarray, transfer: Transfer = "srgb") -> np.ndarray:
    """Decode values in [0, 1] to linear float32."""
    if transfer == "srgb":
        low, high = encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4
        return np.where(encoded <= 0.04045, low, high).astype(np.float32)
    power = 1 if transfer == "linear" else np.float32(2.2)
    return np.asarray(encoded**power, np.float32)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in [0, 1] as sRGB (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def quantized(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Round values in [0, 1] to unsigned integers of 8 or 16 bits."""
    most = 2**bits - 1
    return (np.clip(image, 0, 1) * most + 0.5).astype(np.uint8 if bits == 8 else np.uint16)
