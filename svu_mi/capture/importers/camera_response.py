"""Camera response curves: conversion of integer pixels to linear radiance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from svu_mi.capture.image_io import Transfer, decoded
from svu_mi.capture.importers.source_files import read_lines
from svu_mi.capture.photographs import SATURATED
from svu_mi.capture.quantization import CURVE, Rounding
from svu_mi.core.io.files import refusing
from svu_mi.core.io.schema import NUMBER, Axis, Field, checked
from svu_mi.errors import CaptureError

SMALLEST = 1e-9  # quantisation step of a flat curve
TYPICAL = 0.9  # quantile of all steps that is used as the typical one
LARGEST = (1, 255, 65535)  # valid codes of white
SAMPLE = {"sample": Field(NUMBER, (Axis("numbers", 2, 4),), 0, np.finfo(float).max)}
FIX = "write one line ENCODED LINEAR or ENCODED R G B for each sample of the curve"


@dataclass(frozen=True, kw_only=True)
class CameraResponse:
    """Measured response curve, linear between samples.

    Attributes:
        name: name of its file, for messages.
        codes: (N,) float32, encoded values relative to the largest, ascending from 0 to 1.
        values: (N, 3) float64, linear values of R, G and B, ascending to 1.
    """

    name: str
    codes: np.ndarray
    values: np.ndarray

    def __str__(self) -> str:
        return f"in {self.name}"


def linearize(encoded: np.ndarray, transfer: Transfer | CameraResponse, channel: int) -> np.ndarray:
    """Return the linear values (float32) of encoded values in [0, 1] of one channel."""
    if isinstance(transfer, CameraResponse):
        values = transfer.values[:, channel]
        return np.interp(encoded, transfer.codes, values).astype(np.float32)
    return decoded(encoded, transfer)


def saturation_radiance(transfer: Transfer | CameraResponse, bits: int) -> float:
    """Return the smallest linear value of a saturated channel of 8 or 16 bits."""
    most = np.array(SATURATED[bits], np.float32)
    return min(float(linearize(most, transfer, channel)) for channel in range(3))


def quantization_steps(transfer: Transfer | CameraResponse, bits: int) -> tuple[float, float]:
    """Return first step and slope of the quantisation of 8 or 16 bits (see ``Rounding``).

    Both are the largest ones of all channels. Codes with equal values form one step; saturated
    codes are ignored.
    """
    last = 2**bits - 1
    if not isinstance(transfer, CameraResponse):
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


def read_response(path: Path) -> CameraResponse:
    """Read a measured response curve.

    The text file has one line ``ENCODED LINEAR`` or ``ENCODED R G B`` per sample, separated by
    blanks or commas; empty lines and comments (``#``) are ignored. Encoded values ascend from 0 to
    1, 255 or 65535. Linear values can have any unit, which may differ between channels.
    """
    rows: list[list[float]] = []
    for number, text in read_lines(path, "a response curve", FIX):
        with refusing(f"{path}: line {number}", FIX):
            rows.append(_sample(text, rows))
    if len(rows) < 2:
        raise CaptureError(
            f"{path}: a response curve needs at least 2 samples, got {len(rows)}; {FIX}."
        )
    table = np.array(rows)
    if table[0, 0] != 0 or table[-1, 0] not in LARGEST:
        raise CaptureError(
            f"{path}: its codes range from {table[0, 0]:g} to {table[-1, 0]:g}, not from 0 to 1, "
            "255 or 65535; add lines for the first and the last code."
        )
    # Single precision, as in photographs: a measured code then equals its sample.
    codes = (table[:, 0] / table[-1, 0]).astype(np.float32)
    same = np.flatnonzero(np.diff(codes) == 0)
    if same.size:
        raise CaptureError(
            f"{path}: the encoded values {table[same[0], 0]:.9g} and {table[same[0] + 1, 0]:.9g} "
            "are equal in single precision; remove one."
        )
    values = table[:, 1:] if table.shape[1] == 4 else np.repeat(table[:, 1:], 3, axis=1)
    # No camera is dark just below white; such a curve has no saturation radiance.
    if not all(np.interp(min(SATURATED.values()), codes, curve) > 0 for curve in values.T):
        raise CaptureError(
            f"{path}: a channel is 0 up to {min(SATURATED.values()):.0%} of the largest code; add "
            "samples between black and white."
        )
    return CameraResponse(name=path.name, codes=codes, values=values / values[-1])


def _sample(text: str, before: list[list[float]]) -> list[float]:
    """Return the numbers of a line; raise ValueError unless they are above those before."""
    row = [float(word) for word in text.replace(",", " ").split()]
    checked({"sample": row}, SAMPLE)
    last = before[-1] if before else [-1.0, *[0.0] * (1 if len(row) == 2 else 3)]
    if len(row) != len(last):
        raise ValueError(f"has {len(row)} numbers, not {len(last)}")
    if row[0] <= last[0]:
        raise ValueError(f"the encoded value {row[0]:g} comes after {last[0]:g}, but must ascend")
    if any(value < earlier for value, earlier in zip(row[1:], last[1:], strict=True)):
        raise ValueError("the linear value decreases with the code")
    return row
