"""Photographs with effects of cameras and file formats: integers, saturation, masks."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.image_io import decoded, srgb
from svu_mi.capture.photographs import SATURATED
from svu_mi.capture.quantization import Rounding, Saturation
from svu_mi.posterior.observations import Observed

WHITE = 0.97  # of the object's pixels that an 8-bit photograph does not clip
BRIGHT = 0.15  # by which a wall is brighter at the top than in the middle


def eight_bit(capture: Capture) -> Capture:
    """Return the photographs as 8-bit sRGB would have kept them, clipped pixels left out."""
    white = white_of(capture)
    images = []
    for image in capture.images:
        encoded = np.round(255 * srgb(np.clip(image / white, 0, 1))) / 255
        clipped = ~(encoded <= SATURATED[8]).all(axis=-1, keepdims=True)  # NaN too
        images.append(np.where(clipped, np.nan, decoded(encoded)).astype(np.float32))
    return replace(capture, images=tuple(images))


def white_of(capture: Capture) -> float:
    """Return the radiance that an 8-bit photograph would have as white."""
    shown = [image[mask] for image, mask in _pairs(capture)]
    brightest = np.nanmax(np.concatenate(shown), axis=1)
    return float(np.nanquantile(brightest, WHITE))


def without_masks(capture: Capture) -> Capture:
    """Return the capture without masks: whatever is behind the object stays in the pictures."""
    return replace(capture, masks=(None,) * capture.count)


def before_wall(capture: Capture) -> Capture:
    """Return the photographs as taken before a grey wall, a little brighter above; no masks."""
    level = float(np.nanmedian(np.concatenate([image[mask] for image, mask in _pairs(capture)])))
    images = []
    for image, mask in _pairs(capture):
        height = np.linspace(1 + BRIGHT, 1 - BRIGHT, len(mask))[:, None, None]
        images.append(np.where(mask[..., None], image, level * height).astype(np.float32))
    return without_masks(replace(capture, images=tuple(images)))


def _pairs(capture: Capture) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for image, mask in zip(capture.images, capture.masks, strict=True):
        yield image, np.ones(image.shape[:2], bool) if mask is None else mask


def in_integers(
    capture: Capture, observed: Observed, part: float, bits: int = 8
) -> tuple[Capture, float]:
    """Store photographs as sRGB integers, with one exposure for all.

    Args:
        capture: HDR photographs.
        observed: what they show.
        part: of the pixels that show the object, which is clipped in some channel.
        bits: 8 or 16.

    Returns:
        The capture, and the part that is clipped.
    """
    colors = np.asarray(observed.views.pixels.numpy()).reshape(-1, 3)
    most = colors[observed.views.usable.numpy()].max(axis=1)
    limit, last = float(decoded(np.array(SATURATED[bits], np.float32))), 2**bits - 1
    exposure = limit / max(float(np.quantile(most, 1 - part)), 1e-12)
    if part == 0:
        exposure *= 0.99
    images, clipped = [], []
    for image in capture.images:
        encoded = np.round(last * srgb(np.nan_to_num(image) * exposure)) / last
        saturated = Saturation.of(encoded > SATURATED[bits], limit / exposure)
        linear = (decoded(encoded.astype(np.float32)) / exposure).astype(np.float32)
        linear[saturated.flags] = np.nan
        images.append(np.ascontiguousarray(linear))
        clipped.append(saturated)
    steps = (Rounding.of(bits).divided(exposure),) * len(images)
    stored = replace(capture, images=tuple(images), clipped=tuple(clipped), rounding=steps)
    return stored, float((most * exposure > limit).mean())


def copy_file(source: Path, target: Path) -> None:
    """Copy a file; the folder of the copy is made if missing."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
