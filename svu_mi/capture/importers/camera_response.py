"""Reader of measured response curves of cameras."""

from pathlib import Path

import numpy as np

from svu_mi.capture.importers.source_files import read_lines
from svu_mi.capture.quantization import SATURATED
from svu_mi.capture.tone_curve import SampledCurve
from svu_mi.core.io.files import refusing
from svu_mi.core.io.schema import NUMBER, Axis, Field, checked
from svu_mi.errors import CaptureError

LARGEST = (1, 255, 65535)  # valid codes of white
SAMPLE = {"sample": Field(NUMBER, (Axis("numbers", 2, 4),), 0, np.finfo(float).max)}
FIX = "write one line ENCODED LINEAR or ENCODED R G B for each sample of the curve"


def read_response(path: Path) -> SampledCurve:
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
    return SampledCurve(name=path.name, codes=codes, values=values / values[-1])


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
