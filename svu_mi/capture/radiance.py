"""Maps of light as files hold them: a little below zero is repaired, much is refused."""

from __future__ import annotations

import numpy as np

from svu_mi.errors import CaptureError, SvuError

LOST = 0.01  # part of a map's light that negative pixels may take away


def positive(
    pixels: np.ndarray, label: str, error: type[SvuError] = CaptureError
) -> tuple[np.ndarray, list[str]]:
    """Set negative pixels to 0; filters and conversions of colour leave some.

    Args:
        pixels: (H, W, 3) finite radiance.
        label: names the file or emitter.
        error: what is raised.

    Returns:
        The pixels, and a sentence if some were negative.

    Raises:
        SvuError: they are too many, or too negative, to be rounding.
    """
    below = pixels < 0
    if not below.any():
        return pixels, []
    count = int(below.any(axis=-1).sum())
    kept = np.where(below, 0, pixels)
    if np.abs(pixels[below]).sum(dtype=np.float64) > LOST * kept.sum(dtype=np.float64):
        raise error(
            f"{label}: {count} pixels are negative, by more than {LOST:.0%} of the light; export "
            "the map again."
        )
    return kept, [f"{label}: {count} negative pixels are taken for 0."]
