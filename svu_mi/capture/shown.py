"""Photographs as they are shown: in another size, exposed for the object, encoded as sRGB."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from svu_mi.capture import picture as pictures

WHITE = 0.95  # part of the object's pixels that a tone-mapped photograph does not clip


def exposure(photograph: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the radiance that becomes white when a photograph is exposed for its object.

    Arguments are those of ``tone_mapped``.
    """
    brightness = photograph.max(axis=2)
    chosen = brightness[mask] if mask is not None and mask.any() else brightness
    chosen = chosen[np.isfinite(chosen)]
    white = float(np.quantile(chosen, WHITE)) if len(chosen) else 1.0
    return white if white > 0 else 1.0


def tone_mapped(
    photograph: np.ndarray, mask: np.ndarray | None = None, white: float | None = None
) -> np.ndarray:
    """Expose a photograph for its object and encode it as sRGB.

    Args:
        photograph: (H, W, 3) linear radiance; NaN = not usable, becomes middle grey.
        mask: (H, W) bool, the pixels to expose for; all of them by default.
        white: radiance that becomes white; by default that of ``exposure``.

    Returns:
        (H, W, 3) float32 in [0, 1].
    """
    linear = photograph / (exposure(photograph, mask) if white is None else white)
    return srgb(np.clip(linear, 0, 1))


def resized(photograph: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a photograph in (width, height) pixels; unusable ones leave NaN around them."""
    height, width = photograph.shape[:2]
    if (width, height) == size:
        return np.array(photograph)
    if width % size[0] == 0 and height % size[1] == 0:
        return shrunk(photograph, width // size[0], height // size[1])
    unusable = ~np.isfinite(photograph).all(axis=2, keepdims=True)
    planes = np.concatenate([np.where(unusable, 0, photograph), unusable], axis=2)
    bitmap = mi.Bitmap(np.ascontiguousarray(planes, np.float32)).resample(mi.ScalarVector2u(size))
    small = np.array(bitmap, np.float32)
    return np.where(np.abs(small[..., 3:]) > 1e-3, np.nan, np.maximum(small[..., :3], 0))


def shrunk(photograph: np.ndarray, across: int, down: int) -> np.ndarray:
    """Return means of so many pixels across and down; those left over at the ends are cut off."""
    height, width = photograph.shape[0] // down, photograph.shape[1] // across
    means = np.zeros((height, width, photograph.shape[2]), np.float32)
    for row in range(down):
        for column in range(across):
            means += photograph[row : down * height : down, column : across * width : across]
    return means / (across * down)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in [0, 1] as sRGB, float32; NaN becomes middle grey."""
    encoded = pictures.srgb(linear)
    return np.where(np.isfinite(encoded), encoded, 0.5).astype(np.float32)
