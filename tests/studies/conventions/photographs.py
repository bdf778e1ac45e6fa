"""The ways in which photographs of an object may come."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from svu_mi.bench.captures import some_views
from svu_mi.capture import Capture
from svu_mi.capture.images import SATURATED
from svu_mi.capture.picture import decoded, srgb
from svu_mi.formats.reading import Format

FEW = 8  # views
WHITE = 0.97  # of the object's pixels that an 8-bit photograph does not clip
BRIGHT = 0.15  # by which a wall is brighter at the top than in the middle


@dataclass(frozen=True)
class Way:
    """How photographs come.

    Attributes:
        format: that they are imported from.
        changed: applied to the imported capture.
    """

    format: Format
    changed: Callable[[Capture], Capture] = lambda capture: capture


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


# By the heads of tables; the first ones are the importers, with all that each can hold.
WAYS: dict[str, Way] = {
    "transforms.json": Way("transforms"),
    "COLMAP": Way("colmap"),
    "Objects with Lighting (8 bits)": Way("owl"),
    "Stanford-ORB": Way("stanford-orb"),
    "transforms.json without masks": Way("transforms", without_masks),
    "COLMAP with 8 bits before a wall": Way("colmap", lambda c: eight_bit(before_wall(c))),
    f"transforms.json with {FEW} views": Way("transforms", lambda c: some_views(c, FEW)),
}
IMPORTERS = tuple(WAYS)[:4]
